"""Losses with their gradients written out, the clipped surrogate among them, and how far it has moved a policy."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.simulation.jit import jit

if TYPE_CHECKING:
    from collections.abc import Sequence

    import torch
    from numpy.typing import NDArray

    Gradient = tuple[torch.Tensor, NDArray[np.float32]]


LARGEST_LOG_RATIO = 80.0  # whose exponential is finite in single precision


class Loss:
    """A scalar with its gradient by the outputs of networks, for which +, - and multiplication by a number are defined.

    Args:
        value: the scalar.
        gradients: pairs of an output and the gradient by it, in its shape.
        factors: by which the gradients are still to be multiplied; None for 1.

    Example:
        >>> outputs = torch.tensor([1.0, 3.0])
        >>> loss = 0.5 * mean(outputs) - squared_error(outputs, torch.tensor([1.0, 1.0]))
        >>> float(loss)
        -1.0
        >>> sum(gradient for _, gradient in loss.gradients)
        array([ 0.25, -1.75], dtype=float32)
    """

    def __init__(self, value: float, gradients: Sequence[Gradient], factors: Sequence[float] | None = None):
        self.value = value
        self._gradients = list(gradients)
        self._factors = [1.0] * len(self._gradients) if factors is None else list(factors)

    @property
    def gradients(self) -> list[Gradient]:
        """Pairs of an output and the gradient by it, in its shape."""
        pairs = zip(self._gradients, self._factors, strict=True)
        return [(out, by if factor == 1.0 else np.float32(factor) * by) for (out, by), factor in pairs]

    def __float__(self) -> float:
        return self.value

    def __add__(self, other: Loss) -> Loss:
        gradients, factors = self._gradients + other._gradients, self._factors + other._factors
        return Loss(self.value + other.value, gradients, factors)

    def __sub__(self, other: Loss) -> Loss:
        return self + -other

    def __neg__(self) -> Loss:
        return -1.0 * self

    def __rmul__(self, factor: float) -> Loss:
        return Loss(factor * self.value, self._gradients, [factor * each for each in self._factors])


def mean(outputs: torch.Tensor) -> Loss:
    """The mean of ``outputs``."""
    array = _array(outputs)
    return Loss(_total(array.reshape(-1)) / array.size, [(outputs, np.full_like(array, 1.0 / array.size))])


@jit
def _total(values: NDArray[np.float32]) -> float:
    total = 0.0
    for i in range(len(values)):
        total += values[i]
    return total


def weighted_sum(weights: torch.Tensor, outputs: torch.Tensor) -> Loss:
    """The sum of w x over the outputs x.

    Raises:
        ValueError: if they differ in shape.
    """
    if outputs.shape != weights.shape:
        raise ValueError(f"weights have shape {tuple(weights.shape)}; the outputs have {tuple(outputs.shape)}")
    gradient = _array(weights)
    products = gradient.reshape(-1), _array(outputs).reshape(-1)
    return Loss(_weighted_total(*products), [(outputs, gradient)])


@jit
def _weighted_total(weights: NDArray[np.float32], values: NDArray[np.float32]) -> float:
    total = 0.0
    for i in range(len(values)):
        total += np.float64(weights[i]) * np.float64(values[i])
    return total


def squared_error(outputs: torch.Tensor, targets: torch.Tensor, weights: torch.Tensor | None = None) -> Loss:
    """The mean of (y - v)^2 over all elements of the outputs v and the targets y.

    Args:
        outputs: v.
        targets: y, in their shape.
        weights: (M,), which sum to 1, of the M rows of outputs (M, d); None for equal ones.

    Raises:
        ValueError: if targets or weights do not have the shape that they must.
    """
    if outputs.shape != targets.shape:
        raise ValueError(f"targets have shape {tuple(targets.shape)}; the outputs have {tuple(outputs.shape)}")
    if weights is not None and (outputs.dim() != 2 or weights.shape != outputs.shape[:1]):
        raise ValueError(f"weights have shape {tuple(weights.shape)}; the outputs have {tuple(outputs.shape)}")
    array = _array(outputs)
    if array.ndim != 2:
        array = np.ascontiguousarray(array)  # so that its rows are a view of the gradient
    gradient = np.empty_like(array)
    columns = array.shape[-1] if array.ndim > 1 else 1
    rows = array.reshape(-1, columns), _array(targets).reshape(-1, columns), gradient.reshape(-1, columns)
    if weights is None:
        of_rows, divisor = np.ones(len(rows[0]), array.dtype), array.size
    else:
        of_rows, divisor = _array(weights), columns
    return Loss(_squared_error(*rows, of_rows, divisor), [(outputs, gradient)])


@jit
def _squared_error(
    outputs: NDArray[np.float32],
    targets: NDArray[np.float32],
    gradient: NDArray[np.float32],
    weights: NDArray[np.float32],
    divisor: int,
) -> float:
    """The sum of w (y - v)^2 / n for a divisor n; the gradient by v is 2 w (v - y) / n."""
    total, scale = 0.0, np.float32(2.0 / divisor)
    for k in range(outputs.shape[1]):
        for i in range(len(outputs)):
            error = outputs[i, k] - targets[i, k]
            gradient[i, k] = scale * weights[i] * error
            total += np.float64(weights[i]) * np.float64(error) * np.float64(error)
    return total / divisor


def clipped_surrogate(
    log_prob: torch.Tensor, old_log_prob: torch.Tensor, advantages: torch.Tensor, clip: float
) -> Loss:
    """E[min(rho A, clip(rho, 1 - epsilon, 1 + epsilon) A)] with rho = pi / pi_old (Schulman et al. 2017, eq. 7).

    Args:
        log_prob: (M,) log pi of the actions, by which the loss has a gradient.
        old_log_prob: (M,) log pi_old.
        advantages: (M,) A.
        clip: epsilon.
    """
    old, weights = _array(old_log_prob), _array(advantages)
    gradient = np.empty_like(old)
    value = _clipped_surrogate(_array(log_prob), old, weights, clip, gradient)
    return Loss(value, [(log_prob, gradient)])


@jit
def _clipped_surrogate(
    log_prob: NDArray[np.float32],
    old_log_prob: NDArray[np.float32],
    advantages: NDArray[np.float32],
    clip: float,
    gradient: NDArray[np.float32],
) -> float:
    """The gradient by log pi is rho A where that is the minimum, and else 0."""
    total, count = 0.0, len(log_prob)
    for i in range(count):
        # In double precision, or a surrogate that is not clipped could be rounded above itself.
        ratio = math.exp(np.float64(log_prob[i]) - np.float64(old_log_prob[i]))
        advantage = np.float64(advantages[i])
        surrogate = ratio * advantage
        clipped = min(max(ratio, 1.0 - clip), 1.0 + clip) * advantage
        gradient[i] = surrogate / count if surrogate <= clipped else 0.0
        total += min(surrogate, clipped)
    return total / count


def _array(tensor: torch.Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = tensor.detach().cpu().numpy()
    return array


def policy_change(log_ratio: torch.Tensor, clip: float) -> tuple[float, float]:
    """The fraction of clipped samples, and E[rho - 1 - log rho], an estimate of KL(pi_old || pi).

    Args:
        log_ratio: (M,) log rho of samples of pi_old.
        clip: epsilon.
    """
    ratio = log_ratio.clamp(max=LARGEST_LOG_RATIO).exp()
    clipped = ((ratio - 1.0).abs() > clip).to(ratio.dtype)
    return float(clipped.mean()), float((ratio - 1.0 - log_ratio).mean())
