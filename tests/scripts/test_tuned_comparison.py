"""``scripts/tuned_comparison.py``: which runs a comparison makes, and how it is continued."""

from __future__ import annotations

from argparse import ArgumentParser
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType

LEARNERS = [("a task", "one", 500), ("a task", "other", 500), ("another task", "one", 900)]
SEEDS = [3, 4]


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("tuned_comparison")


def result(script: ModuleType, run: Any, first: float) -> Any:
    return script.Result(run.task, run.learner, f"{run.rate:.3g}", run.seed, run.steps, run.steps + 7, first, 0.5, 1.25)


def test_every_learner_is_tuned_with_as_many_runs_and_then_trained_with_the_best_rate(script: ModuleType) -> None:
    tuning = script.missing_runs([], LEARNERS, SEEDS)
    assert [(run.task, run.learner, run.steps) for run in tuning] == [each for each in LEARNERS for _ in script.RATES]
    assert {run.seed for run in tuning} == {script.TUNING_SEED}
    tuned = [result(script, run, 1.0 if run.rate == 3.0 else 0.0) for run in tuning]
    final = script.missing_runs(tuned, LEARNERS, SEEDS)
    assert [(run.task, run.learner, run.steps) for run in final] == [each for each in LEARNERS for _ in SEEDS]
    assert {run.rate for run in final} == {3.0}
    assert [run.seed for run in final[:2]] == SEEDS
    done = [*tuned, *(result(script, run, 1.0) for run in final)]
    assert script.missing_runs(done, LEARNERS, SEEDS) == []
    assert len(script.missing_runs(done, LEARNERS, [*SEEDS, 5])) == len(LEARNERS)
    assert len(script.missing_runs(done, [("a task", "one", 600)], SEEDS)) == len(script.RATES)


def test_a_learner_that_is_tuned_does_not_wait_for_others(script: ModuleType) -> None:
    tuning = script.missing_runs([], LEARNERS, SEEDS)
    tuned = [result(script, run, run.rate) for run in tuning if run.learner == "other"]
    runs = script.missing_runs(tuned, LEARNERS, SEEDS)
    assert [run.seed for run in runs if run.learner == "other"] == SEEDS
    assert len(runs) == len(SEEDS) + 2 * len(script.RATES)


def test_the_file_has_what_tells_runs_apart(script: ModuleType, tmp_path: Path) -> None:
    run = script.Run("a task", "one", 1 / 3, 100, 500)
    file = tmp_path / "results.csv"
    assert script.read_results(file, script.Result) == []
    script.write_results(file, [result(script, run, 0.25)])
    [read] = script.read_results(file, script.Result)
    assert read == script.Result("a task", "one", "0.333", 100, 500, 507, 0.25, 0.5, 1.2)
    assert read.key == run.key


def test_the_seeds_that_count_are_not_that_of_the_tuning(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="seeds = 99 to 101: 100 is that of the tuning; take fewer seeds"):
        script.complete(tmp_path / "results.csv", LEARNERS, range(99, 102), lambda run: result(script, run, 0.0), 1)


def test_a_continued_comparison_chooses_as_one_in_one_go(script: ModuleType) -> None:
    tuning = script.missing_runs([], LEARNERS[:1], SEEDS)
    scores = {1.0: 0.1234561, 3.0: 0.1234563, 1 / 3: 0.0}  # equal in the file
    tuned = [result(script, run, scores[run.rate]) for run in tuning]
    assert {run.rate for run in script.missing_runs(tuned, LEARNERS[:1], SEEDS)} == {1.0}


def test_a_comparison_makes_what_is_missing(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []

    def in_this_process(learn: Any, runs: Any, _workers: int) -> Any:
        made.extend(runs)
        return map(learn, runs)

    monkeypatch.setattr(script, "_learn_in_new_processes", in_this_process)
    file = tmp_path / "results.csv"
    known = script.Run("a task", "one", 1.0, script.TUNING_SEED, 500)
    script.write_results(file, [result(script, known, 9.0)])
    results = script.complete(file, LEARNERS[:1], SEEDS, lambda run: result(script, run, run.rate), 1)
    assert [(run.rate, run.seed) for run in made] == [(3.0, 100), (1 / 3, 100), (1.0, 3), (1.0, 4)]
    assert [each.key for each in script.read_results(file, script.Result)] == [each.key for each in results]
    assert len(results) == 1 + len(made)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "--seeds 0 must be at least 1"),
        (["--workers", "0"], "--workers 0 must be at least 1"),
        (["--output", "nowhere/found.csv"], "there is no folder nowhere"),
    ],
)
def test_invalid_arguments_are_refused(
    script: ModuleType, tmp_path: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = ArgumentParser()
    script.add_arguments(parser, ["a task"])
    script.check_arguments(parser, parser.parse_args(["--output", str(tmp_path / "found.csv")]))
    with pytest.raises(SystemExit) as end:
        script.check_arguments(parser, parser.parse_args(["--output", str(tmp_path / "found.csv"), *arguments]))
    assert end.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())
