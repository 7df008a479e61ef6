"""Return and advantage estimators: pure functions over time-major tensors (T, ...)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal, Protocol

import torch

from algorithms.networks.compiled import serves
from mo_deepdrive.faults import NotFinite
from mo_deepdrive.simulation.jit import jit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from algorithms.rollouts.buffers import Rollout
    from mo_deepdrive.utilities import Utility

AdvantageForm = Literal["utility_difference", "as_printed", "utility_gradient", "expected_utility"]


def generalised_advantages(deltas: torch.Tensor, ended: torch.Tensor, decay: float) -> torch.Tensor:
    """A_t = delta_t + decay A_{t+1}, or delta_t where the episode ends at t (Schulman et al. 2016, eq. 16).

    Args:
        deltas: (T, ...) temporal differences, without a gradient.
        ended: (T, ...) whether the episode ends at t, by termination or truncation; the last axis may be 1.
        decay: gamma * lambda, or lambda where the differences are discounted already.

    Returns:
        (T, ...) advantages.
    """
    if serves(deltas):
        found, ends = deltas.numpy().copy(), ended.numpy().reshape(len(ended), -1)
        _accumulate(found.reshape(*ends.shape, -1), ends, decay)
        return torch.from_numpy(found)
    decays = decay * (~ended).to(deltas.dtype)
    advantages = [deltas[-1]]
    for t in range(len(deltas) - 2, -1, -1):
        advantages.append(deltas[t] + decays[t] * advantages[-1])
    return torch.stack(advantages[::-1])


@jit
def _accumulate(advantages: NDArray[Any], ended: NDArray[np.bool_], decay: float) -> None:
    """Turn delta_t into A_t, (T, M, K), of M episodes that end where (T, M) says."""
    for t in range(len(advantages) - 2, -1, -1):
        for i in range(advantages.shape[1]):
            if not ended[t, i]:
                for k in range(advantages.shape[2]):
                    advantages[t, i, k] += decay * advantages[t + 1, i, k]


def next_values(
    following: torch.Tensor, final_values: torch.Tensor, terminated: torch.Tensor, truncated: torch.Tensor
) -> torch.Tensor:
    """v(S_{t+1}) (T, ..., K): 0 after termination, the value of the true final state after truncation.

    Args:
        following: (T, ..., K) v of the states in which decisions 1 to T were taken.
        final_values: (T, ..., K) v of the states after each step; read where ``truncated``.
        terminated: (T, ...).
        truncated: (T, ...).
    """
    values = torch.where(truncated.unsqueeze(-1), final_values, following)
    return values.masked_fill(terminated.unsqueeze(-1), 0.0)


class AdvantageSettings(Protocol):
    """The hyperparameters of :func:`utility_advantages`."""

    advantage: AdvantageForm
    gamma: float
    gae_lambda: float

    @property
    def accrued_discount(self) -> float:
        """G."""


def utility_advantages(
    rollout: Rollout,
    values: torch.Tensor,
    next_values: torch.Tensor,
    utility: Utility,
    config: AdvantageSettings,
    expected_return: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """A_t (T, N) and y_t (T, N, d or 1) by eqs. 2 to 5, or 8 and 9, of :mod:`algorithms.mo_ppo`.

    Args:
        rollout: T steps of N environments, without an axis of vehicles.
        values: (T, N, d or 1) v(S_t).
        next_values: (T, N, d or 1) v(S_{t+1}).
        utility: u.
        config: gamma, g, lambda and the form of the advantages.
        expected_return: (d,) E[R], for "utility_gradient".
    """
    u, gamma, g, decay = utility, config.gamma, config.accrued_discount, config.gae_lambda
    ended = rollout.terminated | rollout.truncated
    # R_t and g^t of the accrued reward, and R_{t+1} = R_t + g^t r_t.
    accrued, discounts = rollout.accrued[:-1], rollout.discounts[:-1].unsqueeze(-1)
    next_accrued = accrued + discounts * rollout.rewards
    ratio = 1.0 if g == gamma else gamma / g
    if config.advantage == "expected_utility":
        # Equations 8 and 9.
        increases = u(next_accrued) - u(accrued)
        gains = increases + ratio * next_values.squeeze(-1) - values.squeeze(-1)
        advantages = generalised_advantages(gains, ended, decay * ratio)
        return advantages, advantages.unsqueeze(-1) + values

    # Equations 2 and 3.
    deltas = rollout.rewards + gamma * next_values - values
    vector_advantages = generalised_advantages(deltas, ended.unsqueeze(-1), gamma * decay)
    targets = vector_advantages + values
    if config.advantage == "utility_gradient":
        return vector_advantages @ utility_gradient(u, expected_return), targets

    # Equation 4.
    expected_rest = next_values if config.advantage == "as_printed" else discounts * gamma * next_values
    differences: torch.Tensor = u(next_accrued + expected_rest) - u(accrued + discounts * values)
    # Equation 5.
    return generalised_advantages(differences, ended, decay * ratio), targets


def utility_gradient(utility: Utility, expected_return: torch.Tensor) -> torch.Tensor:
    """Gradient of the utility at the expected return (d,): the weights (d,) of the objectives under SER."""
    gradient: torch.Tensor = torch.func.grad(utility.unchecked())(expected_return)
    return gradient


def check_utility_gradient(utility: Utility, expected_return: torch.Tensor) -> None:
    """Refuse a utility whose gradient at the expected return (d,) is not finite, as that of a root at 0.

    Raises:
        NotFinite: naming both.
    """
    gradient = utility_gradient(utility, expected_return)
    if not gradient.isfinite().all():
        at = dict(zip(utility.objectives, expected_return.tolist(), strict=True))
        raise NotFinite(
            f"the gradient of utility {utility.name!r} = {gradient.tolist()} at the expected return {at}; it must be "
            "finite"
        )


def normalise(advantages: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """``advantages`` with mean 0 and standard deviation 1 under ``weights`` of the same shape."""
    if serves(advantages):
        found = advantages.numpy().copy()
        _normalise(found.reshape(-1), weights.numpy().reshape(-1))
        return torch.from_numpy(found)
    weights = weights / weights.sum().clamp(min=1.0)
    mean = (weights * advantages).sum()
    deviation = (weights * (advantages - mean).square()).sum().sqrt()
    return (advantages - mean) / (deviation + 1e-8)


@jit
def _normalise(advantages: NDArray[Any], weights: NDArray[Any]) -> None:
    """:func:`normalise` (M,) in place."""
    total, first, second = 0.0, 0.0, 0.0
    for i in range(len(weights)):
        total += weights[i]
        first += weights[i] * advantages[i]
    mean = first / max(total, 1.0)
    for i in range(len(weights)):
        second += weights[i] * (advantages[i] - mean) ** 2
    deviation = math.sqrt(second / max(total, 1.0)) + 1e-8
    for i in range(len(weights)):
        advantages[i] = (advantages[i] - mean) / deviation
