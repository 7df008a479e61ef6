"""The other libraries' learners in scripts/peer_comparison.py, in a separate virtual environment: `make test-peers`."""

from __future__ import annotations

import inspect
from importlib import import_module
from typing import TYPE_CHECKING

import pytest

from algorithms import ALGORITHMS
from algorithms.peers import PEERS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType


pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


def skip_without(learner: str) -> None:
    reason = PEERS[learner].unavailable_reason()
    if reason is not None:
        pytest.skip(reason)


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("peer_comparison")


@pytest.mark.parametrize(
    ("task", "learner", "steps"),
    [
        ("known utility", "stable_baselines3.ppo", 1024),
        ("fixed, continuous", "morl_baselines.capql", 60),
        ("fixed, discrete", "morl_baselines.envelope", 60),
    ],
)
def test_other_libraries_are_trained_and_scored(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, task: str, learner: str, steps: int
) -> None:
    skip_without(learner)
    monkeypatch.setattr(script, "UTILITY_EPISODES", 10)
    found = script.learn(script.Run(task, learner, 1 / 3, 0, steps))
    assert (found.task, found.learner, found.rate, found.steps) == (task, learner, "0.333", steps)
    assert found.taken >= steps
    assert found.seconds > 0.0
    assert found.second <= 1.0


def test_the_default_learning_rates_are_those_of_the_libraries(script: ModuleType) -> None:
    for name, learner in ((name, learner) for task in script.TASKS.values() for name, learner in task.learners.items()):
        if name not in PEERS:
            assert ALGORITHMS[name].Config().learning_rate == learner.learning_rate
            continue
        skip_without(name)
        module, _, attribute = PEERS[name].path.partition(":")
        bases = getattr(import_module(module), attribute).__mro__
        parameters = [inspect.signature(base.__init__).parameters for base in bases]
        [rate, *_] = [each["learning_rate"].default for each in parameters if "learning_rate" in each]
        assert rate == learner.learning_rate, name


def test_a_comparison_is_continued(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    skip_without("stable_baselines3.ppo")
    task = script.TASKS["known utility"]
    learners = {name: task.learners[name] for name in ("ppo", "stable_baselines3.ppo")}
    monkeypatch.setattr(script, "TASKS", {"known utility": script.Task({}, learners, known_utility=True)})
    made = []

    def learn(_learn: object, runs: list[object], _workers: int) -> list[object]:
        made.append(len(runs))
        return [
            script.Result(run.task, run.learner, f"{run.rate:.3g}", run.seed, run.steps, run.steps, 1.0, 0.5, 2.0)
            for run in runs
        ]

    monkeypatch.setattr(script.tuned_comparison, "_learn_in_new_processes", learn)
    arguments = ["--only", "known utility", "--seeds", "2", "--output", str(tmp_path / "found.csv")]
    script.main(arguments)
    assert made == [9, 6]
    script.main(arguments)
    assert made == [9, 6]
    assert len(script.tuned_comparison.read_results(tmp_path / "found.csv", script.Result)) == 15
    assert "stable_baselines3.ppo" in capsys.readouterr().out
