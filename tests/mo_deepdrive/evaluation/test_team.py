"""Several policies as one: a member per vehicle, and members that take turns."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from algorithms import MOA2C
from algorithms.mappo import JOINT_UTILITIES
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.evaluation.team import Population, Team, generalised_gini, total, worst_off
from tests.helpers.agents import INTERSECTION, ONE_WAYPOINT, diversified, make_agent

SHORT = {"time_limit": 3.0}
ROUNDABOUT = "mo-deepdrive-roundabout-v0"


class Constant:
    """A policy that always takes one action and observes rewards accrued with its gamma."""

    utilities = ()
    device = "cpu"

    def __init__(self, env: EnvAdapter, action: int, gamma: float = 1.0, *, observes: bool = True):
        self.env, self.action, self.gamma, self.observes_accrued_reward = env, action, gamma, observes

    def act(self, observations: NDArray[Any], _accrued_reward: AccruedReward, _generator: Any) -> NDArray[Any]:
        return np.full(observations.shape[:2], self.action)


@pytest.fixture(name="env")
def make_intersection() -> EnvAdapter:
    return EnvAdapter(make_env(INTERSECTION, 7))


def past(env: EnvAdapter) -> AccruedReward:
    return AccruedReward.begin(env.num_envs, env.vehicles, len(env.objectives))


def test_each_member_drives_its_own_vehicle(env: EnvAdapter) -> None:
    team = Team([Constant(env, 3, 0.9), Constant(env, 5, 0.8)])
    actions = team.act(env.reset(0), past(env), None)
    assert actions.tolist() == [[3, 5]] * 7
    assert team.gamma.tolist() == pytest.approx([0.9, 0.8])
    assert team.utilities == ()


def test_a_member_observes_rewards_accrued_with_its_own_discount() -> None:
    agents = [diversified(make_agent(MOA2C, INTERSECTION, seed=s, gamma=g)) for s, g in ((1, 0.9), (2, 1.0))]
    arguments: dict[str, Any] = {"episodes": 5, "env_kwargs": SHORT}
    alone = [evaluate(agent, INTERSECTION, **arguments) for agent in agents]
    # A pair of one and the same agent is that agent.
    for agent, expected in zip(agents, alone, strict=True):
        np.testing.assert_array_equal(
            evaluate(Team([agent, agent]), INTERSECTION, **arguments).returns, expected.returns
        )
    mixed = evaluate(Team(agents), INTERSECTION, **arguments)
    assert len(mixed.utilities) == 2
    assert not np.array_equal(mixed.returns, alone[0].returns)


def test_members_take_turns_over_the_environments(env: EnvAdapter) -> None:
    population = Population([Constant(env, action) for action in (4, 5, 6)], 1)
    assert population.act(env.reset(0), past(env), None).tolist() == [4, 5, 6, 4, 5, 6, 4]
    first = past(env).take(np.arange(2))
    assert population.act(env.reset(0)[:2], first, None).tolist() == [4, 5]


def test_only_members_that_observe_accrued_rewards_must_agree_on_the_discount(env: EnvAdapter) -> None:
    assert Population([Constant(env, 1, 0.9), Constant(env, 2, 0.5, observes=False)], 0).gamma == 0.9
    assert Population([Constant(env, 2, 0.5, observes=False)], 0).gamma == 1.0
    with pytest.raises(ValueError, match=r"accrued with different discounts: 0.5, 0.9"):
        Population([Constant(env, 1, 0.9), Constant(env, 2, 0.5)], 0)
    # As an agent with partners gives it, in single precision.
    assert Population([Constant(env, 1, 0.9), Constant(env, 2, float(np.float32(0.9)))], 0).gamma == 0.9


def test_members_of_another_task_and_too_few_members_are_refused(env: EnvAdapter) -> None:
    with pytest.raises(ValueError, match="1 members for 2 vehicles"):
        Team([Constant(env, 1)])
    continuous = EnvAdapter(make_env(INTERSECTION, 1, {"action_type": "continuous"}))
    with pytest.raises(ValueError, match="actions = 3 cannot drive where actions = 22"):
        Team([Constant(env, 1), Constant(continuous, 1)])
    with pytest.raises(ValueError, match="no driver of vehicle 0"):
        Population([], 0)
    alone = EnvAdapter(make_env(ONE_WAYPOINT, 1))
    with pytest.raises(ValueError, match="name = 'mo-deepdrive-one-waypoint-v0' cannot drive"):
        Population([Constant(env, 1), Constant(alone, 1)], 0)


def test_one_member_may_drive_several_vehicles() -> None:
    env = EnvAdapter(make_env(ROUNDABOUT, 1, {"vehicles": 4}))
    team = Team([Constant(env, 3), Constant(env, 0)], [0, 1, 1, 1])
    assert team.act(env.reset(0), past(env), None).tolist() == [[3, 0, 0, 0]]


def test_the_worse_off_count_for_more_in_the_gini_sum_as_in_mappos() -> None:
    utilities = np.array([[3.0, -1.0, 5.0, 0.5], [2.0, 2.0, 2.0, 2.0]])
    gini = generalised_gini(utilities)
    assert gini.tolist() == pytest.approx([-0.5 + 0.125 + 0.375 + 0.3125, 1.875])
    for ours, name in ((total, "sum"), (worst_off, "worst_off"), (generalised_gini, "gini")):
        expected = JOINT_UTILITIES[name](torch.from_numpy(utilities))  # type: ignore[index]
        np.testing.assert_allclose(ours(utilities), expected)
