"""Losses as functions of tensors that autograd differentiates, and how far a step has moved a policy.

Rows are samples. Their ``weights`` (M,) need not sum to 1; None weighs all alike, and a row of weight 0 does not count.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch

from mo_deepdrive.evaluation.metrics import APPROX_KL, CLIP_FRACTION, ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from collections.abc import Sequence

LARGEST_LOG_RATIO = 80.0  # whose exponential is finite in single precision


class Losses(NamedTuple):
    """A loss of an actor-critic and the scalars of which it consists.

    Attributes:
        total: what is minimised.
        policy, value, entropy: its parts.
        log_ratio: (M,) log rho of the samples, of PPO and its relatives.
    """

    total: torch.Tensor
    policy: torch.Tensor
    value: torch.Tensor
    entropy: torch.Tensor
    log_ratio: torch.Tensor | None = None

    def parts(self) -> dict[str, float]:
        """The parts by the names of metrics."""
        return means([self])


def means(losses: Sequence[Losses]) -> dict[str, float]:
    """The parts by the names of metrics, in the mean over gradient steps."""
    parts = torch.stack([torch.stack(each[1:4]) for each in losses]).detach().double().mean(0).tolist()
    return dict(zip((POLICY_LOSS, VALUE_LOSS, ENTROPY), parts, strict=True))


def mean(values: torch.Tensor, weights: torch.Tensor | None = None) -> torch.Tensor:
    """The weighted mean of ``values`` (M,); 0 if all weights are."""
    if weights is None:
        return values.mean()
    return (weights * values).sum() / weights.sum().clamp(min=torch.finfo(weights.dtype).tiny)


def squared_error(outputs: torch.Tensor, targets: torch.Tensor, weights: torch.Tensor | None = None) -> torch.Tensor:
    """The weighted mean of |y - v|^2 / K over the rows of outputs v and targets y, both (M, K)."""
    return mean((outputs - targets).square().mean(-1), weights)


def clipped_surrogate(
    log_ratio: torch.Tensor, advantages: torch.Tensor, clip: float, weights: torch.Tensor | None = None
) -> torch.Tensor:
    """E[min(rho A, clip(rho, 1 - epsilon, 1 + epsilon) A)] (Schulman et al. 2017, eq. 7).

    Args:
        log_ratio: (M,) log rho = log pi - log pi_old of the actions.
        advantages: (M,) A.
        clip: epsilon.
        weights: of the samples.
    """
    ratio = log_ratio.exp()
    return mean(torch.minimum(ratio * advantages, ratio.clamp(1.0 - clip, 1.0 + clip) * advantages), weights)


def policy_change(
    log_ratio: torch.Tensor, clip: float, weights: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """The fraction of clipped samples, and E[rho - 1 - log rho], an estimate of KL(pi_old || pi), in a gradient step.

    Args:
        log_ratio: (M,) log rho of samples of pi_old.
        clip: epsilon.
        weights: of the samples.
    """
    ratio = log_ratio.clamp(max=LARGEST_LOG_RATIO).exp()
    clipped = ((ratio - 1.0).abs() > clip).to(ratio.dtype)
    return mean(clipped, weights), mean(ratio - 1.0 - log_ratio, weights)


def policy_changes(losses: Sequence[Losses], clip: float) -> dict[str, float]:
    """:func:`policy_change` over the samples of several gradient steps, by the names of metrics."""
    log_ratio = torch.cat([each.log_ratio.detach() for each in losses if each.log_ratio is not None])
    clipped, divergence = policy_change(log_ratio, clip)
    return {CLIP_FRACTION: float(clipped), APPROX_KL: float(divergence)}
