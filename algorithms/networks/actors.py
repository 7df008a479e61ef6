"""Actors (policy networks): softmax and Gaussian policies over the outputs of a network.

What is chosen, its log-probability and the entropy are functions of those outputs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from algorithms.networks.compiled import serves
from algorithms.networks.compiled.distributions import (
    HIGHEST_LOG_STD,
    INITIAL_LOG_STD,
    LOG_STD_GAIN,
    LOG_TWO_PI,
    LOWEST_LOG_STD,
    Gaussian,
    Softmax,
    StateGaussian,
    categorical_sample,
    state_gaussian_sample,
    transposed,
)
from algorithms.networks.compiled.perceptron import Perceptron, pass_through
from algorithms.networks.modules import make_network
from mo_deepdrive.faults import NotFinite

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from algorithms.hyperparameters import NetworkSettings
    from algorithms.networks.compiled.perceptron import Head


def check_outputs(outputs: NDArray[np.float32], num_envs: int | None = None, vehicles: int = 1) -> None:
    """Refuse outputs of a policy's network from which no action can be chosen.

    Args:
        outputs: (M, ...).
        num_envs: N, where the rows are those of several steps of N environments; M if None.
        vehicles: how many rows an environment has in a step.

    Raises:
        NotFinite: naming the environment.
    """
    wrong = ~np.isfinite(outputs)
    if wrong.any():
        environment = int(np.argwhere(wrong)[0][0]) // vehicles % (num_envs or len(outputs))
        raise NotFinite(
            f"environment {environment}: an output of the policy's network = {outputs[wrong][0]}; it must be finite"
        )


def softmax_log_prob_and_entropy(logits: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Log p_a and the entropy of p = softmax(z), each (...), for logits z (..., n) and actions a (...)."""
    log_p = logits.log_softmax(-1)
    return log_p.gather(-1, actions.unsqueeze(-1)).squeeze(-1), -(log_p.exp() * log_p).sum(-1)


def gaussian_log_density_and_entropy(
    mean: torch.Tensor, log_std: torch.Tensor, actions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log N(a; m, sigma) and the entropy, each (...), for m and a (..., k) and log sigma (..., k) or (k,)."""
    z = (actions - mean) / log_std.exp()
    log_density = (-0.5 * z.square() - log_std - 0.5 * LOG_TWO_PI).sum(-1)
    return log_density, (log_std + 0.5 * (1.0 + LOG_TWO_PI)).sum(-1).expand_as(log_density)


class _Actor(nn.Module, ABC):
    """A policy; calling it gives the log-probability of actions and its entropy.

    Args:
        body: network from (..., inputs) to the parameters of the distribution.
    """

    def __init__(self, body: nn.Module):
        super().__init__()
        self.body = body

    @abstractmethod
    def noise(self, rows: int, generator: torch.Generator) -> torch.Tensor:
        """The random numbers (rows, ...) of :meth:`choose`."""

    @abstractmethod
    def choose(self, outputs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Actions (M,) or (M, k) for outputs (M, ...) of the body and random numbers."""

    @abstractmethod
    def best(self, outputs: torch.Tensor) -> torch.Tensor:
        """The most probable actions (...) or (..., k) for outputs (..., n) of the body."""

    @abstractmethod
    def evaluate(self, outputs: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-probability of ``actions`` and entropy, each (...), for outputs (..., n) of the body."""

    @abstractmethod
    def _head(self, actions: NDArray[Any]) -> Head:
        """The compiled twin of :meth:`evaluate` for actions (M, ...)."""

    def sample(self, x: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """One action per row."""
        outputs = self._outputs(x)
        rows = outputs.reshape(-1, outputs.shape[-1])
        actions = self.choose(rows, self.noise(len(rows), generator))
        return actions.view(*x.shape[:-1], *actions.shape[1:])

    def greedy(self, x: torch.Tensor) -> torch.Tensor:
        """The most probable action per row."""
        return self.best(self._outputs(x))

    def forward(self, x: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-probability of ``actions`` and entropy of the policy, each (...)."""
        if not (isinstance(self.body, Perceptron) and self.body.serves(x)):
            return self.evaluate(self.body(x), actions)
        shape = x.shape[:-1]
        head = self._head(actions.detach().reshape(-1, *actions.shape[len(shape) :]).numpy())
        log_prob, entropy = pass_through(self.body, x.reshape(-1, x.shape[-1]), head)
        return (log_prob, entropy) if len(shape) == 1 else (log_prob.view(shape), entropy.view(shape))

    def _outputs(self, x: torch.Tensor) -> torch.Tensor:
        outputs: torch.Tensor = self.body(x)
        check_outputs(outputs.detach().cpu().numpy())
        return outputs


class CategoricalActor(_Actor):
    """Softmax policy over n discrete actions; actions are int64 tensors of shape (...).

    Args:
        body: network from (..., inputs) to n logits.
    """

    def noise(self, rows: int, generator: torch.Generator) -> torch.Tensor:
        """Uniform in [0, 1): (rows, 1)."""
        return torch.rand((rows, 1), generator=generator, device=generator.device)

    def choose(self, outputs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """By inversion: the first action whose cumulative probability is above a uniform number."""
        if serves(outputs):
            actions = np.empty(len(outputs), np.int64)
            categorical_sample(transposed(outputs), 0, noise[:, 0].numpy(), actions)
            return torch.from_numpy(actions)
        cumulative = outputs.softmax(-1).cumsum(-1)
        return (cumulative[..., :-1] <= noise * cumulative[..., -1:]).sum(-1)

    def best(self, outputs: torch.Tensor) -> torch.Tensor:
        """The action of the largest logit."""
        return outputs.argmax(-1)

    def evaluate(self, outputs: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As :func:`softmax_log_prob_and_entropy`."""
        return softmax_log_prob_and_entropy(outputs, actions)

    def _head(self, actions: NDArray[Any]) -> Head:
        return Softmax(actions)


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
        """Standard normal: (rows, k)."""
        return _standard_normal(rows, len(self.log_std), generator, self.log_std.dtype)

    def choose(self, outputs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """M + sigma x."""
        return outputs + self.log_std.exp() * noise

    def best(self, outputs: torch.Tensor) -> torch.Tensor:
        """The mean."""
        return outputs

    def evaluate(self, outputs: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As :func:`gaussian_log_density_and_entropy`."""
        return gaussian_log_density_and_entropy(outputs, self.log_std, actions)

    def _head(self, actions: NDArray[Any]) -> Head:
        return Gaussian(actions, self.log_std)


class StateGaussianActor(_Actor):
    """Diagonal Gaussian policy whose standard deviation, too, depends on the state; actions are float tensors (..., k).

    As :class:`GaussianActor` otherwise. What explores in one state, or under one preference, can be certain in another.

    Args:
        body: network from (..., inputs) to k means, then k numbers of which the deviations are made.
        actions: k.
    """

    def __init__(self, body: nn.Module, actions: int):
        super().__init__(body)
        self.actions = actions

    def noise(self, rows: int, generator: torch.Generator) -> torch.Tensor:
        """Standard normal: (rows, k)."""
        return _standard_normal(rows, self.actions, generator, next(self.parameters()).dtype)

    def choose(self, outputs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """M + sigma x."""
        if serves(outputs):
            actions = np.empty(noise.shape, np.float32)
            state_gaussian_sample(transposed(outputs), 0, noise.numpy(), actions)
            return torch.from_numpy(actions)
        mean, log_std = self.mean_and_log_std(outputs)
        return mean + log_std.exp() * noise

    def best(self, outputs: torch.Tensor) -> torch.Tensor:
        """The mean."""
        return outputs[..., : self.actions]

    def evaluate(self, outputs: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As :func:`gaussian_log_density_and_entropy`."""
        return gaussian_log_density_and_entropy(*self.mean_and_log_std(outputs), actions)

    def _head(self, actions: NDArray[Any]) -> Head:
        return StateGaussian(actions)

    def mean_and_log_std(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Means (..., k) and log standard deviations (..., k) that outputs (..., 2 k) of the network stand for."""
        log_std = LOG_STD_GAIN * outputs[..., self.actions :] + INITIAL_LOG_STD
        return outputs[..., : self.actions], log_std.clamp(LOWEST_LOG_STD, HIGHEST_LOG_STD)


def _standard_normal(rows: int, k: int, generator: torch.Generator, dtype: torch.dtype) -> torch.Tensor:
    return torch.randn((rows, k), generator=generator, device=generator.device, dtype=dtype)


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
