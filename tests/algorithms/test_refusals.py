"""Hyperparameters, utilities and environments that an algorithm cannot learn with are refused by name."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from algorithms import A2C, MAPPO, MOA2C, MOCAC, MOPPO, PCN, PPO, ConditionedMOPPO
from algorithms.actor_critic import ActorCritic
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.utilities import make_utility
from tests.helpers.agents import CLASSES, INTERSECTION, ONE_WAYPOINT, SEA, make_agent

BUDGETS = {"g_force": 8.0, "jerk": 150.0}
MIXTURE = {"families": {"linear": 0.4, "comfort_budget": 0.6}, "budgets": BUDGETS}
# Of every actor-critic.
COMMON: list[tuple[dict[str, Any], str]] = [
    ({"learning_rate": 0.0}, "'learning_rate' = 0.0"),
    ({"learning_rate": "1e-3"}, "'learning_rate' = '1e-3'"),
    ({"learning_rate": math.nan}, "'learning_rate' = nan"),
    ({"learning_rate_end": -1e-3}, "'learning_rate_end' = -0.001"),
    ({"gamma": 1.01}, "'gamma' = 1.01"),
    ({"gae_lambda": 2.0}, "'gae_lambda' = 2.0"),
    ({"steps": 0}, "'steps' = 0"),
    ({"steps": "16"}, "'steps' = '16'"),
    ({"hidden": []}, r"'hidden' = \[\]"),
    ({"hidden": [64, -32]}, "'hidden.1' = -32"),
    ({"entropy_start": 0.0}, "entropy_start"),
    ({"entropy_end": 0.0}, "entropy_end"),
    ({"entropy_until": 1.1}, "'entropy_until' = 1.1"),
    ({"value_coefficient": 0.0}, "'value_coefficient' = 0.0"),
    ({"max_grad_norm": -0.5}, "'max_grad_norm' = -0.5"),
    ({"normalise_advantages": "yes"}, "'normalise_advantages' = 'yes'"),
    ({"objective_scales": [1.0, 1.0, 1.0]}, "objective_scales = .* needs 4 numbers"),
    ({"objective_scales": [1.0, 1.0, 1.0, 0.0]}, "'objective_scales.3' = 0.0"),
    ({"learning_rat": 1}, "'learning_rat' is unknown; did you mean 'learning_rate'"),
    ({"entropy_begin": 1}, "'entropy_begin' is unknown; did you mean 'entropy_end'"),
    ({"n_steps": 1}, "'n_steps' is unknown; did you mean 'steps'"),
    ({"centralised_critic": True}, "centralised_critic = True needs an environment with more than one vehicle"),
    (
        {"utility": make_utility("linear", ("distance", "jerk"), weights=[1.0, 1.0])},
        "'linear' takes .*'distance', 'jerk'.*the environment has",
    ),
]
# Of single ones: algorithm, environment, settings, message.
OWN: list[tuple[Any, str, dict[str, Any], str]] = [
    (A2C, ONE_WAYPOINT, {"value_scale": 0.0}, "'value_scale' = 0.0"),
    (MOA2C, ONE_WAYPOINT, {"advantage": "as_print"}, r"'advantage' = 'as_print'.*'as_printed'"),
    (MOA2C, ONE_WAYPOINT, {"observe_discount": "no"}, "'observe_discount' = 'no'"),
    (MOA2C, ONE_WAYPOINT, {"accrued_discount": 0.0}, "'accrued_discount' = 0.0"),
    *(
        (
            cls,
            ONE_WAYPOINT,
            {"advantage": "expected_utility", "accrued_discount": 0.9},
            "gamma = 0.99 must be at most accrued_discount = 0.9 with advantage =",
        )
        for cls in (MOA2C, MOPPO)
    ),
    (PPO, "four-room-v0", {"cost_growth": 0.25}, "cost_growth = 0.25 must be 0 in .*four-room.*none of its objectives"),
    *((cls, ONE_WAYPOINT, {"epochs": 0}, "'epochs' = 0") for cls in (PPO, MOPPO)),
    (PPO, ONE_WAYPOINT, {"minibatches": 0}, "'minibatches' = 0"),
    *((PPO, ONE_WAYPOINT, {"clip": clip}, f"'clip' = {clip}") for clip in (0.0, 1.0)),
    (PPO, ONE_WAYPOINT, {"minibatch": 4}, "did you mean 'minibatches'"),
    (MAPPO, INTERSECTION, {"joint": "best_off"}, r"'joint' = 'best_off'.*'sum', 'worst_off' or 'gini'"),
    (MAPPO, ONE_WAYPOINT, {}, "one-waypoint-v0 has one vehicle; algorithm 'mappo' is for a team"),
    (MOCAC, ONE_WAYPOINT, {"critic": "categorical"}, r"11\^4 = 14,641 cells; at most 4,096"),
    (MOCAC, SEA, {"critic": "categorical", "atoms": 65}, r"65\^2 = 4,225 cells"),
    (MOCAC, SEA, {"critic": "categorical", "atoms": 1}, "atoms = 1 must be at least 2"),
    (MOCAC, SEA, {"critic": "gaussian"}, "'critic' = 'gaussian'"),
    (MOCAC, SEA, {"v_min": [0.0]}, r"v_min = \[0.0\] needs 2 numbers"),
    (MOCAC, SEA, {"v_max": []}, r"v_max = \[\] needs 2 numbers"),
    (MOCAC, SEA, {"v_min": [0.0, 5.0], "v_max": [1.0, 5.0]}, "must be below v_max"),
    (MOCAC, SEA, {"gamma": 0.0}, "'gamma' = 0.0"),
    (MOCAC, SEA, {"target_rate": 0.0}, "'target_rate' = 0.0"),
    (PCN, INTERSECTION, {}, "algorithm 'pcn' drives one vehicle; the environment has 2"),
    (PCN, SEA, {"hidden": [8, 0]}, "'hidden.1' = 0: Input should be greater than or equal to 1"),
    (PCN, SEA, {"objective_scales": [1.0, 0.0]}, "'objective_scales.1' = 0.0: Input should be greater than 0"),
    (PCN, ONE_WAYPOINT, {"objective_scales": [1.0, 1.0]}, r"= \[1.0, 1.0\] needs 4 numbers: \('distance', "),
    *(
        (PCN, SEA, {name: value}, f"'{name}' = {value}")
        for name, value in {
            "horizon_scale": 0.0,
            "gamma": 0.0,
            "persistence": 1.0,
            "exploration": 1.1,
            "buffer_size": 1,
            "return_noise": -1.0,
            "horizon_reduction": -1,
        }.items()
    ),
    *(
        (ConditionedMOPPO, ONE_WAYPOINT, settings, message)
        for settings, message in (
            ({"families": {"quadratic": 1.0}}, "quadratic"),
            ({"families": {"linear": 0.0}}, "must have a positive share of one of linear, chebyshev, comfort_budget"),
            ({"families": {"linear": -1.0}}, "-1.0"),
            ({"families": {"comfort_budget": 1.0}}, "budgets = {} must name the largest budget"),
            ({"budgets": BUDGETS}, "must name the largest budget of at least one objective if and only if"),
            ({**MIXTURE, "budgets": {"time": 5.0}}, r"budgets has 'time'; the objectives are \('distance', "),
            ({**MIXTURE, "budgets": {"jerk": 0.0}}, "jerk' = 0.0"),
            ({"families": {"linear": 1e308, "chebyshev": 1e308}}, r"'families.linear' = 1e\+308"),
            ({"concentration": 0.0}, "'concentration' = 0.0"),
            ({"concentration": 1e300}, r"'concentration' = 1e\+300"),
            ({"emphasis": {"jerk": 0.0}}, "'emphasis.jerk' = 0.0"),
            ({"emphasis": {"comfort": 1.0}}, r"emphasis has 'comfort'; the objectives are \('distance', "),
            ({"entropy_start": 0.0}, "must both be positive or both be 0"),
            ({"objective_scales": [1.0]}, "needs 4 numbers"),
            ({"max_policies": 0}, "'max_policies' = 0"),
            ({"env": {"cost_sign": "paper"}}, "cost_sign = 'paper'"),
        )
    ),
]


@CLASSES
@pytest.mark.parametrize(("settings", "message"), COMMON, ids=[str([*settings]) for settings, _ in COMMON])
def test_what_no_actor_critic_can_learn_with_is_refused_by_name(
    cls: type[ActorCritic], settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_agent(cls, **settings)


@pytest.mark.parametrize(("cls", "env_id", "settings", "message"), OWN)
def test_what_an_algorithm_cannot_learn_with_is_refused_by_name(
    cls: Any, env_id: str, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_agent(cls, env_id, **settings)


@CLASSES
@pytest.mark.parametrize("number", [1, 3])
def test_the_wrong_number_of_utilities_is_refused(cls: type[ActorCritic], number: int) -> None:
    utility = make_utility("intersection_linear", EnvAdapter(make_env(INTERSECTION, 1)).objectives)
    with pytest.raises(ValueError, match=f"{number} utilities are given for 2 vehicles"):
        make_agent(cls, INTERSECTION, utility=[utility] * number)
    assert make_agent(cls, INTERSECTION, utility=utility).utilities == [utility, utility]


def test_an_agent_takes_its_config_or_single_hyperparameters() -> None:
    config = PPO.Config(steps=8, gamma=0.9)
    assert make_agent(PPO, config=config).config is config
    assert make_agent(PPO, steps=8, gamma=0.9).config == config
    with pytest.raises(ValueError, match="gamma: give either config or single hyperparameters"):
        make_agent(PPO, config=config, gamma=0.9)
    with pytest.raises(ValueError, match=r"config of class PPO.Config must be an instance of A2C.Config"):
        make_agent(A2C, config=config)


def test_a_utility_is_given_by_name_or_as_a_function() -> None:
    env = make_env(ONE_WAYPOINT, 2)
    assert [each.name for each in A2C(env, "one_waypoint_linear").utilities] == ["one_waypoint_linear"]
    (utility,) = A2C(env, lambda returns: returns[..., 0]).utilities
    assert utility(np.array([3.0, 1.0, 0.0, 0.0])) == 3.0


def test_an_objective_of_pcn_with_the_name_of_a_column_of_commands_is_refused() -> None:
    env = make_env(SEA, 1)
    env.envs[0].unwrapped.objectives = ("treasure", "horizon")  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="an objective is named 'horizon'"):
        PCN(env)
