"""Rulebook PPO: how rules enter the advantage, when their multipliers rise and fall, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from algorithms import RulebookPPO
from mo_deepdrive.utilities import make_utility
from tests.helpers.agents import handmade, make_agent

LEFT_TURN = "mo-deepdrive-left-turn-v1"
OBJECTIVES = ("distance", "destination", "g_force", "collision", "jerk", "lane_violation", "time")
LIMITS = {"collision": 0.01, "jerk": 50.0}
RULES = [{"objective": name, "at_most": limit} for name, limit in LIMITS.items()]


def ruled(**settings: Any) -> RulebookPPO:
    fast = {"rulebook": RULES, "multiplier_rate": 0.1, "cost_episodes": 1, "hidden": [8]}
    agent: RulebookPPO = make_agent(RulebookPPO, LEFT_TURN, **{**fast, **settings})
    return agent


def finish(agent: RulebookPPO, *costs: tuple[float, float]) -> list[float]:
    """The multipliers after a rollout in which an episode ended with each of these collisions and jerks."""
    learner = agent.learners[0]
    learner.episodes += len(costs)
    ended, magnitudes = torch.zeros(1, 1, 4, dtype=torch.bool), torch.full((1, 1, 4, 2), 1e9)
    for i, each in enumerate(costs):
        ended[0, 0, i], magnitudes[0, 0, i] = True, torch.tensor(each)
    agent.move_multipliers(learner, ended, magnitudes)
    return list(agent.multipliers[0, 0].tolist())


def test_an_advantage_is_that_of_the_utility_and_of_the_rules_at_their_multipliers() -> None:
    weights = {"distance": 0.3, "destination": 10.0, "time": 0.2}
    agent = ruled(utility=make_utility("linear", OBJECTIVES, weights=weights), gamma=0.9, gae_lambda=0.8)
    agent.multipliers[:] = torch.tensor([0.05, 2.0])
    agent.begin()
    prices = agent.rollout_of(agent.learners[0], agent.collector.storage)["prices"][0]
    np.testing.assert_allclose(prices, [0.0, 0.0, 0.0, 0.05 / 0.01, 2.0 / 50.0, 0.0, 0.0], rtol=1e-6)

    rollout = handmade(agent, masked=True).rollout(agent)
    rollout.prices = prices
    values, following = torch.randn(2, *rollout.rewards.shape, generator=torch.Generator().manual_seed(1))
    found, targets = agent.advantages(rollout, values, following)
    by_objective = prices.numpy() + [weights.get(name, 0.0) for name in OBJECTIVES]
    deltas = (rollout.rewards + 0.9 * following - values).numpy()
    advantage = np.zeros(deltas.shape[1:])
    for t in reversed(range(len(deltas))):
        advantage = deltas[t] + 0.9 * 0.8 * advantage * ~rollout.ended[t].numpy()[:, None]
        np.testing.assert_allclose(found[t], advantage @ by_objective, rtol=1e-3, atol=1e-2)
        np.testing.assert_allclose(targets[t], advantage + values[t].numpy(), rtol=1e-4, atol=1e-2)


def test_a_multiplier_rises_while_its_rule_is_broken_and_falls_to_zero_while_it_is_kept() -> None:
    agent = ruled()
    assert finish(agent) == [0.0, 0.0]
    assert finish(agent, (0.015, 25.0)) == pytest.approx([0.05, 0.0])  # half above its limit; half below it
    assert finish(agent, (0.0, 25.0), (1.0, 25.0)) == pytest.approx([0.15, 0.0])  # by no more than the rate
    assert finish(agent, (0.005, 75.0)) == pytest.approx([0.10, 0.025])  # the second one half as fast
    assert finish(agent, (0.0, 0.0)) == pytest.approx([0.0, 0.0], abs=1e-6)


def test_a_later_multiplier_does_not_rise_while_an_earlier_rule_is_broken_but_falls() -> None:
    agent = ruled(multiplier_start=1.0)
    assert finish(agent, (0.02, 100.0)) == pytest.approx([1.1, 1.0])
    assert finish(agent, (0.02, 25.0)) == pytest.approx([1.2, 0.975])
    assert finish(agent, (0.01, 100.0)) == pytest.approx([1.2, 1.025])


def test_the_first_episodes_weigh_alike_in_the_running_mean_and_later_ones_as_many_as_are_remembered() -> None:
    agent = ruled(cost_episodes=4)
    for jerk, mean in ((60.0, 60.0), (30.0, 45.0), (0.0, 30.0), (0.0, 22.5), (0.0, 16.875)):
        finish(agent, (0.0, jerk))
        assert float(agent.running_costs[0, 0, 1]) == pytest.approx(mean)


def test_multipliers_rest_before_the_first_episode_has_ended_and_while_costs_grow() -> None:
    agent = ruled(multiplier_start=1.0, cost_growth=0.5)
    assert finish(agent) == [1.0, 1.0]
    agent.grow_costs(0.9)
    assert finish(agent, (1.0, 100.0)) == [1.0, 1.0]
    agent.grow_costs(1.0)
    assert finish(agent, (1.0, 100.0)) == pytest.approx([1.1, 1.0])


def test_multipliers_follow_the_undiscounted_costs_of_episodes_and_are_logged() -> None:
    rules = [{"objective": "time", "at_most": 0.5}]
    agent = ruled(rulebook=rules, env={"time_limit": 1.0, "charge_remaining_time": False}, steps=10, cost_growth=0.4)
    rows: list[dict[str, float]] = []
    agent.train(5 * 10 * agent.env.num_envs, log=lambda _, row: rows.append(row), log_interval=1)
    assert [row["policy/multiplier/time"] for row in rows] == pytest.approx([0.0, 0.0, 0.1, 0.2, 0.3])
    assert [row["policy/running_cost/time"] for row in rows] == pytest.approx([1.0] * 5, rel=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rulebook": []}, "'rulebook' = .*at least 1 item"),
        ({"rulebook": [RULES[0], RULES[0]]}, "'rulebook' = .*'collision' has 2 rules; it must have one"),
        ({"rulebook": [{"objective": "jerk", "at_most": -1.0}]}, r"'rulebook.0.at_most' = -1.0: .*greater than 0"),
        ({"rulebook": [{"objective": "jerk"}]}, r"'rulebook.0.at_most' is missing"),
        ({"rulebook": [{"objective": "jerks", "at_most": 1.0}]}, r"rulebook.0.objective = 'jerks' .*mean 'jerk'"),
        (
            {"rulebook": [RULES[0], {"objective": "distance", "at_most": 1.0}]},
            r"rulebook.1.objective = 'distance' .*cost",
        ),
        (
            {"rulebook": RULES, "env": {"cost_sign": "paper"}},
            r"rulebook.0.objective = 'collision' must be a cost, .*: none",
        ),
        ({"advantage": "expected_utility"}, "'advantage' = 'expected_utility'"),
    ],
)
def test_what_is_no_rulebook_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ruled(**settings)
