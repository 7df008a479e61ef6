"""Entries of the suite: policies by name, what an entry may not have seen, and whether scores agree."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from algorithms.command_line import run
from algorithms.commands.suite import main
from algorithms.reporting.run_records import read_evaluation
from algorithms.runs.config import make_experiment
from algorithms.runs.suite_entries import (
    check_experiment,
    disagreement,
    fresh_seed,
    recorded_rows,
    rows_of,
    score_run,
)
from algorithms.studies.results import samples_of_runs
from mo_deepdrive import suite
from mo_deepdrive.evaluation.splits import FIRST_TRAINING_SEED, SPLITS
from mo_deepdrive.suite import Row
from tests.helpers.paths import REPOSITORY

STILL = "import numpy as np\ndef policy(observations, *_):\n    return np.zeros(len(observations), dtype=np.int64)\n"


def experiment(task_id: str, arguments: dict[str, Any] | None = None, **training: Any) -> Any:
    task = suite.load().task(task_id)
    assert task.utility is not None
    return make_experiment(
        {
            "environment": {
                "id": task.environment.id,
                "arguments": {**task.environment.arguments, **(arguments or {})},
            },
            "utility": task.utility.model_dump(),
            "algorithm": {"name": "mo_ppo"},
            "training": {"total_timesteps": 1000, "num_envs": 16, **training},
        }
    )


@pytest.mark.parametrize(
    ("task_id", "changes", "message"),
    [
        (
            "K5",
            {"arguments": {"yield_to_oncoming": True}},
            r"task K5 needs another environment: environment.arguments.yield_to_oncoming = True \(not",
        ),
        ("K4", {"arguments": {"action_type": "continuous"}}, "action_type = 'continuous'"),
        ("K1", {"total_timesteps": 100_000_000}, "total_timesteps = 100,000,000: task K1 allows 3,000,000"),
        ("K1", {"seed": SPLITS["test"].start + 5}, "trained on the test split: training.seed = 3,000,005"),
        (
            "V1",
            {"partners": {"vehicle_1": ["rule:straight_4", "rule:waves_2"]}},
            "met partners of task V1 in training: rule:waves_2",
        ),
    ],
)
def test_a_run_that_cannot_be_an_entry_is_refused(task_id: str, changes: dict[str, Any], message: str) -> None:
    check_experiment(experiment(task_id), task_id, "mine")
    with pytest.raises(ValueError, match=message):
        check_experiment(experiment(task_id, **changes), task_id, "mine")


def test_fresh_scenarios_are_in_no_split_and_follow_from_the_number() -> None:
    seeds = [fresh_seed(number, 1000) for number in (1, 1, 2)]
    assert seeds[0] == seeds[1] != seeds[2]
    assert all(max(split.stop for split in SPLITS.values()) <= seed < FIRST_TRAINING_SEED for seed in seeds)


FOUND = Row("K1", "a", 0, "greedy", "score", 1.0, 0.9, 1.1)


@pytest.mark.parametrize(
    ("recorded", "fresh", "agrees"),
    [
        ((1.0, 0.9, 1.1), False, True),
        ((1.0 + 5e-3, 0.9, 1.1), False, True),  # a few episodes on another kind of processor
        ((1.05, 0.9, 1.1), False, False),  # within the interval, which is no excuse on the same scenarios
        ((1.0, -1e9, 1e9), False, False),
        ((1.0, None, None), False, False),
        ((1.15, 1.05, 1.25), True, True),
        ((1.5, 1.4, 1.6), True, False),
        ((99.0, -1e9, 1e9), True, False),
        ((1.6, 0.6, 2.6), True, False),  # wider than any interval of these scenarios
        ((1.5, None, None), True, False),
    ],
)
def test_scores_agree_as_their_scenarios_allow(recorded: Any, fresh: bool, agrees: bool) -> None:
    row = Row("K1", "a", 0, "greedy", "score", *recorded)
    assert (disagreement(row, FOUND, fresh=fresh) == "") is agrees


def test_numbers_without_an_interval_are_compared_on_the_same_scenarios_alone() -> None:
    found, other = (Row("U2", "a", 0, "greedy", "controllability", value) for value in (0.5, 0.6))
    assert disagreement(other, found, fresh=False)
    assert not disagreement(other, found, fresh=True)


@pytest.mark.parametrize(("source", "agrees"), [("runs/a", False), ("policy.py", True)])
def test_a_run_is_scored_by_the_seed_that_it_was_trained_with(source: str, agrees: bool) -> None:
    assert (disagreement(replace(FOUND, seed=1, source=source), FOUND, fresh=False) == "") is agrees


def test_policies_that_a_table_could_not_tell_apart_are_refused_before_they_are_scored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / "policy.py", tmp_path / "other" / "policy.py"]
    files[1].parent.mkdir()
    for file in files:
        file.write_text(STILL)
    with pytest.raises(SystemExit):
        main(["score", *map(str, files), "--tasks", "core", "K4", "--output", str(tmp_path / "both.csv")])
    assert "two policies are 'policy' with seed 0 on K3" in capsys.readouterr().err


HEADER = "task,learner,seed,policy,column,value,low,high,source,state,cpu_seconds,version\n"
VERSION = suite.load().version
ROW = f"K1,a,0,greedy,score,1.0,0.9,1.1,policy.py,finished,,{VERSION}\n"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (ROW.replace("1.0,", "nan,"), "line 2: value = 'nan': Input should be a finite number"),
        (ROW.replace("1.0,", "99,"), "line 2: value = 99.0 must be from low = 0.9 to high = 1.1"),
        (ROW.replace("0.9,", ","), "line 2: low = None and high = 1.1 must both be given, or neither"),
        (ROW + ROW, "line 3: a second row of K1, a, 0, greedy, score"),
        (ROW + ROW.replace(",0,", ",1,", 1), r"twice: of a, seed 0, and of a, seed 1"),
        (ROW + ROW.replace(",a,", ",b,").replace("greedy", "stochastic"), "twice: of a, seed 0, and of b, seed 0"),
        (ROW.replace("greedy", "best"), "line 2: policy = 'best' must be 'greedy', 'stochastic' or"),
        (ROW.replace("greedy", "front"), "policy = 'front' must be 'greedy' or 'stochastic'"),
        (ROW.replace("score", "scorre"), "column = 'scorre' is unknown; did you mean 'score'"),
        (ROW.replace("K1", "Popen"), "task = 'Popen' is unknown"),
        # What an older version had may be gone.
        (
            ROW.replace(f",{VERSION}\n", ",1\n").replace("K1", "K2"),
            f"version 1 of the suite; this is version {VERSION}",
        ),
        (ROW.replace("policy.py", ""), "does not say which run or policy was scored"),
        (ROW.replace("finished", "failed"), "line 2: value = 1.0 of a run that failed"),
        (ROW.replace("1.0,0.9,1.1", ",,"), "has no scores"),
    ],
)
def test_rows_that_no_entry_has_are_refused(tmp_path: Path, rows: str, message: str) -> None:
    (tmp_path / "rows.csv").write_text(HEADER + rows)
    with pytest.raises(ValueError, match=message):
        recorded_rows(str(tmp_path / "rows.csv"))


@pytest.mark.parametrize("source", ["policy.py", "subprocess:Popen", "policy.py:Policy"])
def test_nothing_of_an_entry_runs_before_it_is_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], source: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policy.py").write_text("open('it_ran', 'w')\n")
    (tmp_path / "rows.csv").write_text(HEADER + ROW.replace("policy.py", source))
    assert run("suite", ["verify", "rows.csv"]) != 0
    assert "--trust runs it" in capsys.readouterr().err
    assert not (tmp_path / "it_ran").exists()


@pytest.mark.slow
def test_a_policy_file_is_scored_and_verified_and_a_false_claim_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policy.py").write_text(STILL)
    command = ["score", "policy.py", "--tasks", "K4", "--no-perturbations", "--output", "scores.csv"]
    assert run("suite", command) == 0
    verify = ["verify", "scores.csv", "--scenarios", "7", "--trust"]
    assert run("suite", verify) == 0
    assert capsys.readouterr().out.count("reproduced") == 1
    assert [*suite.read_samples(tmp_path / "scores.csv")] == [("K4", "policy", 0)]
    table = (tmp_path / "scores.csv").read_text()
    (tmp_path / "scores.csv").write_text(table.replace("score,0.0,0.0,0.0", "score,0.5,0.4,0.6"))
    assert run("suite", verify) == 1
    assert "policy.py on K4, score (stochastic), test split: its value = 0.5, found 0.0" in capsys.readouterr().out

    (tmp_path / "policy.py").write_text(f"{STILL}\nagain = policy\n")
    assert run("suite", [command[0], "policy.py:policy", "policy.py:again", "--learner", "mine", *command[2:]]) == 0
    assert [*suite.read_samples(tmp_path / "scores.csv")] == [("K4", "mine", 0), ("K4", "mine", 1)]
    assert run("suite", verify) == 0


@pytest.mark.slow
def test_the_samples_of_a_run_s_score_are_kept_and_collected_for_the_table_of_its_study(tmp_path: Path) -> None:
    evaluation = SimpleNamespace(task="K1", split="test", final_seed=SPLITS["test"].start)
    place = tmp_path / "runs" / "still"
    place.mkdir(parents=True)
    (place / "evaluation.json").write_text('{"policies": {}}')
    run_of_study: Any = SimpleNamespace(path=place, experiment=SimpleNamespace(evaluation=evaluation))
    score_run(run_of_study, lambda observations, *_: np.zeros(len(observations), dtype=np.int64))
    scored = read_evaluation(place)
    assert scored is not None
    job = SimpleNamespace(seed=3, directory="runs/still", config={"evaluation": {"task": "K1"}})
    arm: Any = SimpleNamespace(arm=SimpleNamespace(key=("K1", "mine")), final=[job])
    samples = samples_of_runs([arm], tmp_path)
    assert suite.samples_of(rows_of(scored, ("K1", "mine", 3)), samples).keys() == {("K1", "mine", 3)}
    evaluation.split, evaluation.final_seed = "validation", SPLITS["validation"].start
    shutil.rmtree(place / "evaluation_samples")
    score_run(run_of_study, lambda observations, *_: np.zeros(len(observations), dtype=np.int64))
    assert samples_of_runs([arm], tmp_path) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"policy file '.*mine\.py' does not exist"),
        ("def drive(*_):\n    pass\n", "'mine' has no 'policy' or 'Policy'; .*drive"),
        ("import sys\nsys.exit(3)\n", "cannot be imported: SystemExit: 3 at mine.py:2"),
        ("1 / 0\n", "cannot be imported: ZeroDivisionError: .* at mine.py:1"),
        ("class Policy:\n    pass\n", r"Policy\('K1'\) cannot be made: TypeError"),
        (
            "class Policy:\n    def __init__(self, task):\n        {}[task]\n",
            r"Policy\('K1'\) cannot be made: KeyError: 'K1' at mine.py:3",
        ),
        ("def policy(observations):\n    pass\n", r"cannot be called as policy\(observations, accrued, discounts\)"),
        (
            "def policy(observations, *_):\n    return observations[:, :, 0]\n",
            r"failed for observations \(2, 19\), accrued rewards \(2, 6\) and discounts \(2,\): IndexError: too many "
            r"indices.* at mine.py:2",
        ),
        ("import sys\ndef policy(*_):\n    sys.exit(3)\n", "SystemExit: 3 at mine.py:3"),
        (
            "import numpy as np\ndef policy(observations, *_):\n    return np.ma.masked_equal([0, 1], 1)\n",
            "the policy returned masked actions",
        ),
    ],
)
def test_a_policy_that_cannot_drive_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, message: str
) -> None:
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    with pytest.raises(SystemExit):
        main(["score", str(tmp_path / "mine.py"), "--tasks", "K1"])
    error = capsys.readouterr().err.strip()
    assert re.search(message, error), error
    assert "\n" not in error


@pytest.mark.slow
def test_reference_entries_are_reproduced_by_the_policies_of_the_zoo(capsys: pytest.CaptureFixture[str]) -> None:
    entries = REPOSITORY / "docs" / "results" / "suite_entries.csv"
    tasks = ("K1", "K4", "V1")
    assert run("suite", ["verify", str(entries), "--tasks", *tasks, "--scenarios", "1"]) == 0
    rows = [row for row in suite.read_rows(entries) if row.task in tasks]
    assert {row.task for row in rows} == {*tasks}
    assert capsys.readouterr().out.count("reproduced") == len(rows)
