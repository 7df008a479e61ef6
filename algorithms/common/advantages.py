"""Return and advantage estimators as pure functions over time-major tensors (steps, ...)."""

from __future__ import annotations

from typing import Literal

import torch

from mo_deepdrive.utilities import Utility

AdvantageForm = Literal["utility_difference", "as_printed", "utility_gradient"]


def discounted_sum(deltas: torch.Tensor, going_on: torch.Tensor, decay: float) -> torch.Tensor:
    """A_t = delta_t + decay * going_on_t * A_{t+1} (generalised advantage estimation, Schulman et al. 2016, eq. 16).

    Args:
        deltas: (T, ...) temporal differences.
        going_on: (T, ...), broadcastable: 0 where the episode ends at t, by termination or truncation, else 1.
        decay: gamma * lambda, or lambda where the differences carry their own discount.
    """
    sums = torch.empty_like(deltas)
    following = torch.zeros_like(deltas[0])
    factors = decay * going_on
    for t in range(len(deltas) - 1, -1, -1):
        following = deltas[t] + factors[t] * following
        sums[t] = following
    return sums


def utility_differences(
    utility: Utility,
    accrued: torch.Tensor,
    rewards: torch.Tensor,
    discount: torch.Tensor,
    values: torch.Tensor,
    next_values: torch.Tensor,
    gamma: float,
    as_printed: bool,
) -> torch.Tensor:
    """U_t = u(R_{t+1} + gamma^{t+1} v(S_{t+1})) - u(R_t + gamma^t v(S_t)), shape (T, ...) (paper, eq. 4.2).

    The paper prints the first value without gamma^{t+1}: ``as_printed``. gamma^{t+1} is ``discount * gamma``, which
    differs from a power of gamma where the accrued reward has a discount of its own.

    Args:
        accrued: (T, ..., d) accrued reward R_t before each step.
        rewards: (T, ..., d).
        discount: (T, ...) gamma^t, or that of the accrued reward.
        values: (T, ..., d) v(S_t).
        next_values: (T, ..., d) v(S_{t+1}), zero after termination.
    """
    factor = discount.unsqueeze(-1)
    after = accrued + factor * rewards
    following = next_values if as_printed else factor * gamma * next_values
    return utility(after + following) - utility(accrued + factor * values)


def utility_gradient(utility: Utility, expected_return: torch.Tensor) -> torch.Tensor:
    """Gradient of the utility at the expected return (d,): the weights of the objectives under SER."""
    with torch.enable_grad():
        point = expected_return.detach().clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(utility(point), point)
    return gradient
