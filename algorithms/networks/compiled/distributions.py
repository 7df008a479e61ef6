"""Softmax and Gaussian distributions of actions, compiled: samples, log-probabilities, entropies, and gradients."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np

from algorithms.networks.compiled.perceptron import BLOCK, blocks, gradient_array, shares_rows
from mo_deepdrive.simulation.jit import jit, parallel_jit

if TYPE_CHECKING:
    import torch
    from numpy.typing import NDArray

LOG_TWO_PI = math.log(2 * math.pi)
INITIAL_LOG_STD = -0.5  # of Gaussian policies
LOWEST_LOG_STD, HIGHEST_LOG_STD = -5.0, 1.0  # where it depends on the state
# By which an output that depends on the state is multiplied. Adam moves all weights of a layer at once, so an output
# moves faster than a parameter of its own would; with 1, more runs stopped exploring too early (measured in
# docs/lab/conditioned.md).
LOG_STD_GAIN = 0.3

# exp(x) = 2^k exp(r), with k the integer nearest to x / log(2), so that r is at most log(2) / 2 from 0.
LOG2_E = 1.0 / math.log(2.0)
LOG_2 = math.log(2.0)
ROUND = 1.5 * 2.0**52  # added to a number below 2^51, it leaves the nearest integer in the last bits
BIAS = 1023  # of a float64's exponent
LOWEST = -700.0  # exp of it is still a normal number
E2, E3, E4, E5, E6, E7 = 1 / 2, 1 / 6, 1 / 24, 1 / 120, 1 / 720, 1 / 5040


@jit
def exponential(x: float) -> float:
    """exp(x) for x in [-700, 700], to a relative error of 1e-8, in operations that the compiler can vectorise."""
    shifted = x * LOG2_E + ROUND
    r = x - (shifted - ROUND) * LOG_2
    r2 = r * r
    series = (1.0 + r) + r2 * ((E2 + r * E3) + r2 * ((E4 + r * E5) + r2 * (E6 + r * E7)))
    power = np.int64((np.float64(shifted).view(np.int64) + BIAS) << 52).view(np.float64)
    result: float = series * power
    return result


@jit
def _log_normaliser(
    logits: NDArray[np.float32], first: int, rows: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log Z = log sum_k exp(z_k) and H = log Z - sum_k p_k z_k of p = exp(z) / Z, each (rows,).

    Args:
        logits: (n, M) z, of which the columns from ``first`` on count.
        first: the first column.
        rows: number of columns.
    """
    n = len(logits)
    top, total, weighted = logits[0, first : first + rows].astype(np.float64), np.zeros(rows), np.zeros(rows)
    for k in range(1, n):
        for i in range(rows):
            top[i] = max(top[i], logits[k, first + i])
    for k in range(n):
        for i in range(rows):
            z = max(logits[k, first + i] - top[i], LOWEST)
            e = exponential(z)
            total[i] += e
            weighted[i] += e * z
    for i in range(rows):
        log_total = math.log(total[i])
        weighted[i] = log_total - weighted[i] / total[i]
        total[i] = top[i] + log_total
    return total, weighted


@jit
def _categorical_block(
    b: int,
    logits: NDArray[np.float32],
    actions: NDArray[np.int64],
    log_prob: NDArray[np.float32],
    entropy: NDArray[np.float32],
    log_z: NDArray[np.float64],
    h: NDArray[np.float64],
) -> None:
    first = b * BLOCK
    rows = min(BLOCK, len(actions) - first)
    log_zs, hs = _log_normaliser(logits, first, rows)
    for i in range(rows):
        log_prob[first + i] = logits[actions[first + i], first + i] - log_zs[i]
        entropy[first + i], log_z[first + i], h[first + i] = hs[i], log_zs[i], hs[i]


@jit
def categorical_pass(
    logits: NDArray[np.float32],
    actions: NDArray[np.int64],
    log_prob: NDArray[np.float32],
    entropy: NDArray[np.float32],
    log_z: NDArray[np.float64],
    h: NDArray[np.float64],
) -> None:
    """Write log p_a and H of softmax(z), and log Z and H in full precision.

    Args:
        logits: (n, M) z.
        actions: (M,) a.
        log_prob: (M,), written.
        entropy: (M,), written.
        log_z: (M,), written.
        h: (M,), written.
    """
    for b in range(blocks(len(actions))):
        _categorical_block(b, logits, actions, log_prob, entropy, log_z, h)


@parallel_jit
def parallel_categorical_pass(
    logits: NDArray[np.float32],
    actions: NDArray[np.int64],
    log_prob: NDArray[np.float32],
    entropy: NDArray[np.float32],
    log_z: NDArray[np.float64],
    h: NDArray[np.float64],
) -> None:
    """As :func:`categorical_pass`, with the blocks shared among threads."""
    for b in numba.prange(blocks(len(actions))):
        _categorical_block(b, logits, actions, log_prob, entropy, log_z, h)


@jit
def _gradient_block(
    b: int,
    logits: NDArray[np.float32],
    actions: NDArray[np.int64],
    log_z: NDArray[np.float64],
    h: NDArray[np.float64],
    by_log_prob: NDArray[np.float32],
    by_entropy: NDArray[np.float32],
    by_logits: NDArray[np.float32],
) -> None:
    first, last = b * BLOCK, min((b + 1) * BLOCK, len(actions))
    for k in range(len(logits)):
        for i in range(first, last):
            log_p = max(logits[k, i] - log_z[i], LOWEST)
            by_logits[k, i] = -exponential(log_p) * (by_log_prob[i] + by_entropy[i] * (log_p + h[i]))
    for i in range(first, last):
        by_logits[actions[i], i] += by_log_prob[i]


@jit
def categorical_gradient(
    logits: NDArray[np.float32],
    actions: NDArray[np.int64],
    log_z: NDArray[np.float64],
    h: NDArray[np.float64],
    by_log_prob: NDArray[np.float32],
    by_entropy: NDArray[np.float32],
    by_logits: NDArray[np.float32],
) -> None:
    """Write dL/dz (n, M), from d log p_a / dz_k = [k = a] - p_k and dH / dz_k = -p_k (log p_k + H)."""
    for b in range(blocks(len(actions))):
        _gradient_block(b, logits, actions, log_z, h, by_log_prob, by_entropy, by_logits)


@parallel_jit
def parallel_categorical_gradient(
    logits: NDArray[np.float32],
    actions: NDArray[np.int64],
    log_z: NDArray[np.float64],
    h: NDArray[np.float64],
    by_log_prob: NDArray[np.float32],
    by_entropy: NDArray[np.float32],
    by_logits: NDArray[np.float32],
) -> None:
    """As :func:`categorical_gradient`, with the blocks shared among threads."""
    for b in numba.prange(blocks(len(actions))):
        _gradient_block(b, logits, actions, log_z, h, by_log_prob, by_entropy, by_logits)


@jit
def categorical_sample(
    logits: NDArray[np.float32], first: int, uniform: NDArray[np.float32], actions: NDArray[np.int64]
) -> None:
    """Write the first action (M,) whose cumulative probability is above a uniform number (M,) in [0, 1).

    Args:
        logits: (n, rows), of which the M columns from ``first`` on count.
        first: the first column.
        uniform: (M,).
        actions: (M,), written.
    """
    n, rows = len(logits), len(actions)
    top, total, cumulative = logits[0, first : first + rows].astype(np.float64), np.zeros(rows), np.empty((n, rows))
    for k in range(1, n):
        for i in range(rows):
            top[i] = max(top[i], logits[k, first + i])
    for k in range(n):
        for i in range(rows):
            total[i] += exponential(max(logits[k, first + i] - top[i], LOWEST))
            cumulative[k, i] = total[i]
    for i in range(rows):
        actions[i] = 0
        total[i] *= uniform[i]
    for k in range(n - 1):
        for i in range(rows):
            actions[i] += 1 if cumulative[k, i] <= total[i] else 0


@jit
def gaussian_pass(
    means: NDArray[np.float32],
    log_std: NDArray[np.float32],
    actions: NDArray[np.float32],
    log_density: NDArray[np.float32],
    entropy: NDArray[np.float32],
) -> None:
    """Write log N(a; m, sigma) and H (M,) for means m (k, M), log sigma (k,) and actions a (M, k)."""
    h = 0.0
    for j in range(len(log_std)):
        h += log_std[j] + 0.5 * (1.0 + LOG_TWO_PI)
    for i in range(len(actions)):
        total = 0.0
        for j in range(len(log_std)):
            z = (actions[i, j] - means[j, i]) * math.exp(-log_std[j])
            total -= 0.5 * z * z + log_std[j] + 0.5 * LOG_TWO_PI
        log_density[i] = total
        entropy[i] = h


@jit
def gaussian_gradient(
    means: NDArray[np.float32],
    log_std: NDArray[np.float32],
    actions: NDArray[np.float32],
    by_log_density: NDArray[np.float32],
    by_entropy: NDArray[np.float32],
    by_means: NDArray[np.float32],
    by_log_std: NDArray[np.float32],
) -> None:
    """Write dL/dm (k, M) and add dL/dlog sigma; d log N / dm = z / sigma and d log N / dlog sigma = z^2 - 1."""
    for j in range(len(log_std)):
        precision, total = math.exp(-log_std[j]), 0.0
        for i in range(len(actions)):
            z = (actions[i, j] - means[j, i]) * precision
            by_means[j, i] = by_log_density[i] * z * precision
            total += by_log_density[i] * (z * z - 1.0) + by_entropy[i]
        by_log_std[j] += total


@jit
def log_std_of(output: float) -> float:
    """The log standard deviation that an output of a network stands for."""
    return min(max(LOG_STD_GAIN * output + INITIAL_LOG_STD, LOWEST_LOG_STD), HIGHEST_LOG_STD)


@jit
def state_gaussian_sample(
    outputs: NDArray[np.float32], first: int, noise: NDArray[np.float32], actions: NDArray[np.float32]
) -> None:
    """Write m + sigma x for the means m and deviations sigma of outputs and standard normal numbers x.

    Args:
        outputs: (2 k, rows) means, then what :func:`log_std_of` takes; M columns from ``first`` on count.
        first: the first column.
        noise: (M, k) x.
        actions: (M, k), written.
    """
    k = noise.shape[1]
    for i in range(len(noise)):
        for j in range(k):
            deviation = math.exp(log_std_of(outputs[k + j, first + i]))
            actions[i, j] = outputs[j, first + i] + deviation * noise[i, j]


@jit
def state_gaussian_pass(
    outputs: NDArray[np.float32],
    actions: NDArray[np.float32],
    log_density: NDArray[np.float32],
    entropy: NDArray[np.float32],
) -> None:
    """Write log N(a; m, sigma) and H (M,) for outputs (2 k, M), as in :func:`state_gaussian_sample`, and actions."""
    k = actions.shape[1]
    for i in range(len(actions)):
        total, h = 0.0, 0.5 * k * (1.0 + LOG_TWO_PI)
        for j in range(k):
            log_std = log_std_of(outputs[k + j, i])
            z = (actions[i, j] - outputs[j, i]) * math.exp(-log_std)
            total -= 0.5 * z * z + log_std + 0.5 * LOG_TWO_PI
            h += log_std
        log_density[i] = total
        entropy[i] = h


@jit
def state_gaussian_gradient(
    outputs: NDArray[np.float32],
    actions: NDArray[np.float32],
    by_log_density: NDArray[np.float32],
    by_entropy: NDArray[np.float32],
    by_outputs: NDArray[np.float32],
) -> None:
    """Write dL/d outputs (2 k, M), as of :func:`gaussian_gradient`; 0 by outputs beyond the bounds of log sigma."""
    k = actions.shape[1]
    for i in range(len(actions)):
        for j in range(k):
            log_std = log_std_of(outputs[k + j, i])
            precision = math.exp(-log_std)
            z = (actions[i, j] - outputs[j, i]) * precision
            by_outputs[j, i] = by_log_density[i] * z * precision
            by_log_std = by_log_density[i] * (z * z - 1.0) + by_entropy[i]
            free = LOG_STD_GAIN * outputs[k + j, i] + INITIAL_LOG_STD
            by_outputs[k + j, i] = LOG_STD_GAIN * by_log_std if LOWEST_LOG_STD <= free <= HIGHEST_LOG_STD else 0.0


class Softmax:
    """log p_a and H, each (M,), of p = softmax(z) as a :class:`algorithms.networks.compiled.perceptron.Head`.

    Args:
        actions: (M,) a.
    """

    def __init__(self, actions: NDArray[np.int64]):
        self.actions = actions

    def forward(self, z: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        """Both."""
        count = len(self.actions)
        self.z, self.log_z, self.h = z, np.empty(count), np.empty(count)
        log_prob, entropy = np.empty((2, count), np.float32)
        run = parallel_categorical_pass if shares_rows(count) else categorical_pass
        run(z, self.actions, log_prob, entropy, self.log_z, self.h)
        return log_prob, entropy

    def backward(self, *by_results: NDArray[np.float32]) -> NDArray[np.float32]:
        """By z."""
        by_z = np.empty_like(self.z)
        run = parallel_categorical_gradient if shares_rows(len(self.actions)) else categorical_gradient
        by_log_prob, by_entropy = map(np.ascontiguousarray, by_results)
        run(self.z, self.actions, self.log_z, self.h, by_log_prob, by_entropy, by_z)
        return by_z


class Gaussian:
    """log N(a; z, sigma) and H, each (M,), as a head.

    Args:
        actions: (M, k) a.
        log_std: (k,) log sigma.
    """

    def __init__(self, actions: NDArray[np.float32], log_std: torch.Tensor):
        self.actions, self.log_std = actions, log_std

    def forward(self, z: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        """Both."""
        self.z = z
        log_density, entropy = np.empty((2, len(self.actions)), np.float32)
        gaussian_pass(z, self.log_std.detach().numpy(), self.actions, log_density, entropy)
        return log_density, entropy

    def backward(self, *by_results: NDArray[np.float32]) -> NDArray[np.float32]:
        """By z; that by log sigma is added to its own."""
        by_z = np.empty_like(self.z)
        log_std, by_log_std = self.log_std.detach().numpy(), gradient_array(self.log_std)
        by_log_density, by_entropy = map(np.ascontiguousarray, by_results)
        gaussian_gradient(self.z, log_std, self.actions, by_log_density, by_entropy, by_z, by_log_std)
        return by_z


class StateGaussian:
    """As :class:`Gaussian`, with log sigma among the outputs z (2 k, M).

    Args:
        actions: (M, k) a.
    """

    def __init__(self, actions: NDArray[np.float32]):
        self.actions = actions

    def forward(self, z: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        """Both."""
        self.z = z
        log_density, entropy = np.empty((2, len(self.actions)), np.float32)
        state_gaussian_pass(z, self.actions, log_density, entropy)
        return log_density, entropy

    def backward(self, *by_results: NDArray[np.float32]) -> NDArray[np.float32]:
        """By z."""
        by_z = np.empty_like(self.z)
        by_log_density, by_entropy = map(np.ascontiguousarray, by_results)
        state_gaussian_gradient(self.z, self.actions, by_log_density, by_entropy, by_z)
        return by_z


def transposed(outputs: torch.Tensor) -> NDArray[np.float32]:
    """(n, M), as the outputs (M, n) of a perceptron lie in memory."""
    array: NDArray[np.float32] = outputs.detach().t().contiguous().numpy()
    return array
