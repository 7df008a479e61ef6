"""Studies: what is trained, in which order, by which settings, and the tables that are written."""

from __future__ import annotations

import csv
import dataclasses
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from rich.console import Console

from algorithms.commands.study import main, write_tables
from algorithms.runs.jobs import Job
from algorithms.studies.execution import Backend, Runner
from algorithms.studies.manifest import Scores, read_manifest
from algorithms.studies.plan import StudyPlan
from algorithms.studies.settings import load_study
from mo_deepdrive.suite import read_rows
from tests.helpers.made_up_sweeps import MadeUpBackend
from tests.helpers.short_runs import VALUES, printed, quiet
from tests.helpers.sweep_files import broken_utility, forked_workers, status

RATE = "algorithm.learning_rate"


def write_study(folder: Path, **changes: Any) -> Path:
    """A study of two learners on one task, with two points of tuning row."""
    (folder / "base.yaml").write_text(
        yaml.safe_dump({"algorithm": VALUES["algorithm"], "training": {"num_envs": 4, "seed": 7}})
    )
    study = {
        "tasks": {"short": {key: VALUES[key] for key in ("environment", "utility")} | {"steps": 960}},
        "learners": {
            "mo": {"config": "base.yaml"},
            "plain": {"config": "base.yaml", "overrides": {"algorithm.name": "a2c"}},
        },
        "tuning": {"seeds": [100], "values": {RATE: [0.001, 0.003]}},
        "metric": "stochastic/utility_esr",
        "seeds": 2,
        "overrides": {"evaluation": VALUES["evaluation"], "logging": VALUES["logging"]},
        **changes,
    }
    path = folder / "short.yaml"
    path.write_text(yaml.safe_dump(study))
    return path


def sizes(backend: MadeUpBackend) -> list[int]:
    """How many runs were trained together, batch by batch."""
    return [len(batch) for batch in backend.batches]


def train(folder: Path, plan: StudyPlan, backend: Backend, console: Console | None = None) -> int:
    """Train a study and write its tables, as the command does."""
    console = console or quiet()
    runner = Runner(plan, folder / "study", backend, console)
    code = runner.run()
    write_tables(plan, runner, folder / "study", console)
    return code


def made_up(folder: Path, file: Path, backend: Backend, console: Console | None = None) -> int:
    return train(folder, StudyPlan(load_study(file)), backend, console)


def test_the_tuning_is_scored_on_validation_and_the_best_settings_are_trained_with_the_seeds_that_count(
    tmp_path: Path,
) -> None:
    backend = MadeUpBackend()
    console = quiet()
    assert made_up(tmp_path, write_study(tmp_path), backend, console) == 0
    assert printed(console).splitlines()[:2] == [
        f"{tmp_path / 'base.yaml'}: training.seed is not used; set seeds with the key 'seeds'",
        "4 runs of tuning, as long as 4 full ones, then 4 that count: mo, plain on short",
    ]
    assert sizes(backend) == [4, 4]
    rows = read_manifest(tmp_path / "study")
    for row in rows:
        tuned = row.trial is not None
        assert row.config["evaluation"]["split"] == ("validation" if tuned else "test")
        assert row.seed in ([100] if tuned else [0, 1])
        assert tuned or row.config["algorithm"]["learning_rate"] == 0.003
    results = read_rows(tmp_path / "study" / "results.csv")
    assert {(row.steps, row.environment) for row in results} == {(960, "mo-deepdrive-one-waypoint-v0 time_limit=1.0")}
    assert [(row.learner, row.seed, row.value) for row in results] == [
        (learner, seed, 0.003) for learner in ("mo", "plain") for seed in (0, 1)
    ]
    with (tmp_path / "study" / "tuning.csv").open() as file:
        assert [line["chosen"] for line in csv.DictReader(file)] == ["0", "1", "0", "1"]
    again = MadeUpBackend()
    assert made_up(tmp_path, tmp_path / "short.yaml", again) == 0
    assert again.batches == []


def test_halving_gives_more_steps_to_the_better_half_by_its_mean_and_a_killed_study_resumes_to_identical_files(
    tmp_path: Path,
) -> None:
    def score(job: Job) -> float:
        """Short runs like low rates; then the higher one is better, but for one seed."""
        training, rate = job.experiment.training, job.experiment.algorithm.config.learning_rate
        if training.total_timesteps == 240:
            return -float(rate)
        return 0.0035 if (training.seed, rate) == (100, 0.001) else float(rate)

    def killed(job: Job) -> float:
        if (job.experiment.training.total_timesteps, job.experiment.training.seed) == (480, 102):
            raise KeyboardInterrupt
        return score(job)

    tuning = {"values": {RATE: [0.001, 0.002, 0.003, 0.004]}, "shares": [0.25, 0.5, 1.0]}
    folders = tmp_path / "whole", tmp_path / "killed"
    for folder in folders:
        folder.mkdir()
        file = write_study(folder, tuning=tuning)
        if folder.name == "killed":
            with pytest.raises(KeyboardInterrupt):
                made_up(folder, file, MadeUpBackend(score=killed))
        backend = MadeUpBackend(score=score)
        assert made_up(folder, file, backend) == 0
        assert sizes(backend) == ([24, 12, 6, 4] if folder.name == "whole" else [10, 6, 4])
    for name in ("manifest.jsonl", "tuning.csv", "results.csv"):
        assert (folders[0] / "study" / name).read_bytes() == (folders[1] / "study" / name).read_bytes()
    with (folders[0] / "study" / "tuning.csv").open() as file_of_tuning:
        lines = [line for line in csv.DictReader(file_of_tuning) if line["learner"] == "mo"]
    rungs = [(line["rung"], line["steps"], line["settings"], line["seed"]) for line in lines]
    assert rungs == [
        (str(rung), str(steps), f'{{"{RATE}": {rate}}}', str(seed))
        for rung, steps, rates in ((0, 240, (0.001, 0.002, 0.003, 0.004)), (1, 480, (0.001, 0.002)), (2, 960, (0.002,)))
        for rate in rates
        for seed in (100, 101, 102)
    ]
    assert {line["settings"] for line in lines if line["chosen"] == "1"} == {f'{{"{RATE}": 0.002}}'}
    assert [line["score"] for line in lines[12:15]] == ["0.0035", "0.001", "0.001"]
    assert {line["cpu_seconds"] for line in lines} == {"60.0"}


def test_learners_with_more_to_tune_have_as_many_candidates_which_try_every_value_about_equally_often(
    tmp_path: Path,
) -> None:
    """Linear prices are tried beside what all learners try, at the same price."""
    prices = {"utility.arguments.weights.jerk": [0.0, 0.01, 0.1], "utility.arguments.weights.time": [0.1, 0.2]}
    linear = {"utility": {"name": "linear", "arguments": {"weights": {"distance": 1}}}}
    file = write_study(
        tmp_path,
        tuning={
            "values": {RATE: [0.001, 0.003, 0.01], "algorithm.gamma": [0.9, 0.99], "algorithm.accrued_discount": [1.0]},
            "candidates": 6,
            "shares": [0.5, 1.0],
            "reduction_factor": 3,
        },
        learners={
            "mo": {"config": "base.yaml"},
            "linear": {
                "config": "base.yaml",
                "overrides": {"algorithm.name": "a2c", **linear},
                "tuning": {**prices, RATE: [0.1, 0.2, 0.3]},
            },
        },
    )
    plan = StudyPlan(load_study(file))
    assert plan.announcement()[-1].startswith("48 runs of tuning, as long as 30 full ones, then 4 that count")
    with_prices, mo = plan.arms
    assert (len(mo.candidates), len(with_prices.candidates)) == (6, 6)
    assert {*mo.candidates[0]} == {RATE, "algorithm.gamma", "algorithm.accrued_discount"}
    assert {*with_prices.candidates[0]} == {RATE, "algorithm.gamma", *prices}, "A2C has no accrued reward to discount"
    for key, values in {**prices, RATE: [0.1, 0.2, 0.3], "algorithm.gamma": [0.9, 0.99]}.items():
        tried = [candidate[key] for candidate in with_prices.candidates]
        assert [tried.count(value) for value in values] == [6 // len(values)] * len(values)


def test_a_task_may_have_a_tuning_of_its_own(tmp_path: Path) -> None:
    task = {**{key: VALUES[key] for key in ("environment", "utility")}, "steps": 960}
    own = {"seeds": [7], "values": {RATE: [0.1, 0.2, 0.3]}}
    file = write_study(
        tmp_path,
        tuning={"seeds": [100], "values": {RATE: [0.001, 0.002]}, "shares": [0.5, 1.0]},
        tasks={"plain": task, "own": {**task, "tuning": own}},
        learners={"mo": {"config": "base.yaml"}},
    )
    plan = StudyPlan(load_study(file))
    tried = [(row.cell["task"], row.seed, row.config["training"]["total_timesteps"]) for row in plan.rows(Scores())]
    assert sorted(tried) == [("own", 7, 960)] * 3 + [("plain", 100, 480)] * 2
    assert plan.announcement()[-1].startswith("6 runs of tuning, as long as 5 full ones, then ")


def test_an_ablation_takes_the_settings_of_what_it_ablates_and_only_differs_in_what_it_lacks(tmp_path: Path) -> None:
    task = {key: VALUES[key] for key in ("environment", "utility")}
    blind = {"ablation_of": "mo", "overrides": {"algorithm.observe_accrued": False, "algorithm.gamma": 0.5}}
    tasks = {"short": {**task, "steps": 960, "learners": {"blind": blind}}}
    tuning = {"seeds": [100], "values": {RATE: [0.001, 0.003], "algorithm.gamma": [0.9]}}
    backend = MadeUpBackend()
    study = load_study(write_study(tmp_path, tasks=tasks, tuning=tuning))
    assert train(tmp_path, StudyPlan(study, None, ["blind"]), backend) == 0
    assert sizes(backend) == [2, 4], "what it ablates is trained, too, and it is not tuned"
    final = [row.config["algorithm"] for row in read_manifest(tmp_path / "study") if row.trial is None]
    settings = [(values["learning_rate"], values["observe_accrued"], values["gamma"]) for values in final]
    assert settings == [(0.003, True, 0.9)] * 2 + [(0.003, False, 0.5)] * 2
    assert {row.learner for row in read_rows(tmp_path / "study" / "results.csv")} == {"mo", "blind"}
    with (tmp_path / "study" / "tuning.csv").open() as file:
        assert {line["learner"] for line in csv.DictReader(file)} == {"mo"}


def test_failures_are_counted_and_neither_chosen_nor_repeated_once_others_were_chosen(tmp_path: Path) -> None:
    file = write_study(tmp_path)

    def fails(job: Job) -> bool:
        """The better rate of MO-A2C, one of its seeds that count, and everything of A2C."""
        algorithm, seed = job.experiment.algorithm, job.experiment.training.seed
        return algorithm.name == "a2c" or (seed == 100 and algorithm.config.learning_rate == 0.003) or seed == 1

    backend = MadeUpBackend(fails=fails)
    assert made_up(tmp_path, file, backend) == 1
    assert sizes(backend) == [4, 2]
    states = [(row.learner, row.seed, row.value, row.state) for row in read_rows(tmp_path / "study/results.csv")]
    assert states == [
        ("mo", 0, 0.001, "finished"),
        ("mo", 1, None, "failed"),
        ("plain", 0, None, "failed"),
        ("plain", 1, None, "failed"),
    ]
    page = (tmp_path / "study" / "results.md").read_text()
    assert "2 (1 failed)" in page
    assert "Cite these numbers of the final evaluations (" in page
    again = MadeUpBackend()
    assert made_up(tmp_path, file, again) == 1, "the failed rate stays failed, or other settings would be the best"
    # MO-A2C: the seed that failed. A2C, of which nothing was chosen: its tuning, then its seeds.
    assert sizes(again) == [3, 2]


def test_settings_come_from_the_task_the_help_the_learner_and_its_task_in_this_order(tmp_path: Path) -> None:
    file = write_study(
        tmp_path,
        tuning=None,
        help={RATE: 0.1, "algorithm.gamma": 0.9, "algorithm.accrued_discount": 1.0},
        tasks={
            "short": {
                **{key: VALUES[key] for key in ("environment", "utility")},
                "steps": 480,
                "help": {"algorithm.gamma": 0.8},
                "learners": {"mo": {"overrides": {RATE: 0.3}}},
            }
        },
    )
    mo, plain = (arm.values["algorithm"] for arm in StudyPlan(load_study(file)).arms)
    assert (mo["learning_rate"], mo["gamma"], mo["accrued_discount"]) == (0.3, 0.8, 1.0)
    assert (plain["learning_rate"], plain["gamma"], "accrued_discount" in plain) == (0.1, 0.8, False)


def test_a_task_of_the_suite_brings_all_but_the_learner_which_may_train_for_another_utility(tmp_path: Path) -> None:
    file = write_study(
        tmp_path,
        tasks=["K1", "U2"],
        metric=None,
        tuning={"seeds": [100], "values": {"utility.name": ["linear"]}, "shares": [0.5]},
        learners={"mo": {"config": "base.yaml", "overrides": {"utility.arguments.weights": {"distance": 1}}}},
    )
    plan = StudyPlan(load_study(file))
    (arm,) = plan.arms
    assert arm.metric == "stochastic/suite/score", "a learner for a known utility has no place in U2"
    (row,) = plan.rows(Scores())
    assert row.config["evaluation"]["task"] == "K1"
    assert row.config["utility"]["name"] == "linear"
    assert row.config["training"]["total_timesteps"] == 1_500_000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": [0, 100]}, "seeds has 100, a seed of the tuning"),
        (
            {"tuning": None, "tasks": {"K1": {"task": "K1", "tuning": {"values": {RATE: [0.1]}}}}, "metric": None},
            "tasks.K1.tuning has no effect in a study without tuning",
        ),
        ({"tuning": {"shares": [0.5, 0.25], "values": {RATE: [0.1]}}}, r"shares' = \[0.5, 0.25\]: it must increase"),
        (
            {"tuning": {"candidates": 3, "values": {RATE: [0.1, 0.2]}}},
            "must have the same number of candidates, 3, not mo 2, plain 2",
        ),
        ({"tuning": {}}, "candidates, 1, not mo 0, plain 0; tuning.values, or the tuning of a learner, must"),
        ({"tuning": {"values": {RATE: [0.1], "algorithm.gama": [1]}}}, "no learner has the setting 'algorithm.gama'"),
        (
            {"learners": {"mo": {"config": "base.yaml"}, "no": {"ablation_of": "mi"}}},
            "learner 'no' on task 'short': ablation_of = 'mi', which is no learner there; known: mo",
        ),
        (
            {"learners": {"mo": {"config": "base.yaml"}, "no": {"ablation_of": "mo", "tuning": {RATE: [0.1, 0.2]}}}},
            "an ablation has config, algorithm.name and tuning of 'mo', not its own",
        ),
        (
            {"learners": {"mo": {"config": "base.yaml"}, "no": {"ablation_of": "mo", "overrides": {RATE: 0.001}}}},
            "have the same run .* they do not differ in anything",
        ),
        ({"learners": {"a": {}}}, "learner 'a' on task 'short' has no algorithm"),
        ({"tasks": ["K1"]}, "metric has no effect: every task has its own"),
        (
            {"tasks": {"K1": {"task": "K1", "steps": 10**8}}, "metric": None},
            "training.total_timesteps = 100,000,000: task K1 allows 3,000,000 environment steps",
        ),
        (
            {"tasks": ["K1"], "metric": None, "overrides": {"environment.arguments.time_limit": 10}},
            r"task K1 needs another environment: environment.arguments.time_limit = 10.0 \(not 60.0\)",
        ),
        ({"overrides": {"training": {"seed": 3}}}, "'training.seed' in overrides: set seeds with the key 'seeds'"),
        (
            {"learners": {"mo": {"config": "base.yaml", "overrides": {"evaluation": {"task": "K3"}}}}},
            "'evaluation.task' in learners.mo.overrides: name the task of the suite as 'task' of a task",
        ),
        ({"tuning": {"values": {RATE: [0.001, 1e-3]}}}, "have the same run"),
        (
            {"tuning": {"values": {"algorithm.accrued_discount": [0.9, 1.0]}}},
            "task 'short': every learner must have the same number of candidates, 2, not mo 2, plain 0",
        ),
        ({"metric": "stochastic/utility_ers"}, "metric 'stochastic/utility_ers' is unknown; the nearest ones: stoch"),
        ({"columns": ["success", "arrivals"]}, "columns has 'arrivals', which no run has; the nearest ones: "),
        ({"metric": "utility_esr"}, "metric 'utility_esr' is unknown; the nearest ones: .*/utility_esr"),
        ({"help": {"algorithm.gama": 0.9}}, "no learner has the setting 'algorithm.gama'"),
        ({"ray": {"asha": {"metric": "greedy/utility_esr", "grace_period": 1}}}, "prune runs that count"),
    ],
)
def test_an_invalid_study_is_refused_before_anything_is_trained(
    changes: dict[str, Any], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--config", str(write_study(tmp_path, **changes)), "--output", str(tmp_path / "study")]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "study").exists()


def test_arms_that_are_not_selected_are_not_trained_and_keep_their_results(tmp_path: Path) -> None:
    study = load_study(write_study(tmp_path))
    for learner, trained in (("mo", {"mo"}), ("plain", {"mo", "plain"})):
        backend = MadeUpBackend()
        assert train(tmp_path, StudyPlan(study, ["short"], [learner]), backend) == 0
        assert sizes(backend) == [2, 2]
        assert {row.learner for row in read_rows(tmp_path / "study" / "results.csv")} == trained
        assert {row.cell["learner"] for row in read_manifest(tmp_path / "study")} == trained
    with pytest.raises(ValueError, match="--learners nobody: the study has no such learner"):
        StudyPlan(study, None, ["nobody"])


@pytest.mark.slow
@pytest.mark.processes
def test_an_interrupted_study_resumes_and_the_runs_that_failed_are_in_its_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("BREAK", "1")
    task = {"environment": VALUES["environment"], "steps": 960}
    tasks = {
        "short": {**task, "utility": VALUES["utility"]},
        "broken": {**task, "utility": {"name": broken_utility(tmp_path, "BREAK")}},
    }
    file, study = write_study(tmp_path, tasks=tasks), tmp_path / "study"
    with forked_workers():
        assert main(["--config", str(file), "--output", str(study), "--workers", "1"]) == 1
        results = read_rows(study / "results.csv")
        assert {row.state for row in results if row.task == "broken"} == {"failed"}
        finished = [row for row in results if row.task == "short"]
        assert {(row.learner, row.seed) for row in finished} == {
            (learner, seed) for learner in ("mo", "plain") for seed in (0, 1)
        }
        assert all(row.value is not None and row.cpu_seconds for row in finished)
        shutil.rmtree(next(study / row.directory for row in read_manifest(study) if row.trial is None))
        monkeypatch.delenv("BREAK")
        assert main(["--config", str(file), "--output", str(study), "--workers", "1"]) == 0
    again = read_rows(study / "results.csv")
    values = [dataclasses.replace(row, cpu_seconds=None) for row in finished]
    assert [dataclasses.replace(row, cpu_seconds=None) for row in again if row.task == "short"] == values
    assert {row.state for row in again} == {"finished"}
    assert all(status(study / row.directory)["state"] == "finished" for row in read_manifest(study))
