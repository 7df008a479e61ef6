"""``scripts/peer_comparison.py``: which runs it makes, and what it writes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from tests.helpers.script_runs import refused

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

    from tests.helpers.script_runs import Call


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("peer_comparison")


def result(script: ModuleType, run: Any, first: float) -> Any:
    return script.Result(run.task, run.learner, f"{run.rate:.3g}", run.seed, run.steps, run.steps, first, 0.5, 1.25)


def test_runs_have_the_same_time_and_differ_in_the_learning_rate_alone(script: ModuleType) -> None:
    for name, task in script.TASKS.items():
        for learner, settings in task.learners.items():
            steps = script.steps_of(name, learner, 0.5)
            assert steps == 30 * settings.speed
            first, second = (
                script.make_run_experiment(script.Run(name, learner, rate, 3, steps)).to_dict() for rate in (1.0, 3.0)
            )
            places = [each["algorithm"].get("arguments", each["algorithm"]) for each in (first, second)]
            rates = [place.pop("learning_rate") for place in places]
            assert rates == pytest.approx([settings.learning_rate, 3.0 * settings.learning_rate])
            assert first == second
            assert first["training"]["total_timesteps"] == steps


@pytest.mark.parametrize(
    ("task", "growth"),
    [("fixed, discrete", 0.0), ("drawn, discrete", 0.0), ("fixed, continuous", 0.15), ("drawn, continuous", 0.15)],
)
def test_costs_grow_as_in_the_runs_of_the_file(script: ModuleType, task: str, growth: float) -> None:
    run = script.Run(task, "conditioned_mo_ppo", 1.0, 0, 10_000)
    assert script.make_run_experiment(run).algorithm.config.cost_growth == growth


def test_this_packages_learners_are_also_trained_for_the_others_steps(script: ModuleType) -> None:
    rows = script.all_learners(["fixed, continuous", "drawn, discrete"], 1.0)
    assert rows[:6] == [
        ("fixed, continuous", "conditioned_mo_ppo", 9_600_000),
        ("fixed, continuous", "pcn", 960_000),
        ("fixed, continuous", "morl_baselines.capql", 4_920),
        ("fixed, continuous", "morl_baselines.gpi_ls_continuous", 2_520),
        ("drawn, discrete", "conditioned_mo_ppo", 9_000_000),
        ("drawn, discrete", "morl_baselines.envelope", 660),
    ]
    assert rows[6:] == [
        ("fixed, continuous", "conditioned_mo_ppo", 4_920),
        ("fixed, continuous", "pcn", 4_920),
        ("fixed, continuous", "conditioned_mo_ppo", 2_520),
        ("fixed, continuous", "pcn", 2_520),
        ("drawn, discrete", "conditioned_mo_ppo", 660),
    ]


@pytest.mark.parametrize(("steps", "num_envs"), [(1_020, 1), (5_580, 2), (6_000_000, 256)])
def test_few_steps_are_taken_in_few_environments(script: ModuleType, steps: int, num_envs: int) -> None:
    run = script.Run("fixed, continuous", "conditioned_mo_ppo", 1.0, 0, steps)
    assert script.make_run_experiment(run).training.num_envs == num_envs


def test_tuning_is_scored_on_the_validation_split_and_the_rest_on_the_test_split(script: ModuleType) -> None:
    splits = [
        script.make_run_experiment(
            script.Run("drawn, discrete", "conditioned_mo_ppo", 1.0, seed, 100)
        ).evaluation.final_seed
        for seed in (script.TUNING_SEED, 0)
    ]
    assert splits == [script.SPLITS["validation"].start, script.SPLITS["test"].start]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "learner"),
    [("known utility", "ppo"), ("fixed, continuous", "conditioned_mo_ppo"), ("drawn, discrete", "conditioned_mo_ppo")],
)
def test_a_run_is_trained_and_scored(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, task: str, learner: str
) -> None:
    monkeypatch.setattr(script, "DRAWN_EPISODES", 5)
    found = script.learn(script.Run(task, learner, 3.0, 0, 8192))
    assert (found.task, found.learner, found.rate, found.steps) == (task, learner, "3", 8192)
    assert found.taken >= 8192
    assert found.seconds > 0.0
    low, high = (-100.0, 20.0) if task == "known utility" else (0.0, 42_000.0)
    assert low <= found.first <= high
    assert -1.0 <= found.second <= 1.0  # success, or the expected utility, which can be negative


def test_the_table_leaves_tuning_out(script: ModuleType) -> None:
    runs = [script.Run("known utility", "ppo", 1.0, seed, 500) for seed in (script.TUNING_SEED, 0, 1, 2)]
    results = [result(script, run, float(run.seed)) for run in runs]
    [row] = script.table_rows(results)
    assert row[:6] == ["known utility", "ppo", "1", "3", "500", "1"]
    assert row[6].startswith("utility_esr 1.0 [")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--minutes", "0"], "--minutes 0.0 must be at least 0.001"),
        (["--only", "intersection"], "invalid choice: 'intersection'"),
    ],
)
@pytest.mark.usefixtures("script")
def test_invalid_arguments_are_refused(call: Call, arguments: list[str], message: str) -> None:
    refused(call("peer_comparison", "--output", "found.csv", *arguments), message)
