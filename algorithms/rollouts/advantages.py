"""Return and advantage estimators: pure functions over time-major tensors (T, ...)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

import torch

from mo_deepdrive.faults import NotFinite
from mo_deepdrive.simulation.jit import jit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.utilities import Utility

AdvantageForm = Literal["utility_difference", "as_printed", "utility_gradient", "expected_utility"]


def generalised_advantages(deltas: torch.Tensor, not_done: torch.Tensor, decay: float) -> torch.Tensor:
    """A_t = delta_t + decay * not_done_t * A_{t+1} (Schulman et al. 2016, eq. 16).

    Args:
        deltas: (T, ...) temporal differences, without a gradient.
        not_done: (T, ...), broadcastable: 0 where the episode ends at t, by termination or truncation, else 1.
        decay: gamma * lambda, or lambda where the differences are discounted already.

    Returns:
        (T, ...) advantages.
    """
    decays = (decay * not_done).expand_as(deltas)
    advantages = deltas.cpu().numpy().copy()
    _accumulate(advantages.reshape(len(deltas), -1), decays.cpu().numpy().reshape(len(deltas), -1))
    return torch.from_numpy(advantages).to(deltas.device)


@jit
def _accumulate(advantages: NDArray[Any], decays: NDArray[Any]) -> None:
    """Turn delta_t into A_t, both (T, K)."""
    for t in range(len(advantages) - 2, -1, -1):
        for k in range(advantages.shape[1]):
            advantages[t, k] += decays[t, k] * advantages[t + 1, k]


def utility_gradient(utility: Utility, expected_return: torch.Tensor) -> torch.Tensor:
    """Gradient of the utility at the expected return (d,): the weights (d,) of the objectives under SER.

    Raises:
        NotFinite: if it is not finite, as that of a root at 0.
    """
    with torch.enable_grad():
        point = expected_return.detach().clone().requires_grad_(True)
        gradient: torch.Tensor = torch.autograd.grad(utility(point), point)[0]
    if not gradient.isfinite().all():
        at = dict(zip(utility.objectives, point.tolist(), strict=True))
        raise NotFinite(
            f"the gradient of utility {utility.name!r} = {gradient.tolist()} at the expected return {at}; it must be "
            "finite"
        )
    return gradient


def normalise(advantages: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """``advantages`` with mean 0 and standard deviation 1 under ``weights``, which sum to 1; both of one shape.

    Raises:
        NotFinite: if the deviation is not finite.
    """
    mean = (weights * advantages).sum()
    deviation = (weights * (advantages - mean).square()).sum().sqrt()
    if not math.isfinite(float(deviation)):
        raise NotFinite(
            f"the standard deviation of the advantages = {float(deviation)} in single precision (advantages from "
            f"{float(advantages.min()):g} to {float(advantages.max()):g})"
        )
    return (advantages - mean) / (deviation + 1e-8)
