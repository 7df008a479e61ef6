"""MO-A2C, and A2C as its scalar counterpart: values, advantages and losses against plain loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from algorithms import A2C, MOA2C, MOPPO, PPO
from algorithms.actor_critic import ActorCritic
from tests.helpers.agents import (
    ALL_FORMS,
    Handmade,
    exaggerate,
    handmade,
    learner_of,
    loss_of,
    make_agent,
    samples_of,
    seen_by,
    value_of,
    value_scale,
)


def test_mo_a2c_acts_on_the_accrued_reward_and_a2c_does_not() -> None:
    for cls, depends in ((A2C, False), (PPO, False), (MOA2C, True), (MOPPO, True)):
        agent = make_agent(cls)
        exaggerate(agent)
        observation = np.ones(15, dtype=np.float32)
        rng = np.random.default_rng(0)
        actions = {int(agent.eval(observation, rng.normal(0.0, [20.0, 1.0, 5.0, 500.0]))) for _ in range(50)}
        assert (len(actions) > 1) is depends


@torch.no_grad()
def next_values(agent: Any, made: Handmade) -> torch.Tensor:
    """v(S_{t+1}), as the agent calculates it."""
    rollout, networks = made.rollout(agent), agent.learners[0].networks
    found: torch.Tensor = agent.next_values(networks, rollout, agent.value_scales * networks.critic(rollout.states))
    return found


@ALL_FORMS
def test_the_next_value_is_zero_after_termination_and_that_of_the_true_final_state_after_truncation(form: str) -> None:
    agent, _ = learner_of(form)
    r = handmade(agent)
    found = next_values(agent, r)
    kinds = set()
    for t in range(len(r.rewards)):
        for i in range(r.rewards.shape[1]):
            terminated, truncated = bool(r.terminated[t, i]), bool(r.truncated[t, i])
            kinds.add((terminated, truncated))
            if terminated:
                expected = torch.zeros_like(found[t, i])
            elif truncated:
                accrued = r.accrued[t, i] + r.discounts[t, i] * r.rewards[t, i]
                expected = value_of(agent, form, r.final[t, i], accrued, agent.accrued_discount * r.discounts[t, i])
            else:
                expected = value_of(agent, form, r.observations[t + 1, i], r.accrued[t + 1, i], r.discounts[t + 1, i])
            torch.testing.assert_close(found[t, i], expected.reshape(-1), rtol=1e-4, atol=1e-4)
    assert len(kinds) == 4


@pytest.mark.parametrize("cls", [MOA2C, MOPPO])
def test_the_accrued_reward_can_have_its_own_discount(cls: type[ActorCritic]) -> None:
    usual = make_agent(cls, gamma=0.9)
    full = make_agent(cls, gamma=0.9, accrued_discount=1.0)
    assert (usual.gamma, full.gamma) == (0.9, 1.0)
    for agent in (usual, full):
        agent.train(64)
    assert (full.collector.now.discounts == 1.0).all()
    assert usual.collector.now.discounts.max() < 1.0
    with pytest.raises(ValueError, match="accrued_discount"):
        make_agent(cls, accrued_discount=0.0)


def u(returns: torch.Tensor) -> float:
    """The non-linear utility of OneWaypoint on maximised returns, written out."""
    d, r, g, j = (float(x) for x in returns)
    if d > 2:
        return 0.5 * d + d * r + 0.1 * g + 0.1 * j
    return 0.5 * d + r - (0.1 * g) ** 2 - (0.1 * j) ** 2


def plain_losses(agent: Any, form: str, r: Handmade, entropy_coefficient: float) -> dict[str, float]:
    """The losses by loops over single samples."""
    config, actor = agent.config, agent.learners[0].actor
    gamma, decay, g = config.gamma, config.gae_lambda, agent.accrued_discount
    steps, n = r.acted.shape
    policy, critic, entropies, advantages = [], [], [], []
    # The slope of u at EXPECTED_RETURN, by hand: there distance is above 2.
    slope = torch.tensor([0.5 + 0.9, 12.0, 0.1, 0.1])
    for t in range(steps):
        for i in range(n):
            if not r.acted[t, i]:
                continue
            advantage: Any = 0.0
            vector: Any = 0.0
            for k in range(t, steps):
                now = r.observations[k, i], r.accrued[k, i], r.discounts[k, i]
                value = value_of(agent, form, *now)
                factor, reward = r.discounts[k, i], r.rewards[k, i]
                if r.terminated[k, i]:
                    following = torch.zeros_like(value)
                elif r.truncated[k, i]:
                    after = r.accrued[k, i] + factor * reward
                    following = value_of(agent, form, r.final[k, i], after, g * factor)
                else:
                    following = value_of(
                        agent, form, r.observations[k + 1, i], r.accrued[k + 1, i], r.discounts[k + 1, i]
                    )
                gained = u(reward) if form == "a2c" else reward
                vector = vector + (gamma * decay) ** (k - t) * (gained + gamma * following - value)
                if form.startswith("expected_utility"):
                    increase = u(r.accrued[k, i] + factor * reward) - u(r.accrued[k, i])
                    c = gamma / g
                    vector = advantage = advantage + (c * decay) ** (k - t) * (increase + c * following - value)
                elif form == "utility_gradient":
                    advantage = vector @ slope
                elif form == "a2c":
                    advantage = vector
                else:
                    ahead = following if form == "as_printed" else gamma * factor * following
                    difference = u(r.accrued[k, i] + factor * reward + ahead) - u(r.accrued[k, i] + factor * value)
                    advantage = advantage + decay ** (k - t) * difference
                if r.terminated[k, i] or r.truncated[k, i]:
                    break
            scale = value_scale(agent, form)
            # The critic is at the value itself, so that its error is the advantage.
            critic.append(float(((vector / scale) ** 2).mean()))
            x = seen_by(agent, form, r.observations[t, i], r.accrued[t, i], r.discounts[t, i])
            distribution = torch.distributions.Categorical(logits=actor.body(x).detach())
            policy.append(float(distribution.log_prob(r.actions[t, i])))
            entropies.append(float(distribution.entropy()))
            advantages.append(float(advantage))
    used = np.array(advantages)
    if config.normalise_advantages:
        used = (used - used.mean()) / used.std()
    losses = {
        "loss/policy": -float(np.mean(used * np.array(policy))),
        "loss/value": float(np.mean(critic)),
        "policy/entropy": float(np.mean(entropies)),
    }
    total = losses["loss/policy"] + config.value_coefficient * losses["loss/value"]
    return {"total": total - entropy_coefficient * losses["policy/entropy"], **losses}


@pytest.mark.parametrize(("gamma", "accrued_discount"), [(0.9, 1.0), (0.72, 0.9), (0.9, 0.9), (1.0, 1.0)])
def test_discounted_increases_sum_to_the_expected_utility_of_an_episode_cut_short(
    gamma: float, accrued_discount: float
) -> None:
    discounts = {"gamma": gamma, "accrued_discount": accrued_discount}
    agent, _ = learner_of("expected_utility", gae_lambda=1.0, **discounts)
    rollout = handmade(agent, seed=3)
    first_end = int(rollout.terminated[:, 0].int().argmax())
    rollout.terminated[:, 0] = rollout.truncated[:, 0] = False
    for t in range(first_end, len(rollout.rewards)):
        rollout.accrued[t + 1, 0] = rollout.accrued[t, 0] + rollout.discounts[t, 0] * rollout.rewards[t, 0]
        rollout.discounts[t + 1, 0] = accrued_discount * rollout.discounts[t, 0]
    rollout.terminated[-1, 0] = True
    values = torch.zeros(*rollout.acted.shape, 1)
    found = float(agent.advantages(rollout.rollout(agent), values, values)[0][0, 0])
    c, steps = gamma / accrued_discount, len(rollout.rewards)
    ends = [c ** (t - 1) * (1.0 - c) for t in range(1, steps)] + [c ** (steps - 1)]  # after t decisions
    expected = sum(p * u(rollout.accrued[t, 0]) for t, p in enumerate(ends, start=1)) - u(rollout.accrued[0, 0])
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-4)


@ALL_FORMS
@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_the_losses_equal_a_plain_loop_over_single_samples(form: str, normalised: bool, masked: bool) -> None:
    agent, _ = learner_of(form, normalise_advantages=normalised, value_coefficient=0.3, gae_lambda=0.8)
    rollout = handmade(agent, masked=masked, seed=3)
    assert bool(rollout.acted.all()) is not masked
    losses = loss_of(agent, samples_of(agent, rollout))
    found = {"total": losses.total, **losses.parts}
    expected = plain_losses(agent, form, rollout, 0.05)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name].item() == pytest.approx(value, rel=1e-3, abs=1e-4), name
