"""Plans: their format, their evaluation compared with a replay, rules that arrive, and offspring."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mo_deepdrive.fronts.reference_fronts import front_config
from mo_deepdrive.world.action_sequences import decode as decode_actions
from mo_deepdrive.world.action_sequences import discounted_sum
from mo_deepdrive.world.action_sequences import encode as encode_actions
from mo_deepdrive.world.action_sequences import replay as replay_sequences
from scripts.bounds.front import record_run
from scripts.bounds.plans import CRITERIA, PlanEvaluator, PlanFormat, random_calm_rules, random_rules
from scripts.bounds.variation import FULL_SCALE, make_offspring


@pytest.mark.parametrize("action_type", ["discrete", "discrete-16"])
def test_discrete_sequences_come_back_without_the_idle_actions_at_their_end(action_type: str) -> None:
    plan_format = PlanFormat(action_type, 8)
    sequences = [np.array([3, 0, 5, 0]), np.array([0, 0]), np.array([], dtype=np.int64)]
    plans = plan_format.from_sequences(sequences)
    assert plans.shape == (3, 8, 1)
    assert [plan_format.to_sequence(plan).tolist() for plan in plans] == [[3, 0, 5], [], []]


def test_continuous_actions_are_stored_in_units() -> None:
    plan_format = PlanFormat("continuous", 4)
    (plan,) = plan_format.from_sequences([np.array([[0.5, 1.0, -1.0], [0.0, 0.0, 0.25]])])
    half, quarter = FULL_SCALE // 2, FULL_SCALE // 4
    expected = [[half, FULL_SCALE, -FULL_SCALE], [0, 0, quarter], [0, 0, -FULL_SCALE], [0, 0, -FULL_SCALE]]
    assert plan.tolist() == expected


def test_continuous_actions_of_a_run_are_rounded_to_what_can_be_written(make_run: Callable[..., Path]) -> None:
    path = make_run("mo-deepdrive-static-obstacle-v0", action_type="continuous")
    sequences = record_run(str(path), "static_obstacle", "continuous", 2).sequences
    plan_format = PlanFormat("continuous", 600)
    plans = plan_format.from_sequences(sequences)
    for plan, sequence in zip(plans, sequences, strict=True):
        written = plan_format.to_sequence(plan)
        np.testing.assert_allclose(written, sequence[: len(written)], atol=0.5 / 1024)
        np.testing.assert_array_equal(decode_actions(encode_actions(written), "continuous"), written)


@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle"])
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_returns_are_those_of_a_replay(scenario: str, action_type: str) -> None:
    evaluator = PlanEvaluator(front_config(scenario, action_type))
    rules = random_calm_rules(8, np.random.default_rng(1))
    evaluated = evaluator.evaluate(evaluator.format.idle_plans(8), 3, rules)
    sequences = [evaluator.format.to_sequence(plan) for plan in evaluated.plans]
    for returns, criterion in zip(evaluated.returns, CRITERIA, strict=True):
        objectives = {"objectives": criterion.objectives(scenario)}
        config = front_config(scenario, action_type).model_copy(update=objectives)
        expected = discounted_sum(replay_sequences(config, sequences), criterion.gamma)
        np.testing.assert_allclose(returns, expected, rtol=1e-5, atol=2e-5)
    assert evaluated.sources.tolist() == [3] * 8
    assert evaluator.simulated_decisions == evaluated.lengths.sum()


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle"])
@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
@pytest.mark.parametrize("draw", [random_rules, random_calm_rules])
def test_some_random_rules_arrive(scenario: str, action_type: str, draw: Callable[..., NDArray[Any]]) -> None:
    evaluator = PlanEvaluator(front_config(scenario, action_type))
    rules = draw(256, np.random.default_rng(0))
    evaluated = evaluator.evaluate(evaluator.format.idle_plans(256), 0, rules)
    destination = evaluator.batch.objectives.index("destination")
    assert (evaluated.returns[1][:, destination] == 1.0).any()


@pytest.mark.parametrize("n_actions", [0, 16, 22])
def test_offspring_are_valid_plans_and_differ_from_their_parents(n_actions: int) -> None:
    rng = np.random.default_rng(0)
    k = 1 if n_actions else 3
    idle = np.array([0] if n_actions else [0, 0, -1024], dtype=np.int16)
    low, high = (0, n_actions) if n_actions else (-1024, 1025)
    parents = np.repeat(rng.integers(low, high, (300, 12, k)), 5, axis=1).astype(np.int16)
    lengths = rng.integers(0, 61, 300)
    offspring = np.tile(idle, (300, 60, 1))
    make_offspring(parents, lengths, parents[::-1].copy(), lengths[::-1].copy(), offspring, n_actions, idle, rng)
    assert offspring.min() >= low
    assert offspring.max() < high
    same = [np.array_equal(*each) for each in zip(offspring, parents, strict=True)]
    assert sum(same) < 100
