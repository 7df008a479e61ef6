"""The clipped steps of PPO and MO-PPO: against plain loops, and against the steps of A2C and MO-A2C."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from algorithms import A2C, MOA2C, MOPPO, PPO
from algorithms.actor_critic import ActorCritic
from tests.helpers.agents import (
    CONTINUOUS,
    experienced,
    gradients_of,
    handmade,
    loss_of,
    parameters_of,
    samples_of,
    step_of,
)

CLIPPED = pytest.mark.parametrize("cls", [PPO, MOPPO])


PLAIN: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "ppo": (PPO, A2C, {}),
    **{
        f"mo_ppo, {name}": (MOPPO, MOA2C, {"advantage": name})
        for name in ("utility_difference", "as_printed", "utility_gradient", "expected_utility")
    },
    "mo_ppo, full accrued reward": (MOPPO, MOA2C, {"accrued_discount": 1.0}),
}


@pytest.mark.parametrize("name", PLAIN)
@pytest.mark.parametrize("env", [{}, CONTINUOUS], ids=["discrete", "continuous"])
@pytest.mark.parametrize("normalised", [False, True])
def test_one_epoch_of_one_minibatch_is_the_step_of_a2c(name: str, env: dict[str, Any], normalised: bool) -> None:
    cls, unclipped, own = PLAIN[name]
    settings = {**own, "env": env, "normalise_advantages": normalised}
    one, clipped = experienced(cls, epochs=1, minibatches=1, **settings)
    other, plain = experienced(unclipped, **settings)
    for agent in (one, other):
        assert step_of(agent, samples_of(agent, handmade(agent, masked=True)))["policy/entropy"] > 0.0
    for mine, theirs in zip(parameters_of(clipped), parameters_of(plain), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)


def recorded_steps(agent: Any) -> list[Any]:
    """The samples of every gradient step of an update."""
    taken: list[Any] = []
    inner = agent.loss

    def spy(networks: Any, samples: Any, coefficient: Any) -> Any:
        taken.append(samples)
        return inner(networks, samples, coefficient)

    agent.loss = spy
    agent.begin()
    agent.update(0.0)
    return taken


@CLIPPED
@pytest.mark.parametrize(("epochs", "minibatches"), [(1, 1), (3, 4), (2, 5), (1, 1000)])
def test_every_epoch_uses_every_sample_once(cls: type[ActorCritic], epochs: int, minibatches: int) -> None:
    agent, _ = experienced(cls, epochs=epochs, minibatches=minibatches, steps=12)
    steps = recorded_steps(agent)
    mine = sorted(agent.collector.storage.inputs[0, :-1].sum(-1).flatten().tolist())
    count = len(mine)
    assert len(steps) == epochs * min(minibatches, count)
    per_epoch = min(minibatches, count)
    for first in range(0, len(steps), per_epoch):
        batch = steps[first : first + per_epoch]
        sizes = [len(samples.actions) for samples in batch]
        assert sum(sizes) == count
        assert max(sizes) - min(sizes) <= 1
        seen = torch.cat([samples.inputs.sum(-1) for samples in batch])
        assert sorted(seen.tolist()) == pytest.approx(mine, rel=1e-4, abs=1e-4)
    if epochs > 1:
        assert not torch.equal(steps[0].inputs, steps[per_epoch].inputs)  # in another order


@CLIPPED
def test_the_old_policy_and_the_advantages_are_fixed_during_the_epochs(cls: type[ActorCritic]) -> None:
    agent, learner = experienced(cls, epochs=3, minibatches=1, learning_rate=0.01)
    steps = recorded_steps(agent)
    ordered = [order.argsort() for order in learner.order[0]]
    for later, order in zip(steps[1:], ordered[1:], strict=True):
        for name in ("log_prob", "advantages", "targets"):
            first = getattr(steps[0], name)[ordered[0]]
            assert torch.equal(getattr(later, name)[order], first), name


@CLIPPED
def test_the_loss_is_the_clipped_surrogate_written_out_and_clipped_samples_have_no_gradient(
    cls: type[ActorCritic],
) -> None:
    agent, learner = experienced(cls, clip=0.2, value_coefficient=1e-9, max_grad_norm=1e9)
    samples = samples_of(agent, handmade(agent, steps=20))
    # As if the policy had moved since: ratios on both sides of the clip.
    shift = torch.linspace(-0.6, 0.6, len(samples.actions))
    samples = samples._replace(log_prob=samples.log_prob + shift)
    terms, counts, clipped = [], [], []
    for row in range(len(shift)):
        ratio, advantage = float(torch.exp(-shift[row])), float(samples.advantages[row])
        terms.append(min(ratio * advantage, min(max(ratio, 0.8), 1.2) * advantage))
        counts.append(not ((ratio > 1.2 and advantage > 0) or (ratio < 0.8 and advantage < 0)))
        clipped.append(not 0.8 <= ratio <= 1.2)
    assert 0 < sum(counts) < len(counts)
    found = loss_of(agent, samples, 0.0)
    assert found.parts["loss/policy"].item() == pytest.approx(-np.mean(terms), rel=1e-4)
    assert float(found.parts["policy/clip_fraction"]) == pytest.approx(np.mean(clipped))
    kl = ((-shift).exp() - 1.0 + shift).mean()
    assert float(found.parts["policy/approx_kl"]) == pytest.approx(float(kl), rel=1e-4)
    # The same gradient from the samples that count alone, at their share of the mean.
    kept, share = torch.tensor(counts), sum(counts) / len(counts)
    some = type(samples)(*(each[kept] for each in samples))
    actors = slice(len([*learner.actor.parameters()]))
    pairs = zip(gradients_of(agent, samples, 0.0)[actors], gradients_of(agent, some, 0.0)[actors], strict=True)
    for mine, theirs in pairs:
        torch.testing.assert_close(mine, share * theirs, rtol=1e-3, atol=1e-6)


@CLIPPED
def test_what_is_logged_are_means_over_all_gradient_steps(cls: type[ActorCritic]) -> None:
    agent, _ = experienced(cls, epochs=3, minibatches=2, learning_rate=0.02, clip=0.1)
    parts: list[Any] = []
    inner = agent.loss

    def spy(*arguments: Any) -> Any:
        loss = inner(*arguments)
        parts.append({name: each.item() for name, each in loss.parts.items()})
        return loss

    agent.loss = spy
    agent.begin()
    found = agent.update(0.0)
    assert len(parts) == 6
    assert 0.0 < float(found["policy/clip_fraction"]) < 1.0
    for name in parts[0]:
        assert float(found[name]) == pytest.approx(np.mean([each[name] for each in parts]), rel=1e-5, abs=1e-7)
