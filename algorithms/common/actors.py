"""Actors (policy networks): softmax and Gaussian policies over the outputs of a network.

Sampling, log-probability and entropy are compiled, with their gradients written out, where the network's outputs are
(:mod:`algorithms.common.perceptron`); else they are torch's.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import torch
from torch import nn

from algorithms.common.networks import make_network
from algorithms.common.perceptron import BLOCK, Perceptron, blocks, shares_rows
from algorithms.common.tape import current_tape
from mo_deepdrive.faults import NotFinite
from mo_deepdrive.simulation.jit import jit, parallel_jit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from algorithms.common.hyperparameters import NetworkSettings

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


def _is_compiled(outputs: torch.Tensor) -> bool:
    """Whether what follows on the outputs of a network is compiled: no gradient is wanted, or only the tape's."""
    tape = current_tape()
    unseen = not torch.is_grad_enabled() or (tape is not None and (outputs in tape or not outputs.requires_grad))
    return unseen and outputs.is_cpu and outputs.dtype == torch.float32


def check_outputs(outputs: NDArray[np.float32], num_envs: int | None = None) -> None:
    """Refuse outputs of a policy's network from which no action can be chosen.

    Args:
        outputs: (M, ...).
        num_envs: N, where the rows are those of several steps of N environments; M if None.

    Raises:
        NotFinite: naming the environment.
    """
    wrong = ~np.isfinite(outputs)
    if wrong.any():
        row = int(np.argwhere(wrong)[0][0]) % (num_envs or len(outputs))
        raise NotFinite(
            f"environment {row}: an output of the policy's network = {outputs[wrong][0]}; it must be finite"
        )


def _checked(outputs: torch.Tensor) -> torch.Tensor:
    check_outputs(outputs.detach().cpu().numpy())
    return outputs


def _transposed(outputs: torch.Tensor) -> NDArray[np.float32]:
    """(n, M), as the outputs (M, n) of a perceptron lie in memory."""
    array: NDArray[np.float32] = outputs.detach().t().contiguous().numpy()
    return array


class _Actor(nn.Module):
    """What both kinds of policies share.

    Args:
        body: network from (..., inputs) to the parameters of the distribution.
    """

    def __init__(self, body: nn.Module):
        super().__init__()
        self.body = body

    def keep_passes(self, rows: int) -> None:
        """Let what is computed in order to act on the next ``rows`` rows serve to learn from all of them."""
        if isinstance(self.body, Perceptron) and self.body.can_be_compiled:
            self.body.keep_passes(rows)


class CategoricalActor(_Actor):
    """Softmax policy over n discrete actions; actions are int64 tensors of shape (...).

    Args:
        body: network from (..., inputs) to n logits.
    """

    def noise(self, rows: int, generator: torch.Generator) -> torch.Tensor:
        """The random numbers (rows, 1) of :meth:`sample`: uniform in [0, 1)."""
        return torch.rand(rows, generator=generator, device=generator.device).unsqueeze(-1)

    def sample(self, x: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """One action per row, by inversion: the first whose cumulative probability is above a uniform number."""
        logits = _checked(self.body(x.reshape(-1, x.shape[-1])))
        uniform = self.noise(len(logits), generator).squeeze(-1)
        if _is_compiled(logits):
            actions = np.empty(x.shape[:-1], np.int64)
            categorical_sample(_transposed(logits), 0, uniform.numpy(), actions.reshape(-1))
            return torch.from_numpy(actions)
        cumulative = logits.softmax(-1).cumsum(-1)
        below = cumulative[:, :-1] <= uniform.unsqueeze(-1) * cumulative[:, -1:]
        return below.sum(-1).view(x.shape[:-1])

    def greedy(self, x: torch.Tensor) -> torch.Tensor:
        """The most probable action per row."""
        return _checked(self.body(x)).argmax(-1)

    def log_prob_and_entropy(self, x: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-probability of ``actions`` and entropy of the policy, each (...)."""
        logits: torch.Tensor = self.body(x.reshape(-1, x.shape[-1]))
        if not _is_compiled(logits):
            log_p = logits.log_softmax(-1)
            log_prob = log_p.gather(-1, actions.reshape(-1, 1))
            return log_prob.view(actions.shape), -(log_p.exp() * log_p).sum(-1).view(actions.shape)
        z, a = _transposed(logits), actions.reshape(-1).numpy()
        log_probs, entropies = np.empty(len(a), np.float32), np.empty(len(a), np.float32)
        log_z, h = np.empty(len(a)), np.empty(len(a))
        parallel = shares_rows(len(a))
        run_forward = parallel_categorical_pass if parallel else categorical_pass
        run_forward(z, a, log_probs, entropies, log_z, h)
        results = (torch.from_numpy(log_probs), torch.from_numpy(entropies))

        def backward(by_results: Sequence[NDArray[Any]], gradients: Mapping[Any, NDArray[Any]]) -> NDArray[Any]:
            del gradients  # no parameters but the network's
            by_logits = np.empty_like(z)
            by_log_prob, by_entropy = by_results
            run_backward = parallel_categorical_gradient if parallel else categorical_gradient
            run_backward(z, a, log_z, h, by_log_prob, by_entropy, by_logits)
            return by_logits.T

        if tape := current_tape():
            tape.record(logits, results, backward)
        return _shaped(results, actions.shape)


class GaussianActor(_Actor):
    """Diagonal Gaussian policy with one log standard deviation per axis; actions are float tensors (..., k).

    The environment clips actions to its box; the log-probability is that of the unclipped sample.

    Args:
        body: network from (..., inputs) to the means of the actions.
        actions: k.
    """

    def __init__(self, body: nn.Module, actions: int):
        super().__init__(body)
        self.log_std = nn.Parameter(torch.full((actions,), INITIAL_LOG_STD))

    def noise(self, rows: int, generator: torch.Generator) -> torch.Tensor:
        """The random numbers (rows, k) of :meth:`sample`: standard normal."""
        return _standard_normal(rows, len(self.log_std), generator, self.log_std.dtype)

    def sample(self, x: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """One action per row."""
        mean = _checked(self.body(x))
        return mean + self.log_std.exp() * self.noise(mean[..., 0].numel(), generator).view(mean.shape)

    def greedy(self, x: torch.Tensor) -> torch.Tensor:
        """The mean action per row."""
        return _checked(self.body(x))

    def log_prob_and_entropy(self, x: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-density of ``actions`` and entropy of the policy, each (...)."""
        means: torch.Tensor = self.body(x.reshape(-1, x.shape[-1]))
        shape = actions.shape[:-1]
        if not _is_compiled(means):
            log_density, entropy = _log_density_and_entropy(means, self.log_std, actions.reshape(means.shape))
            return log_density.view(shape), entropy.expand(shape)
        m, a, log_std = _transposed(means), actions.reshape(means.shape).numpy(), self.log_std.detach().numpy()
        log_probs, entropies = np.empty(len(a), np.float32), np.empty(len(a), np.float32)
        gaussian_pass(m, log_std, a, log_probs, entropies)
        results = (torch.from_numpy(log_probs), torch.from_numpy(entropies))

        def backward(by_results: Sequence[NDArray[Any]], gradients: Mapping[Any, NDArray[Any]]) -> NDArray[Any]:
            by_means = np.empty_like(m)
            by_log_prob, by_entropy = by_results
            gaussian_gradient(m, log_std, a, by_log_prob, by_entropy, by_means, gradients[self.log_std])
            return by_means.T

        if tape := current_tape():
            tape.record(means, results, backward)
        return _shaped(results, shape)


class StateGaussianActor(_Actor):
    """Diagonal Gaussian policy whose standard deviation, too, depends on the state; actions are float tensors (..., k).

    As :class:`GaussianActor` otherwise. What explores in one state, or under one preference, can be certain in another.

    Args:
        body: network from (..., inputs) to k means, then k numbers of which :func:`log_std_of` makes the deviations.
        actions: k.
    """

    def __init__(self, body: nn.Module, actions: int):
        super().__init__(body)
        self.actions = actions

    def noise(self, rows: int, generator: torch.Generator) -> torch.Tensor:
        """The random numbers (rows, k) of :meth:`sample`: standard normal."""
        return _standard_normal(rows, self.actions, generator, next(self.parameters()).dtype)

    def sample(self, x: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """One action per row."""
        outputs = _checked(self.body(x.reshape(-1, x.shape[-1])))
        noise = self.noise(len(outputs), generator)
        shape = (*x.shape[:-1], self.actions)
        if _is_compiled(outputs):
            actions = np.empty(noise.shape, np.float32)
            state_gaussian_sample(_transposed(outputs), 0, noise.numpy(), actions)
            return torch.from_numpy(actions).view(shape)
        mean, log_std = self.mean_and_log_std(outputs)
        return (mean + log_std.exp() * noise).view(shape)

    def greedy(self, x: torch.Tensor) -> torch.Tensor:
        """The mean action per row."""
        return _checked(self.body(x))[..., : self.actions]

    def log_prob_and_entropy(self, x: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-density of ``actions`` and entropy of the policy, each (...)."""
        outputs: torch.Tensor = self.body(x.reshape(-1, x.shape[-1]))
        shape, flat = actions.shape[:-1], actions.reshape(-1, self.actions)
        if not _is_compiled(outputs):
            log_density, entropy = _log_density_and_entropy(*self.mean_and_log_std(outputs), flat)
            return log_density.view(shape), entropy.view(shape)
        o, a = _transposed(outputs), flat.numpy()
        log_probs, entropies = np.empty(len(a), np.float32), np.empty(len(a), np.float32)
        state_gaussian_pass(o, a, log_probs, entropies)
        results = (torch.from_numpy(log_probs), torch.from_numpy(entropies))

        def backward(by_results: Sequence[NDArray[Any]], gradients: Mapping[Any, NDArray[Any]]) -> NDArray[Any]:
            del gradients  # no parameters but the network's
            by_outputs = np.empty_like(o)
            by_log_prob, by_entropy = by_results
            state_gaussian_gradient(o, a, by_log_prob, by_entropy, by_outputs)
            return by_outputs.T

        if tape := current_tape():
            tape.record(outputs, results, backward)
        return _shaped(results, shape)

    def mean_and_log_std(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Means (..., k) and log standard deviations (..., k) that outputs (..., 2 k) of the network stand for."""
        log_std = LOG_STD_GAIN * outputs[..., self.actions :] + INITIAL_LOG_STD
        return outputs[..., : self.actions], log_std.clamp(LOWEST_LOG_STD, HIGHEST_LOG_STD)


def _log_density_and_entropy(
    mean: torch.Tensor, log_std: torch.Tensor, actions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-density log N(a; m, sigma) (M,), and H, of the shape of log sigma without its last axis."""
    z = (actions - mean) / log_std.exp()
    return (-0.5 * z.square() - log_std - 0.5 * LOG_TWO_PI).sum(-1), (log_std + 0.5 * (1.0 + LOG_TWO_PI)).sum(-1)


def _standard_normal(rows: int, k: int, generator: torch.Generator, dtype: torch.dtype) -> torch.Tensor:
    return torch.randn((rows, k), generator=generator, device=generator.device, dtype=dtype)


def _shaped(results: tuple[torch.Tensor, torch.Tensor], shape: torch.Size) -> tuple[torch.Tensor, torch.Tensor]:
    """Both in a shape; they are the same tensors, and so on the tape, if that is theirs."""
    log_prob, entropy = results
    return results if log_prob.shape == shape else (log_prob.view(shape), entropy.view(shape))


Actor = CategoricalActor | GaussianActor | StateGaussianActor


def make_actor(
    config: NetworkSettings, inputs: int, actions: int, generator: torch.Generator, *, continuous: bool
) -> Actor:
    """The policy network: Gaussian over ``actions`` axes where they are continuous, else softmax over as many.

    With ``config.state_dependent_std`` the network has two outputs per axis.

    Raises:
        ValueError: as :func:`algorithms.common.networks.make_network`.
    """
    outputs = 2 * actions if continuous and config.state_dependent_std else actions
    body = make_network(config, inputs, outputs, generator, output_gain=0.01)
    if not continuous:
        return CategoricalActor(body)
    return StateGaussianActor(body, actions) if config.state_dependent_std else GaussianActor(body, actions)
