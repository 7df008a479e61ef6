"""Actors (policy networks): softmax and Gaussian policies over the outputs of a network.

Sampling, log-probability and entropy are compiled (:mod:`algorithms.networks.compiled.distributions`), with their
gradients written out, where the network's outputs are; else they are torch's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from algorithms.networks.compiled.distributions import (
    HIGHEST_LOG_STD,
    INITIAL_LOG_STD,
    LOG_STD_GAIN,
    LOG_TWO_PI,
    LOWEST_LOG_STD,
    categorical_gradient,
    categorical_pass,
    categorical_sample,
    gaussian_gradient,
    gaussian_pass,
    parallel_categorical_gradient,
    parallel_categorical_pass,
    state_gaussian_gradient,
    state_gaussian_pass,
    state_gaussian_sample,
)
from algorithms.networks.compiled.perceptron import Perceptron, shares_rows
from algorithms.networks.compiled.tape import current_tape
from algorithms.networks.modules import make_network
from mo_deepdrive.faults import NotFinite

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from algorithms.hyperparameters import NetworkSettings


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
        ValueError: as :func:`algorithms.networks.modules.make_network`.
    """
    outputs = 2 * actions if continuous and config.state_dependent_std else actions
    body = make_network(config, inputs, outputs, generator, output_gain=0.01)
    if not continuous:
        return CategoricalActor(body)
    return StateGaussianActor(body, actions) if config.state_dependent_std else GaussianActor(body, actions)
