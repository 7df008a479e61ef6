"""Losses whose gradient is written out, against autograd's of the same formula."""

from __future__ import annotations

import pytest
import torch

from algorithms.networks.losses import Loss, clipped_surrogate, mean, policy_change, squared_error, weighted_sum


def randoms(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def gradient_by(loss: Loss, outputs: torch.Tensor) -> torch.Tensor:
    return sum(torch.from_numpy(gradient) for each, gradient in loss.gradients if each is outputs)


def test_the_clipped_surrogate_and_its_gradient_are_autograds() -> None:
    old, advantages = randoms(2, 200)
    log_prob = (old + 0.4 * randoms(200, seed=1)).requires_grad_()
    ratio = (log_prob - old).exp()
    expected = torch.minimum(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages).mean()
    (wanted,) = torch.autograd.grad(expected, log_prob)
    loss = clipped_surrogate(log_prob, old, advantages, 0.2)
    assert float(loss) == pytest.approx(expected.item(), rel=1e-5)
    assert 20 < int((wanted == 0).sum()) < 180
    torch.testing.assert_close(gradient_by(loss, log_prob), wanted, rtol=1e-5, atol=1e-7)


def test_a_surrogate_that_is_not_clipped_always_has_a_gradient() -> None:
    """Whatever way the product of ratio and advantage is rounded."""
    old, advantages = randoms(2, 5000)
    loss = clipped_surrogate(old + 1e-3 * randoms(5000, seed=1), old, advantages, 0.2)
    assert bool((torch.from_numpy(loss.gradients[0][1]) != 0.0).all())


def test_squared_error_and_mean_have_autograds_gradients() -> None:
    outputs, targets = randoms(30, 4).requires_grad_(), randoms(30, 4, seed=1)
    for loss, expected in (
        (squared_error(outputs, targets), torch.nn.functional.mse_loss(outputs, targets)),
        (mean(outputs), outputs.mean()),
    ):
        assert float(loss) == pytest.approx(expected.item(), rel=1e-5)
        (wanted,) = torch.autograd.grad(expected, outputs, retain_graph=True)
        torch.testing.assert_close(gradient_by(loss, outputs), wanted, rtol=1e-5, atol=1e-7)


def test_weighted_losses_have_autograds_gradients() -> None:
    outputs, targets = randoms(30, 4).requires_grad_(), randoms(30, 4, seed=1)
    log_prob, weights = randoms(30).requires_grad_(), randoms(30, seed=2).softmax(0)
    for loss, expected, by in (
        (squared_error(outputs, targets, weights), (weights * (targets - outputs).square().mean(-1)).sum(), outputs),
        (weighted_sum(weights, log_prob), (weights * log_prob).sum(), log_prob),
    ):
        assert float(loss) == pytest.approx(expected.item(), rel=1e-5)
        (wanted,) = torch.autograd.grad(expected, by)
        torch.testing.assert_close(gradient_by(loss, by), wanted, rtol=1e-5, atol=1e-7)


def test_sums_and_multiples_have_the_gradient_of_the_expression() -> None:
    outputs, targets = randoms(30).requires_grad_(), randoms(30, seed=1)
    loss = -clipped_surrogate(outputs, outputs.detach(), targets, 0.2) + 0.5 * squared_error(outputs, targets)
    loss = loss - 0.01 * mean(outputs)
    surrogate = ((outputs - outputs.detach()).exp() * targets).mean()
    expected = -surrogate + 0.5 * torch.nn.functional.mse_loss(outputs, targets) - 0.01 * outputs.mean()
    assert float(loss) == pytest.approx(expected.item(), rel=1e-5)
    (wanted,) = torch.autograd.grad(expected, outputs)
    torch.testing.assert_close(gradient_by(loss, outputs), wanted, rtol=1e-5, atol=1e-7)


def test_targets_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"targets have shape \(3,\); the outputs have \(3, 1\)"):
        squared_error(torch.zeros(3, 1), torch.zeros(3))


def test_weights_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"weights have shape \(3, 1\); the outputs have \(3,\)"):
        weighted_sum(torch.zeros(3, 1), torch.zeros(3))
    for outputs, weights in ((torch.zeros(3, 2), torch.zeros(2)), (torch.zeros(3), torch.zeros(3))):
        with pytest.raises(ValueError, match="weights have shape"):
            squared_error(outputs, outputs, weights)


def test_policy_change_counts_clipped_samples_and_estimates_the_divergence() -> None:
    clipped, divergence = policy_change(torch.tensor([0.0, 0.1, -0.3, 0.5]).log1p(), 0.2)
    assert clipped == 0.5
    assert divergence == pytest.approx((0.1 - 0.0953102 - 0.3 + 0.3566749 + 0.5 - 0.4054651) / 4, rel=1e-4)
