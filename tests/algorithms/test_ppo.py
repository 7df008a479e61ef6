"""PPO: the clipped steps, which are MO-PPO's too, against plain loops and against the step of A2C."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from algorithms import A2C, MOPPO, PPO
from algorithms.actor_critic import ActorCritic
from tests.helpers.agents import CONTINUOUS, make_agent
from tests.helpers.handmade import experienced, handmade, learn_from, look, samples_of

CLIPPED = pytest.mark.parametrize("cls", [PPO, MOPPO])


@pytest.mark.slow
@pytest.mark.parametrize("env", [{}, CONTINUOUS], ids=["discrete", "continuous"])
@pytest.mark.parametrize("normalised", [False, True])
def test_one_epoch_of_one_minibatch_is_the_step_of_a2c(env: dict[str, Any], normalised: bool) -> None:
    settings = {"env": env, "normalise_advantages": normalised}
    one, clipped = experienced(PPO, epochs=1, minibatches=1, **settings)
    other, plain = experienced(A2C, **settings)
    for agent in (one, other):
        assert learn_from(agent, handmade(agent, masked=True), 1e-3, 0.05)["policy/entropy"] > 0.0
    torch.testing.assert_close(clipped.vector, plain.vector, rtol=1e-4, atol=1e-5)


def recorded_steps(agent: Any, rollout: Any, rate: float = 1e-3) -> tuple[list[Any], dict[str, float]]:
    """The samples of every gradient step while learning from a rollout, and the parts of the loss."""
    taken: list[Any] = []
    inner = agent.loss

    def spy(networks: Any, samples: Any, entropy_coefficient: Any) -> Any:
        with torch.no_grad():
            now = networks.actor(samples.inputs, samples.actions)[0]
        taken.append((samples, (now - samples.log_prob).exp()))
        return inner(networks, samples, entropy_coefficient)

    agent.loss = spy
    return taken, learn_from(agent, rollout, rate, 0.05)


@CLIPPED
@pytest.mark.parametrize(("epochs", "minibatches"), [(1, 1), (3, 4), (2, 5), (1, 1000)])
def test_every_epoch_uses_every_sample_once(cls: type[ActorCritic], epochs: int, minibatches: int) -> None:
    agent, _ = experienced(cls, epochs=epochs, minibatches=minibatches)
    rollout = handmade(agent, steps=12, masked=True)
    count = rollout.acted.numel()
    steps = [samples for samples, _ in recorded_steps(agent, rollout)[0]]
    sizes = [len(samples.actions) for samples in steps if len(samples.actions)]
    per_epoch = min(minibatches, count)
    assert len(sizes) == epochs * per_epoch
    assert max(sizes) - min(sizes) <= 1
    mine = sorted(rollout.inputs[:-1, :, 0].flatten().tolist())
    kept = [samples for samples in steps if len(samples.actions)]
    for first in range(0, len(kept), per_epoch):
        batch = kept[first : first + per_epoch]
        assert sorted(torch.cat([samples.inputs[:, 0] for samples in batch]).tolist()) == mine
        weights = torch.cat([samples.weights for samples in batch])
        assert int(weights.sum()) == int(rollout.acted.sum()) < count
    if epochs > 1:
        assert not torch.equal(kept[0].inputs, kept[per_epoch].inputs)  # in another order


@CLIPPED
def test_the_old_policy_and_the_advantages_are_fixed_during_the_epochs(cls: type[ActorCritic]) -> None:
    agent, _ = experienced(cls, epochs=3, minibatches=1)
    steps = [samples for samples, _ in recorded_steps(agent, handmade(agent), 0.01)[0]]

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
    agent, learner = experienced(cls, clip=0.2, value_coefficient=1e-9)
    with torch.no_grad():
        samples = samples_of(agent, handmade(agent, steps=20))
    # As if the policy had moved since: ratios on both sides of the clip.
    shift = torch.linspace(-0.6, 0.6, len(samples.actions))
    samples = samples._replace(log_prob=samples.log_prob + shift, weights=None)
    terms, counts = [], []
    for row in range(len(shift)):
        ratio, advantage = float(torch.exp(-shift[row])), float(samples.advantages[row])
        terms.append(min(ratio * advantage, min(max(ratio, 0.8), 1.2) * advantage))
        counts.append(not ((ratio > 1.2 and advantage > 0) or (ratio < 0.8 and advantage < 0)))
    assert 0 < sum(counts) < len(counts)
    parameters = list(learner.actor.parameters())
    loss = agent.loss(learner.networks, samples, torch.tensor(0.0))
    assert float(loss.parts["loss/policy"].detach()) == pytest.approx(-np.mean(terms), rel=1e-4)
    gradient = torch.autograd.grad(loss.total, parameters)
    # The same gradient from the samples that count alone, at their share of the mean.
    chosen = torch.tensor(counts)
    counted = samples._make(each if each is None else each[chosen] for each in samples)
    apart = torch.autograd.grad(agent.loss(learner.networks, counted, torch.tensor(0.0)).total, parameters)
    for mine, other in zip(gradient, apart, strict=True):
        torch.testing.assert_close(mine, chosen.float().mean() * other, rtol=1e-3, atol=1e-6)


@CLIPPED
def test_clip_fraction_and_kl_are_those_of_all_gradient_steps(cls: type[ActorCritic]) -> None:
    agent, _ = experienced(cls, epochs=3, minibatches=2, clip=0.1)
    steps, found = recorded_steps(agent, handmade(agent, steps=20), 0.02)
    ratio = torch.cat([ratio for _, ratio in steps])
    clipped = ((ratio - 1.0).abs() > 0.1).float().mean()
    assert 0.0 < clipped < 1.0
    assert found["policy/clip_fraction"] == pytest.approx(float(clipped), rel=1e-4)
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
        learn_from(agent, look(agent, rollout), 1e-3, 0.05)
        results.append(learner.vector.clone())
    torch.testing.assert_close(*results, rtol=1e-6, atol=1e-7)


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
