"""Return and advantage estimators: pure functions over time-major tensors (T, ...)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

if TYPE_CHECKING:
    from mo_deepdrive.utilities import Utility

AdvantageForm = Literal["utility_difference", "as_printed", "utility_gradient"]


def generalised_advantages(deltas: torch.Tensor, not_done: torch.Tensor, decay: float) -> torch.Tensor:
    """A_t = delta_t + decay * not_done_t * A_{t+1} (Schulman et al. 2016, eq. 16).

    Args:
        deltas: (T, ...) temporal differences.
        not_done: (T, ...), broadcastable: 0 where the episode ends at t, by termination or truncation, else 1.
        decay: gamma * lambda, or lambda where the differences are discounted already.

    Returns:
        (T, ...) advantages.
    """
    advantages = torch.empty_like(deltas)
    next_advantages = torch.zeros_like(deltas[0])
    decays = decay * not_done
    for t in range(len(deltas) - 1, -1, -1):
        next_advantages = torch.addcmul(deltas[t], decays[t], next_advantages, out=advantages[t])
    return advantages


def utility_gradient(utility: Utility, expected_return: torch.Tensor) -> torch.Tensor:
    """Gradient of the utility at the expected return (d,): the weights (d,) of the objectives under SER."""
    with torch.enable_grad():
        point = expected_return.detach().clone().requires_grad_(True)
        gradient: torch.Tensor = torch.autograd.grad(utility(point), point)[0]
    return gradient


def normalise(advantages: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """``advantages`` with mean 0 and standard deviation 1 under ``weights``, which sum to 1; both of one shape."""
    mean = (weights * advantages).sum()
    deviation = (weights * (advantages - mean).square()).sum().sqrt()
    return (advantages - mean) / (deviation + 1e-8)
