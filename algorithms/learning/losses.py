"""Means over samples, what a loss gives, and how far a gradient step has moved a policy.

Rows are samples. Their ``weights`` (M,) need not sum to 1; None weighs all alike, and a row of weight 0 does not count.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from mo_deepdrive.evaluation.metrics import APPROX_KL, CLIP_FRACTION

LARGEST_LOG_RATIO = 80.0  # whose exponential is finite in single precision


class Loss(NamedTuple):
    """A loss of one seed."""

    total: Tensor  # scalar, what is minimised
    parts: dict[str, Tensor]  # scalars by the names of metrics, for logs


def mean(values: Tensor, weights: Tensor | None) -> Tensor:
    """The weighted mean of ``values`` (M,); 0 if all weights are."""
    if weights is None:
        return values.mean()
    return (weights * values).sum() / weights.sum().clamp(min=torch.finfo(weights.dtype).tiny)


def policy_change(log_ratio: Tensor, clip: float, weights: Tensor | None) -> dict[str, Tensor]:
    """The fraction of samples that are clipped to epsilon, and E[rho - 1 - log rho] for log rho (M,).

    The latter is an estimate of KL(pi_old || pi) in a gradient step.
    """
    log_ratio = log_ratio.detach()
    ratio = log_ratio.clamp(max=LARGEST_LOG_RATIO).exp()
    clipped = ((ratio - 1.0).abs() > clip).to(ratio.dtype)
    return {CLIP_FRACTION: mean(clipped, weights), APPROX_KL: mean(ratio - 1.0 - log_ratio, weights)}
