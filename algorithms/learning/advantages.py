"""Recursions that advantages and their targets consist of: pure functions over time-major tensors (T, ...)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mo_deepdrive.support.faults import NotFinite

if TYPE_CHECKING:
    from mo_deepdrive.utilities import Utility


def generalised_advantages(deltas: Tensor, ended: Tensor, decay: float) -> Tensor:
    """A_t = delta_t + decay A_{t+1}, or delta_t where the episode ends at t (Schulman et al. 2016, eq. 16).

    ``deltas`` (T, ...) are temporal differences, ``ended`` (T, ...) says whether the episode ends at t, by termination
    or truncation; its last axis may be 1. ``decay`` is gamma * lambda, or lambda if the differences are discounted.
    """
    decays = decay * (~ended).to(deltas.dtype)
    advantages = [deltas[-1]]
    for t in range(len(deltas) - 2, -1, -1):
        advantages.append(torch.addcmul(deltas[t], decays[t], advantages[-1]))
    return torch.stack(advantages[::-1])


def bootstrapped(following: Tensor, final_values: Tensor, terminated: Tensor, truncated: Tensor) -> Tensor:
    """v(S_{t+1}) (T, ..., K): 0 after termination, the value of the true final state after truncation.

    ``following`` (T, ..., K) is v of the states in which decisions 1 to T were taken, and ``final_values`` that of the
    states after each step, which is read where ``truncated`` (T, ...).
    """
    values = torch.where(truncated.unsqueeze(-1), final_values, following)
    return values.masked_fill(terminated.unsqueeze(-1), 0.0)


def normalise(advantages: Tensor, weights: Tensor | None) -> Tensor:
    """``advantages`` with mean 0 and standard deviation 1 under ``weights`` of their shape; None weighs all alike."""
    if weights is None:
        return (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
    weights = weights / weights.sum().clamp(min=1.0)
    mean = (weights * advantages).sum()
    deviation = (weights * (advantages - mean).square()).sum().sqrt()
    return (advantages - mean) / (deviation + 1e-8)


def utility_gradient(utility: Utility, expected_return: Tensor) -> Tensor:
    """Gradient of the utility at the expected return (d,): the weights (d,) of the objectives under SER."""
    gradient: Tensor = torch.func.grad(utility.unchecked())(expected_return)
    return gradient


def check_utility_gradient(utility: Utility, expected_return: Tensor) -> None:
    """Refuse a utility whose gradient at the expected return (d,) is not finite, as that of a root at 0."""
    gradient = utility_gradient(utility, expected_return)
    if not gradient.isfinite().all():
        at = dict(zip(utility.objectives, expected_return.tolist(), strict=True))
        where = f"the gradient of utility {utility.name!r} = {gradient.tolist()} at the expected return {at}"
        raise NotFinite(f"{where}; it must be finite")
