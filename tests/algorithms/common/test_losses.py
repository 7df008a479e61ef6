"""Losses whose gradient is written out, against autograd's of the same formula."""

from __future__ import annotations

import torch

from algorithms.common.losses import clipped_surrogate


def test_the_clipped_surrogate_and_its_gradient_are_autograds() -> None:
    generator = torch.Generator().manual_seed(0)
    old, advantages = torch.randn(2, 200, generator=generator, dtype=torch.float64)
    log_prob = (old + 0.4 * torch.randn(200, generator=generator, dtype=torch.float64)).requires_grad_()
    ratio = (log_prob - old).exp()
    expected = torch.minimum(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages).mean()
    found = clipped_surrogate(log_prob, old, advantages, 0.2)
    torch.testing.assert_close(found, expected)
    (wanted,) = torch.autograd.grad(3.0 * expected, log_prob)
    (gradient,) = torch.autograd.grad(3.0 * found, log_prob)
    assert 20 < int((wanted == 0).sum()) < 180
    torch.testing.assert_close(gradient, wanted)
