"""PPO: the clipped steps, which are MO-PPO's too, against plain loops and against the step of A2C."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from algorithms import A2C, MOPPO, PPO
from algorithms.actor_critic import ActorCritic
from tests.helpers.agents import (
    CONTINUOUS,
    experienced,
    handmade,
    make_agent,
    parameters_of,
    same,
    state,
)

CLIPPED = pytest.mark.parametrize("cls", [PPO, MOPPO])


@pytest.mark.slow
@pytest.mark.parametrize("env", [{}, CONTINUOUS], ids=["discrete", "continuous"])
@pytest.mark.parametrize("normalised", [False, True])
def test_one_epoch_of_one_minibatch_is_the_step_of_a2c(env: dict[str, Any], normalised: bool) -> None:
    settings = {"env": env, "normalise_advantages": normalised}
    one, clipped = experienced(PPO, epochs=1, minibatches=1, **settings)
    other, plain = experienced(A2C, **settings)
    for agent, learner in ((one, clipped), (other, plain)):
        metrics = learner.update(handmade(agent, masked=True), learner.config.learning_rate, 0.05, torch.Generator())
        assert metrics["policy/entropy"] > 0.0
    for mine, theirs in zip(parameters_of(clipped), parameters_of(plain), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)


def recorded_steps(learner: Any, rollout: Any, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The samples of every gradient step while learning from ``rollout``."""
    taken: list[Any] = []
    inner = learner.loss

    def spy(samples: Any, *coefficients: float) -> Any:
        taken.append(samples)
        return inner(samples, *coefficients)

    monkeypatch.setattr(learner, "loss", spy)
    learner.update(rollout, learner.config.learning_rate, 0.05, torch.Generator())
    return taken


@CLIPPED
@pytest.mark.parametrize(("epochs", "minibatches"), [(1, 1), (3, 4), (2, 5), (1, 1000)])
def test_every_epoch_uses_every_acting_sample_once(
    cls: type[ActorCritic], epochs: int, minibatches: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, learner = experienced(cls, epochs=epochs, minibatches=minibatches)
    rollout = handmade(agent, steps=12, masked=True)
    count = int(rollout.acted.sum())
    assert 10 < count < rollout.acted.numel()
    mine = sorted(float(reward) for reward in rollout.observations[:-1][rollout.acted][:, 0] / 1.0)
    steps = recorded_steps(learner, rollout, monkeypatch)
    per_epoch = min(minibatches, count)
    assert len(steps) == epochs * per_epoch
    for first in range(0, len(steps), per_epoch):
        batch = steps[first : first + per_epoch]
        sizes = [len(samples.actions) for samples in batch]
        assert sum(sizes) == count
        assert max(sizes) - min(sizes) <= 1
        seen = torch.cat([samples.inputs[:, 0] * learner.observation_scales[0] for samples in batch])
        assert sorted(seen.tolist()) == pytest.approx(mine)
    if epochs > 1:
        assert not torch.equal(steps[0].inputs, steps[per_epoch].inputs)  # in another order


@CLIPPED
def test_the_old_policy_and_the_advantages_are_fixed_during_the_epochs(
    cls: type[ActorCritic], monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, learner = experienced(cls, epochs=3, minibatches=1, learning_rate=0.01)
    rollout = handmade(agent)
    steps = recorded_steps(learner, rollout, monkeypatch)

    def ordered(samples: Any, values: torch.Tensor) -> torch.Tensor:
        return values[samples.inputs[:, 0].argsort()]

    for later in steps[1:]:
        for name in ("log_prob", "advantages", "targets"):
            first = ordered(steps[0], getattr(steps[0], name))
            assert torch.equal(ordered(later, getattr(later, name)), first), name


@CLIPPED
def test_the_loss_is_the_clipped_surrogate_written_out_and_clipped_samples_have_no_gradient(
    cls: type[ActorCritic],
) -> None:
    agent, learner = experienced(cls, clip=0.2, value_coefficient=1e-9, max_grad_norm=1e9)
    samples = learner.samples(handmade(agent, steps=20))
    # As if the policy had moved since: ratios on both sides of the clip.
    shift = torch.linspace(-0.6, 0.6, len(samples.actions))
    samples = samples._replace(log_prob=samples.log_prob + shift)
    terms, counts = [], []
    for row in range(len(shift)):
        ratio, advantage = float(torch.exp(-shift[row])), float(samples.advantages[row])
        terms.append(min(ratio * advantage, min(max(ratio, 0.8), 1.2) * advantage))
        counts.append(not ((ratio > 1.2 and advantage > 0) or (ratio < 0.8 and advantage < 0)))
    assert 0 < sum(counts) < len(counts)
    losses = learner.loss(samples, 0.0)
    losses.total.backward()
    assert float(losses.policy) == pytest.approx(-np.mean(terms), rel=1e-4)
    torch.testing.assert_close(losses.log_ratio, -shift, rtol=1e-4, atol=1e-5)
    gradient = [parameter.grad.clone() for parameter in learner.actor.parameters()]
    # The same gradient from the samples that count alone, at their share of the mean.
    learner.optimiser.zero_grad()
    learner.loss(samples.at(torch.tensor(counts).nonzero().squeeze(1)), 0.0).total.backward()
    share = sum(counts) / len(counts)
    for mine, parameter in zip(gradient, learner.actor.parameters(), strict=True):
        torch.testing.assert_close(mine, share * parameter.grad, rtol=1e-3, atol=1e-6)


@CLIPPED
def test_clip_fraction_and_kl_are_those_of_all_gradient_steps(
    cls: type[ActorCritic], monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, learner = experienced(cls, epochs=3, minibatches=2, learning_rate=0.02, clip=0.1)
    ratios: list[torch.Tensor] = []
    inner = learner.loss

    def spy(samples: Any, *coefficients: float) -> Any:
        with torch.no_grad():
            log_prob, _ = learner.actor(samples.inputs, samples.actions)
        ratios.append((log_prob - samples.log_prob).exp())
        return inner(samples, *coefficients)

    monkeypatch.setattr(learner, "loss", spy)
    found = learner.update(handmade(agent, steps=20), 0.02, 0.05, torch.Generator())
    ratio = torch.cat(ratios)
    clipped = ((ratio - 1.0).abs() > 0.1).float().mean()
    assert 0.0 < clipped < 1.0
    assert found["policy/clip_fraction"] == pytest.approx(float(clipped))
    assert found["policy/approx_kl"] == pytest.approx(float((ratio - 1.0 - ratio.log()).mean()), rel=1e-3, abs=1e-6)


@CLIPPED
def test_samples_that_did_not_act_change_nothing(cls: type[ActorCritic]) -> None:
    results = []
    for noise in (0.0, 5.0):
        agent, learner = experienced(cls)
        rollout = handmade(agent, masked=True)
        masked = ~rollout.acted
        rollout.rewards[masked] += noise
        rollout.observations[:-1][masked] += noise
        rollout.accrued[:-1][masked] += noise
        learner.update(rollout, learner.config.learning_rate, 0.05, torch.Generator())
        results.append(state(agent))
    assert same(*results)


@CLIPPED
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "'epochs' = 0"),
        ({"minibatches": 0}, "'minibatches' = 0"),
        ({"clip": 0.0}, "'clip' = 0.0"),
        ({"clip": 1.0}, "'clip' = 1.0"),
        ({"minibatch": 4}, "did you mean 'minibatches'"),
    ],
)
def test_invalid_settings_are_refused_by_name(cls: type[ActorCritic], settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_agent(cls, **settings)
