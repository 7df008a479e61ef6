"""The clipped surrogate with its gradient written out, and how far it has moved a policy."""

from __future__ import annotations

from typing import Any

import torch


class _ClippedSurrogate(torch.autograd.Function):
    """The gradient by log pi of min(rho A, clip(rho) A) is rho A where that is the minimum, and else 0."""

    @staticmethod
    def forward(
        ctx: Any, log_prob: torch.Tensor, old_log_prob: torch.Tensor, advantages: torch.Tensor, clip: float
    ) -> torch.Tensor:
        ratio = (log_prob - old_log_prob).exp_()
        surrogate = ratio * advantages
        clipped = ratio.clamp_(1.0 - clip, 1.0 + clip).mul_(advantages)
        ctx.save_for_backward(surrogate.where(surrogate <= clipped, 0.0))
        return torch.minimum(surrogate, clipped).mean()

    @staticmethod
    def backward(ctx: Any, by_mean: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * (by_mean / len(gradient)), None, None, None


def clipped_surrogate(
    log_prob: torch.Tensor, old_log_prob: torch.Tensor, advantages: torch.Tensor, clip: float
) -> torch.Tensor:
    """E[min(rho A, clip(rho, 1 - epsilon, 1 + epsilon) A)] with rho = pi / pi_old (Schulman et al. 2017, eq. 7).

    Args:
        log_prob: (M,) log pi of the actions; the only argument with a gradient.
        old_log_prob: (M,) log pi_old.
        advantages: (M,) A.
        clip: epsilon.
    """
    surrogate: torch.Tensor = _ClippedSurrogate.apply(log_prob, old_log_prob, advantages, clip)  # type: ignore[no-untyped-call]
    return surrogate


def policy_change(log_ratio: torch.Tensor, clip: float) -> tuple[float, float]:
    """The fraction of clipped samples, and E[rho - 1 - log rho], an estimate of KL(pi_old || pi).

    Args:
        log_ratio: (M,) log rho of samples of pi_old.
        clip: epsilon.
    """
    ratio = log_ratio.exp()
    clipped = ((ratio - 1.0).abs() > clip).to(ratio.dtype)
    return float(clipped.mean()), float((ratio - 1.0 - log_ratio).mean())
