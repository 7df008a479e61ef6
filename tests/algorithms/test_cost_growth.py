"""Costs that grow during the training of an actor-critic: what is learnt from, what is reported, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from algorithms import A2C, MAPPO, MOA2C, MOPPO, PPO, RulebookPPO
from algorithms.actor_critic import ActorCritic
from tests.helpers.agents import INTERSECTION, MINECART, SEA, make_agent, same, state

ALL = pytest.mark.parametrize("cls", [A2C, PPO, MOA2C, MOPPO, RulebookPPO, MAPPO])
# distance, destination, g-force, collision, jerk, lane violation
COSTS = np.array([False, False, True, True, True, True])


def rollouts(agent: ActorCritic, monkeypatch: pytest.MonkeyPatch, *progress: float) -> list[Any]:
    """What the agent collects in updates at these shares of the training: (rewards, environments' rewards, R_t)."""
    step = agent.env.step
    taken: list[Any] = []
    raw: list[np.ndarray] = []

    def stepped(actions: Any) -> Any:
        result = step(actions)
        raw.append(result.rewards.copy())
        return result

    monkeypatch.setattr(agent.env, "step", stepped)
    agent.begin()
    for each in progress:
        raw.clear()
        agent.update(each)
        storage = agent.collector.storage
        taken.append((storage.rewards[0].numpy().copy(), np.stack(raw), storage.accrued[0].numpy().copy()))
    return taken


@ALL
@pytest.mark.parametrize(("power", "shares"), [(1.0, (0.0, 0.25, 0.5, 1.0, 1.0)), (2.0, (0.0, 0.0625, 0.25, 1.0, 1.0))])
def test_costs_grow_and_gains_stay(
    cls: type[ActorCritic], power: float, shares: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = make_agent(cls, INTERSECTION, num_envs=8, cost_growth=0.5, cost_growth_power=power)
    progress = (0.0, 0.125, 0.25, 0.5, 0.75)
    for (rewards, raw, _), share in zip(rollouts(agent, monkeypatch, *progress), shares, strict=True):
        np.testing.assert_array_equal(rewards, raw * np.where(COSTS, share, 1.0).astype(np.float32))
        assert raw[..., COSTS].any()


def test_what_has_accrued_is_the_sum_of_what_is_learnt_from(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_agent(MOPPO, INTERSECTION, num_envs=8, cost_growth=0.5, accrued_discount=1.0)
    ((rewards, _, accrued),) = rollouts(agent, monkeypatch, 0.25)
    np.testing.assert_allclose(accrued[-1], rewards.sum(axis=0), rtol=1e-5, atol=1e-6)


def test_episodes_are_reported_with_their_true_returns() -> None:
    growing, plain = (make_agent(PPO, SEA, num_envs=8, steps=64, cost_growth=share) for share in (1.0, 0.0))
    for agent in (growing, plain):
        agent.begin()
        agent.update(0.0)
    # The first rollouts are those of the same weights, so of the same episodes.
    assert growing.episodes.totals[0, 0, 0] > 0
    ((found,),), ((expected,),) = (agent.episodes.take() for agent in (growing, plain))
    assert found == expected
    assert found[f"return/{growing.env.objectives[1]}"] < 0
    assert (growing.collector.storage.rewards[..., 1] == 0.0).all()


def test_growth_that_is_over_learns_as_without() -> None:
    growing, plain = (make_agent(PPO, cost_growth=share) for share in (0.25, 0.0))
    for agent in (growing, plain):
        agent.begin()
        agent.update(0.25)
    assert same(state(growing), state(plain))


def test_costs_of_other_libraries_are_objectives_that_are_never_positive() -> None:
    assert make_agent(PPO, SEA).env.costs.tolist() == [False, True]
    assert make_agent(PPO, MINECART).env.costs.tolist() == [False, False, True]


def test_rewards_of_vehicles_that_do_not_learn_stay() -> None:
    agent = make_agent(PPO, INTERSECTION, cost_growth=0.5)
    agent.learners = agent.learners[:1]
    agent.grow_costs(0.5)
    np.testing.assert_array_equal(agent.collector.shares[0], np.where(COSTS, 0.5, 1.0).astype(np.float32))
    np.testing.assert_array_equal(agent.collector.shares[1], 1.0)
