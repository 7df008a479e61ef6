"""Losses, plain and compiled, against what is written down."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest
import torch
from algorithms.networks.compiled import plain_torch
from algorithms.networks.losses import (
    Losses,
    mean,
    means,
    policy_change,
    policy_gradient_loss,
    proximal_loss,
    squared_error,
)
from algorithms.rollouts.buffers import Samples

from mo_deepdrive.evaluation.metrics import APPROX_KL, CLIP_FRACTION, ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from collections.abc import Callable

SETTINGS = SimpleNamespace(clip=0.2, value_coefficient=0.5)


def randoms(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def samples_of(count: int, weights: torch.Tensor | None = None) -> Samples:
    old, advantages = randoms(2, count)
    nothing = torch.zeros(count, 0)
    return Samples(nothing, nothing, nothing, advantages, randoms(count, 3, seed=2), weights, old)


@pytest.mark.parametrize(
    "loss", [proximal_loss, partial(proximal_loss, critic_learns_from_all=True), policy_gradient_loss]
)
@pytest.mark.parametrize("weighted", [False, True])
def test_the_compiled_losses_and_their_gradients_are_those_of_plain_torch(
    weighted: bool, loss: Callable[..., Losses]
) -> None:
    samples = samples_of(200, (randoms(200, seed=3) > 0.0).float() if weighted else None)
    found = []
    for compiled in (True, False):
        log_prob = (samples.log_prob + 0.4 * randoms(200, seed=1)).requires_grad_()
        entropies, outputs = randoms(200, seed=4).requires_grad_(), randoms(3, 200, seed=5).t().requires_grad_()
        arguments = log_prob, entropies, outputs, samples, SETTINGS, 0.01
        with nullcontext() if compiled else plain_torch():
            losses = loss(*arguments)
        (2.0 * losses.total).backward()
        found.append([each for each in (*losses, log_prob.grad, entropies.grad, outputs.grad) if each is not None])
    for mine, other in zip(*found, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-5, atol=1e-7)
    without_gradient = int((found[0][-3] == 0).sum())  # clipped, or of weight 0
    assert without_gradient < 180
    assert without_gradient > 20 or loss is policy_gradient_loss


def test_a_surrogate_that_is_not_clipped_always_has_a_gradient() -> None:
    """Whatever way the product of ratio and advantage is rounded."""
    samples = samples_of(5000)
    log_prob = (samples.log_prob + 1e-3 * randoms(5000, seed=1)).requires_grad_()
    proximal_loss(log_prob, log_prob, samples.targets, samples, SETTINGS, 0.0).total.backward()
    assert bool((log_prob.grad != 0.0).all())


def test_means_are_weighted_and_0_without_weight() -> None:
    assert float(mean(torch.tensor([1.0, 3.0]))) == 2.0
    assert float(mean(torch.tensor([1.0, 3.0, 9.0]), torch.tensor([3.0, 1.0, 0.0]))) == 1.5
    assert float(mean(torch.tensor([1.0, 3.0]), torch.zeros(2))) == 0.0
    outputs, targets = torch.tensor([[1.0, 2.0], [5.0, 5.0]]), torch.tensor([[0.0, 4.0], [0.0, 0.0]])
    assert float(squared_error(outputs, targets, torch.tensor([1.0, 0.0]))) == 2.5


def test_metrics_are_means_over_the_steps_and_say_how_far_the_policy_moved() -> None:
    log_ratio = torch.tensor([0.0, 0.1, -0.3, 0.5]).log1p()
    parts = torch.tensor([[9.0, 1.0, 2.0, 3.0], [9.0, 3.0, 2.0, 1.0]])
    steps = [Losses(*row, ratio) for row, ratio in zip(parts, log_ratio.split(2), strict=True)]
    assert means(steps) == {POLICY_LOSS: 2.0, VALUE_LOSS: 2.0, ENTROPY: 2.0}
    change = policy_change(steps, 0.2)
    assert change[CLIP_FRACTION] == 0.5
    assert change[APPROX_KL] == pytest.approx((0.1 - 0.0953102 - 0.3 + 0.3566749 + 0.5 - 0.4054651) / 4, rel=1e-4)
