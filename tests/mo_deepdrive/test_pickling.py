"""What users are given can be copied, pickled and sent to processes that are spawned."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import cloudpickle
import gymnasium
import mo_gymnasium
import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.utilities import LINEAR, NONLINEAR, Utility, make_utility
from mo_deepdrive.world.scenarios import SCENARIOS
from mo_deepdrive.wrappers import (
    ParallelUtilityReward,
    ScaledObservation,
    UtilityReward,
    VectorScaledObservation,
    VectorUtilityReward,
)

INTERSECTION = SCENARIOS["intersection"].id
LEFT_TURN = SCENARIOS["left_turn"].id
COPIES = pytest.mark.parametrize(
    "copied",
    [copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each)), lambda each: pickle.loads(cloudpickle.dumps(each))],
    ids=["deepcopy", "pickle", "cloudpickle"],
)
TWO = ("distance", "jerk")
FIRST = lambda returns, factor=1.0: factor * returns[..., 0]  # noqa: E731  (a name under which it can be imported)
UTILITIES: dict[str, tuple[Any, ...]] = {
    **{name: (name, tuple(weights)) for name, weights in LINEAR.items()},
    **{name: (name, needed) for name, (needed, _) in NONLINEAR.items()},
    "linear": ("linear", TWO, {"weights": np.array([1.0, 0.5])}),
    "augmented_chebyshev": ("augmented_chebyshev", TWO, {"weights": {"jerk": 1.0}, "ideal": [0, 1], "rho": 0.1}),
    "generalised_gini": ("generalised_gini", TWO, {"weights": [2, 1], "scales": {"jerk": 500.0}}),
    "own": (f"{__name__}:FIRST", TWO),
    "own with arguments": (f"{__name__}:FIRST", TWO, {"factor": 2.0}),
}


def utility_of(name: str, cost_sign: str = "maximise") -> Utility:
    named, objectives, *arguments = UTILITIES[name]
    return make_utility(named, objectives, cost_sign, **dict(*arguments))


@COPIES
@pytest.mark.parametrize("cost_sign", ["maximise", "paper"])
@pytest.mark.parametrize("name", UTILITIES)
def test_a_copy_of_a_utility_gives_the_same(name: str, cost_sign: str, copied: Callable[[Any], Any]) -> None:
    utility = utility_of(name, cost_sign)
    returns = np.random.default_rng(0).normal(size=(20, len(utility.objectives)))
    np.testing.assert_array_equal(copied(utility)(returns), utility(returns))


ENVS: dict[str, Callable[[], Any]] = {
    **{f"single {each.name}": partial(mo_gymnasium.make, each.id) for each in SCENARIOS.values()},
    "measured": partial(mo_gymnasium.make, LEFT_TURN, objectives=["time", "near_miss"]),
    "vector": partial(gymnasium.make_vec, INTERSECTION, num_envs=2, threads=2, time_limit=1.0),
    "drawn": partial(mo_gymnasium.make, LEFT_TURN, render_mode="rgb_array"),
    "parallel": mo_deepdrive.parallel_env,
    "AEC": mo_deepdrive.env,
    "utility": lambda: UtilityReward(mo_gymnasium.make(LEFT_TURN), "left_turn_risk_averse", of="return"),
    "utilities": lambda: ParallelUtilityReward(mo_deepdrive.parallel_env(), "intersection_linear", of="return"),
    "vector utility": lambda: VectorUtilityReward(
        gymnasium.make_vec(LEFT_TURN, num_envs=2), "left_turn_linear", of="return"
    ),
    "scaled": lambda: ScaledObservation(mo_gymnasium.make(LEFT_TURN)),
    "vector scaled": lambda: VectorScaledObservation(gymnasium.make_vec(INTERSECTION, num_envs=2)),
}


def drive(env: Any, decisions: int) -> str:
    """What the environment gives for the same action again and again."""
    given = []
    for _ in range(decisions):
        if hasattr(env, "agent_selection"):
            env.step(3)
            given.append(env.last())
        elif hasattr(env, "agents"):
            given.append(env.step(dict.fromkeys(env.agents, 3)))
        else:
            given.append(env.step(3 if env.action_space.shape == () else np.full(env.action_space.shape, 3)))
    return repr(given)


@COPIES
@pytest.mark.parametrize("name", ENVS)
def test_a_copy_of_an_environment_continues_where_it_was(name: str, copied: Callable[[Any], Any]) -> None:
    env = ENVS[name]()
    env.reset(seed=1)
    drive(env, 5)
    if name == "drawn":
        env.render()
    again = copied(env)
    assert drive(again, 25) == drive(env, 25)
    assert repr(again.reset()) == repr(env.reset()), "the random streams are copied, too"


@pytest.mark.slow
def test_a_spawned_process_takes_an_environment_with_its_utility() -> None:
    env = UtilityReward(mo_gymnasium.make(LEFT_TURN), "left_turn_risk_averse", of="return")
    env.reset(seed=3)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        theirs = pool.apply(drive, (env, 5))
    assert theirs == drive(env, 5)
