"""Functions of NumPy arrays as policies: what they are given, and that they act as the same agent does."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from algorithms import MOA2C
from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.utilities import make_utility

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
INTERSECTION = "mo-deepdrive-intersection-v0"
SEA = "deep-sea-treasure-v0"
ROOMS = "four-room-v0"


def idle(observations: Any, _accrued: Any, _discounts: Any) -> Any:
    return np.zeros(observations.shape[:-1], dtype=np.int64)


@pytest.mark.parametrize(
    ("env_id", "arguments"),
    [
        (ONE_WAYPOINT, {"time_limit": 3.0}),
        (ONE_WAYPOINT, {"time_limit": 3.0, "action_type": "continuous"}),
        (INTERSECTION, {"time_limit": 3.0}),
        (INTERSECTION, {"time_limit": 3.0, "action_type": "continuous"}),
        (SEA, {"max_episode_steps": 9}),
        (ROOMS, {"max_episode_steps": 9}),
    ],
    ids=str,
)
def test_a_function_that_acts_as_an_agent_gets_its_evaluation(env_id: str, arguments: dict[str, Any]) -> None:
    env = make_env(env_id, 6, arguments)  # as many as evaluate makes: products of other sizes round differently
    adapter = EnvAdapter(env)
    d = len(adapter.objectives)
    agent = MOA2C(env, make_utility("linear", adapter.objectives, weights=np.linspace(1.0, 0.1, d)), gamma=0.9)
    for learner in agent.learners:  # actions that depend on the observation and on the accrued reward
        with torch.no_grad():
            learner.actor.body[-1].weight.mul_(100.0)
    vehicles = adapter.vehicles

    def function(observations: Any, accrued: Any, discounts: Any) -> Any:
        if vehicles == 1:
            accrued, discounts = accrued[:, None], discounts[:, None]
        past = AccruedReward(accrued, discounts, np.zeros(discounts.shape, dtype=np.int64))
        return adapter.environment_actions(agent.act(adapter.policy_observations(observations), past, None))

    expected = evaluate(agent, env, episodes=6, seed=40, gamma=0.9)
    found = evaluate(function, env_id, episodes=6, seed=40, gamma=0.9, env_kwargs=arguments)
    for name, array in vars(expected).items():
        if isinstance(array, np.ndarray):
            np.testing.assert_array_equal(getattr(found, name), array, err_msg=name)
    assert found.utilities == ()


@pytest.mark.parametrize(
    ("env_id", "shapes"),
    [
        (ONE_WAYPOINT, [(5, 15), (5, 4), (5,)]),
        (INTERSECTION, [(5, 2, 29), (5, 2, 6), (5, 2)]),
        (ROOMS, [(5, 14), (5, 3), (5,)]),
    ],
)
def test_a_function_is_given_what_the_documentation_says(env_id: str, shapes: list[tuple[int, ...]]) -> None:
    calls = []

    def function(*inputs: Any) -> Any:
        calls.append(inputs)
        return np.zeros(inputs[2].shape, dtype=np.int64)

    evaluate(function, env_id, episodes=5, seed=1, gamma=0.5)
    assert [array.shape for array in calls[0]] == shapes
    assert calls[0][0].dtype == (np.int32 if env_id == ROOMS else np.float32)
    for i, (_, _, discounts) in enumerate(calls[:4]):  # each call has arrays of its own
        np.testing.assert_array_equal(discounts, 0.5**i)


WHOLE = {"action_type": "continuous"}


@pytest.mark.parametrize(
    ("env_id", "arguments", "returned", "message"),
    [
        (ONE_WAYPOINT, {}, lambda n: 0, r"the policy returned actions of shape \(\); expected \(3,\) integers"),
        (INTERSECTION, {}, lambda n: np.zeros(n), r"shape \(3,\); expected \(3, 2\)"),
        (SEA, {}, lambda n: np.zeros(n - 1), r"shape \(2,\); expected \(3,\)"),
        (ONE_WAYPOINT, {}, lambda n: (np.zeros(n, int), None), "the policy returned tuple, no array: .*; expected"),
        (ONE_WAYPOINT, {}, lambda n: np.zeros(n), r"dtype float64; expected \(3,\) integers"),
        (ONE_WAYPOINT, {}, lambda n: np.full(n, 22), "returned the action 22; it must be from 0 to 21"),
        (SEA, {}, lambda n: np.full(n, 4), "returned the action 4; it must be from 0 to 3"),
        (ONE_WAYPOINT, WHOLE, lambda n: np.full((n, 3), np.nan), "returned the action nan; it must be finite"),
        (ONE_WAYPOINT, WHOLE, lambda n: np.zeros((n, 3), bool), r"dtype bool; expected \(3, 3\) numbers"),
    ],
)
def test_actions_that_are_none_of_the_environment_are_refused(
    env_id: str, arguments: dict[str, Any], returned: Callable[[int], Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(lambda observations, *_: returned(len(observations)), env_id, episodes=3, env_kwargs=arguments)


WITHOUT_TORCH = """
import sys
import numpy as np
from mo_deepdrive.evaluation import evaluate
idle = lambda observations, accrued, discounts: np.zeros(len(observations), dtype=int)
evaluate(idle, "mo-deepdrive-one-waypoint-v0", episodes=2, env_kwargs={"time_limit": 1.0})
sys.exit(str({"torch", "algorithms"} & set(sys.modules) or ""))
"""


@pytest.mark.slow
def test_a_function_is_evaluated_without_torch_and_the_algorithms() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_TORCH], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""
