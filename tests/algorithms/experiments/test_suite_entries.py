"""Entries of the suite: policies by name, what an entry may not have seen, and whether scores agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from algorithms.command_line import run
from algorithms.experiments.config import make_experiment
from algorithms.experiments.suite_entries import agrees, check_experiment, fresh_seed, open_entry, recorded_rows
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
            r"not trained on task K5: yield_to_oncoming = True \(not",
        ),
        ("K2", {"arguments": {"action_type": "discrete"}}, "action_type = 'discrete'"),
        ("K1", {"seed": SPLITS["test"].start + 5}, "trained on the test split: training.seed = 3,000,005"),
        (
            "V1",
            {"partners": {"vehicle_1": ["rule:straight_4", "rule:yields_7"]}},
            "met partners of task V1 in training: rule:yields_7",
        ),
    ],
)
def test_a_run_that_cannot_be_an_entry_is_refused(task_id: str, changes: dict[str, Any], message: str) -> None:
    check_experiment(experiment(task_id), task_id, "mine")
    with pytest.raises(ValueError, match=message):
        check_experiment(experiment(task_id, **changes), task_id, "mine")


@pytest.mark.parametrize(
    ("text", "source", "message"),
    [
        (None, "policy.py", "policy file .*policy.py' does not exist"),
        ("def drive(*_):\n    pass\n", "policy.py", "the file has no 'policy' or 'Policy'; .*drive"),
        (STILL, "policy.py:policy_2", "the file has no 'policy_2'; did you mean 'policy'"),
        ("import nothing_of_this_name\n", "policy.py", "cannot be imported: ModuleNotFoundError"),
    ],
)
def test_a_policy_file_without_a_policy_is_refused(tmp_path: Path, text: str | None, source: str, message: str) -> None:
    if text is not None:
        (tmp_path / "policy.py").write_text(text)
    with pytest.raises(ValueError, match=message):
        open_entry(str(tmp_path / source))


def test_fresh_scenarios_are_in_no_split_and_follow_from_the_number() -> None:
    seeds = [fresh_seed(number, 1000) for number in (1, 1, 2)]
    assert seeds[0] == seeds[1] != seeds[2]
    assert all(max(split.stop for split in SPLITS.values()) <= seed < FIRST_TRAINING_SEED for seed in seeds)


@pytest.mark.parametrize(
    ("value", "verdict"), [(1.0, "reproduced"), (1.15, "within the interval"), (1.5, "differs"), (0.5, "differs")]
)
def test_scores_agree_where_their_intervals_meet(value: float, verdict: str) -> None:
    recorded = Row("K1", "a", 0, "greedy", "score", 1.0, 0.9, 1.1)
    found = Row("K1", "a", 0, "greedy", "score", value, value - 0.1, value + 0.1)
    assert agrees(recorded, found) == verdict


def test_scores_of_another_version_of_the_suite_are_not_verified(tmp_path: Path) -> None:
    suite.write_rows(tmp_path / "rows.csv", [Row("K1", "a", 0, "greedy", "score", 1.0, version=99)])
    with pytest.raises(ValueError, match="version 99 of the suite; this is version"):
        recorded_rows(str(tmp_path / "rows.csv"))


@pytest.mark.slow
def test_a_policy_file_is_scored_and_verified_and_a_false_claim_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policy.py").write_text(STILL)
    command = ["score", "policy.py", "--tasks", "K6-ESR", "--no-perturbations", "--output", "scores.csv"]
    assert run("suite", command, "mo-deepdrive {}") == 0
    assert run("suite", ["verify", "scores.csv", "--scenarios", "7"], "mo-deepdrive {}") == 0
    assert capsys.readouterr().out.count("reproduced") == 2
    table = (tmp_path / "scores.csv").read_text()
    (tmp_path / "scores.csv").write_text(table.replace("score,0.0,0.0,0.0", "score,0.5,0.4,0.6"))
    assert run("suite", ["verify", "scores.csv"], "mo-deepdrive {}") == 1
    assert "differs" in capsys.readouterr().out


@pytest.mark.slow
def test_reference_entries_are_reproduced_by_the_policies_of_the_zoo(capsys: pytest.CaptureFixture[str]) -> None:
    entries = REPOSITORY / "docs" / "results" / "suite_entries.csv"
    tasks = ("K1", "K3", "V1")
    assert run("suite", ["verify", str(entries), "--tasks", *tasks], "mo-deepdrive {}") == 0
    rows = [row for row in suite.read_rows(entries) if row.task in tasks]
    assert {row.task for row in rows} == {*tasks}
    printed = capsys.readouterr().out  # on another kind of processor the last bits, and with them episodes, may differ
    assert printed.count("reproduced") + printed.count("within the interval") == len(rows)
