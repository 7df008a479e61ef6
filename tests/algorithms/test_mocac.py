"""MOCAC: the optimum of ESR, targets and advantages against plain loops, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from algorithms import MOCAC
from algorithms.mocac import project
from tests.helpers.agents import (
    NONLINEAR,
    gradients_of,
    handmade,
    make_agent,
    parameters_of,
    samples_of,
)
from tests.helpers.safe_or_risky import probability_of_risky

SHORT_ROLLOUTS: dict[str, Any] = {"steps": 32, "num_envs": 32}  # at a delay of 80 an episode takes three
GRID: dict[str, Any] = {"critic": "categorical", "v_min": [0.0, 0.0], "v_max": [1.5, 1.5]}
PARTICLES: dict[str, Any] = {"particles": 16, "hidden": [32, 32], "v_min": [0.0, 0.0], "v_max": [1.5, 1.5]}
FORMS: dict[str, dict[str, Any]] = {"categorical": {"critic": "categorical", "atoms": 3}, "particles": {"particles": 5}}
ALL_FORMS = pytest.mark.parametrize("form", FORMS)


@pytest.mark.slow
@pytest.mark.parametrize("critic", [GRID, PARTICLES], ids=["grid", "particles"])
@pytest.mark.parametrize(("delay", "total"), [(0, 40_000), (20, 80_000), (80, 150_000)])
def test_either_critic_learns_the_optimum_of_esr(delay: int, total: int, critic: dict[str, Any]) -> None:
    assert probability_of_risky(MOCAC, delay, 0, total, **SHORT_ROLLOUTS, **critic) < 0.1


def learner_of(form: str, **arguments: Any) -> tuple[Any, Any]:
    """An agent on OneWaypoint, four objectives, and its learner."""
    agent = make_agent(MOCAC, num_envs=3, utility=NONLINEAR, gamma=0.9, **FORMS[form], **arguments)
    return agent, agent.learners[0]


def plain_ends(rollout: Any) -> list[list[Any]]:
    """For each sample the state that follows its step, as the networks see it; None after termination."""
    steps, n = rollout.acted.shape
    found: list[list[Any]] = [[None] * n for _ in range(steps)]
    for t in range(steps):
        for i in range(n):
            if rollout.terminated[t, i]:
                continue
            if rollout.truncated[t, i]:
                accrued = rollout.accrued[t, i] + rollout.discounts[t, i] * rollout.rewards[t, i]
                found[t][i] = (rollout.final[t, i], accrued, 0.9 * rollout.discounts[t, i])
            else:
                found[t][i] = tuple(
                    tensor[t + 1, i] for tensor in (rollout.observations, rollout.accrued, rollout.discounts)
                )
    return found


@ALL_FORMS
@torch.no_grad()
def test_targets_are_the_rewards_to_the_end_of_the_rollout_and_what_follows(form: str) -> None:
    agent, learner = learner_of(form)
    r = handmade(agent)
    samples = agent.samples(learner.networks, r.rollout(agent))
    following = plain_ends(r)
    steps, n = r.acted.shape
    kinds = set()
    for t in range(steps):
        for i in range(n):
            total, discount, e = torch.zeros(4), 1.0, t
            while True:
                total = total + discount * r.rewards[e, i]
                discount *= 0.9
                if e == steps - 1 or r.terminated[e, i] or r.truncated[e, i]:
                    break
                e += 1
            torch.testing.assert_close(samples.shifts[t, i], total, rtol=1e-4, atol=1e-4)
            kinds.add((bool(r.terminated[e, i]), bool(r.truncated[e, i])))
            if r.terminated[e, i]:
                assert float(samples.discounts[t, i]) == 0.0
            else:
                assert float(samples.discounts[t, i]) == pytest.approx(discount, rel=1e-5)
                expected = learner.networks.target_critic(agent.inputs(*following[e][i]))
                torch.testing.assert_close(samples.following[t, i], expected, rtol=1e-4, atol=1e-4)
    assert len(kinds) == 4


@ALL_FORMS
@torch.no_grad()
def test_advantages_sum_the_increases_of_the_expected_final_utility(form: str) -> None:
    agent, learner = learner_of(form, gae_lambda=0.7, normalise_advantages=False)
    r = handmade(agent)

    def value(observation: Any, accrued: Any, discount: Any) -> float:
        outputs = learner.critic(agent.inputs(observation, accrued, discount).unsqueeze(0))
        returns, masses = agent.distribution.support(outputs)
        return sum(
            float(mass) * float(NONLINEAR(accrued + discount * rest))
            for rest, mass in zip(returns[0], masses[0], strict=True)
        )

    found = agent.samples(learner.networks, r.rollout(agent)).advantages
    following = plain_ends(r)
    steps, n = r.acted.shape
    for i in range(n):
        later = 0.0
        for t in range(steps - 1, -1, -1):
            final = r.accrued[t, i] + r.discounts[t, i] * r.rewards[t, i]
            after = float(NONLINEAR(final)) if following[t][i] is None else value(*following[t][i])
            over = bool(r.terminated[t, i] or r.truncated[t, i])
            later = after - value(r.observations[t, i], r.accrued[t, i], r.discounts[t, i]) + 0.7 * later * (not over)
            assert float(found[t, i]) == pytest.approx(later, rel=1e-3, abs=1e-2)


@ALL_FORMS
def test_the_gradient_is_that_of_equation_6_by_autograd(form: str) -> None:
    agent, learner = learner_of(form)
    r = handmade(agent, masked=True)
    samples = samples_of(agent, r)
    weights = r.acted.flatten() / r.acted.sum()
    outputs = learner.critic(samples.inputs)
    if form == "categorical":
        parts = (samples.following.softmax(-1), samples.shifts, samples.discounts)
        distances = -(project(*parts, agent.distribution.values) * outputs.log_softmax(-1)).sum(-1)
    else:
        x = outputs.unflatten(-1, (5, 4))
        targets = samples.discounts[:, None, None] * samples.following.view_as(x)
        y = (samples.shifts / agent.objective_scales).unsqueeze(1) + targets
        norm = [((x[:, :, None] - z[:, None]).square().sum(-1) + 0.01**2).sqrt().mean((1, 2)) for z in (y, x)]
        distances = 2 * norm[0] - norm[1]
    log_prob, entropies = learner.actor(samples.inputs, samples.actions)
    loss = (weights * (-samples.advantages * log_prob - 0.02 * entropies)).sum() + 0.5 * (weights * distances).sum()
    expected = torch.autograd.grad(loss, parameters_of(learner))
    for mine, gradient in zip(gradients_of(agent, samples, 0.02), expected, strict=True):
        torch.testing.assert_close(mine, gradient, rtol=1e-3, atol=1e-5)


def test_the_slow_critic_moves_by_its_rate() -> None:
    agent, learner = learner_of("particles", target_rate=0.25)
    before = [weight.clone() for weight in learner.networks.target_critic.parameters()]
    agent.begin()
    agent.update(0.0)
    pairs = zip(before, learner.critic.parameters(), learner.networks.target_critic.parameters(), strict=True)
    for old, weight, slow in pairs:
        assert not torch.equal(old, weight)
        torch.testing.assert_close(slow, 0.75 * old + 0.25 * weight)


def test_bounds_default_to_nominal_scales() -> None:
    scales = make_agent(MOCAC).objective_scales.numpy()
    grid = make_agent(MOCAC, critic="categorical", atoms=3).distribution
    np.testing.assert_allclose(grid.values.numpy(), [-scales, 0 * scales, scales])
    particles = make_agent(MOCAC).distribution
    np.testing.assert_allclose(particles.maximum.numpy(), 10.0)
    np.testing.assert_allclose(particles.minimum.numpy(), -10.0)
