"""Actors (policy networks): softmax and Gaussian policies over the outputs of a network.

What is chosen, its log-probability and the entropy are functions of those outputs.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from algorithms.learning.networks import make_network
from mo_deepdrive.support.faults import NotFinite

if TYPE_CHECKING:
    from algorithms.hyperparameters import NetworkSettings

LOG_TWO_PI = math.log(2 * math.pi)
INITIAL_LOG_STD = -0.5  # of Gaussian policies
LOWEST_LOG_STD, HIGHEST_LOG_STD = -5.0, 1.0  # where it depends on the state
# By which an output that depends on the state is multiplied. Adam moves all weights of a layer at once, so an output
# moves faster than a parameter of its own would; with 1, more runs stopped exploring too early (measured in
# docs/lab/conditioned.md).
LOG_STD_GAIN = 0.3


def check_outputs(outputs: Tensor) -> None:
    """Refuse outputs (N, ...) of a policy's network that are not finite, naming the environment."""
    wrong = ~outputs.isfinite()
    if wrong.any():
        environment = int(wrong.nonzero()[0, 0])
        raise NotFinite(
            f"environment {environment}: an output of the policy's network = {outputs[wrong][0]:g}; it must be finite"
        )


class Actor(nn.Module, ABC):
    """A policy; calling it gives the log-probability of actions and its entropy."""

    body: Any  # network from (..., inputs) to the parameters (..., n) of the distribution, its outputs

    def __init__(self, body: nn.Module, noise: int):
        super().__init__()
        self.body, self.noise = body, noise  # how many random numbers :meth:`choose` takes for an action

    @abstractmethod
    def draw(self, noise: Tensor, generator: torch.Generator) -> None:
        """Fill ``noise`` (..., noise) with the random numbers of :meth:`choose`."""

    @abstractmethod
    def choose(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """Actions (...) or (..., k) for outputs and random numbers (..., noise)."""

    @abstractmethod
    def best(self, outputs: Tensor) -> Tensor:
        """The most probable actions (...) or (..., k)."""

    @abstractmethod
    def evaluate(self, outputs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probability of ``actions`` and entropy, each (...)."""

    def act(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """One action per row of x (N, ..., inputs): the most probable one without a generator."""
        outputs: Tensor = self.body(x)
        check_outputs(outputs)
        if generator is None:
            return self.best(outputs)
        noise = outputs.new_empty(*outputs.shape[:-1], self.noise)
        self.draw(noise, generator)
        return self.choose(outputs, noise)

    def forward(self, x: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`evaluate` for inputs x (..., inputs)."""
        return self.evaluate(self.body(x), actions)


class CategoricalActor(Actor):
    """Softmax policy over n discrete actions, whose logits are the outputs; actions are int64 tensors (...)."""

    def __init__(self, body: nn.Module):
        super().__init__(body, noise=1)

    def draw(self, noise: Tensor, generator: torch.Generator) -> None:
        """Uniform in [0, 1)."""
        noise.uniform_(generator=generator)

    def choose(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """By inversion: the first action whose cumulative probability is above a uniform number."""
        cumulative = outputs.softmax(-1).cumsum(-1)
        return (cumulative[..., :-1] <= noise * cumulative[..., -1:]).sum(-1)

    def best(self, outputs: Tensor) -> Tensor:
        """The action of the largest logit."""
        return outputs.argmax(-1)

    def evaluate(self, outputs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Log p_a, and the entropy of p = softmax(z)."""
        log_p = outputs.log_softmax(-1)
        return log_p.gather(-1, actions.unsqueeze(-1)).squeeze(-1), -(log_p.exp() * log_p).sum(-1)


class GaussianActor(Actor):
    """Diagonal Gaussian policy over k axes; actions are float tensors (..., k).

    The outputs are the means, and each axis has one log standard deviation. The environment clips actions to its box;
    the log-probability is that of the unclipped sample.
    """

    def __init__(self, body: nn.Module, actions: int):
        super().__init__(body, noise=actions)
        self.log_std = nn.Parameter(torch.full((actions,), INITIAL_LOG_STD))

    def mean_and_log_std(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Means (..., k) and log standard deviations (..., k) or (k,) that outputs (..., n) stand for."""
        return outputs, self.log_std

    def draw(self, noise: Tensor, generator: torch.Generator) -> None:
        """Standard normal."""
        noise.normal_(generator=generator)

    def choose(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """M + sigma x."""
        mean, log_std = self.mean_and_log_std(outputs)
        return mean + log_std.exp() * noise

    def best(self, outputs: Tensor) -> Tensor:
        """The mean."""
        return self.mean_and_log_std(outputs)[0]

    def evaluate(self, outputs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Log N(a; m, sigma), and its entropy."""
        mean, log_std = self.mean_and_log_std(outputs)
        z = (actions - mean) / log_std.exp()
        log_density = (-0.5 * z.square() - log_std - 0.5 * LOG_TWO_PI).sum(-1)
        return log_density, (log_std + 0.5 * (1.0 + LOG_TWO_PI)).sum(-1).expand_as(log_density)


class StateGaussianActor(GaussianActor):
    """Gaussian policy over k axes whose standard deviation, too, depends on the state.

    What explores in one state, or under one preference, can be certain in another.
    """

    def __init__(self, body: nn.Module, actions: int):
        Actor.__init__(self, body, noise=actions)

    def mean_and_log_std(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Both halves of the outputs (..., 2 k)."""
        mean, log_std = outputs.split(self.noise, dim=-1)
        return mean, (LOG_STD_GAIN * log_std + INITIAL_LOG_STD).clamp(LOWEST_LOG_STD, HIGHEST_LOG_STD)


def make_actor(
    config: NetworkSettings, inputs: int, actions: int, generator: torch.Generator, *, continuous: bool
) -> Actor:
    """The policy network: Gaussian over ``actions`` axes where they are continuous, else softmax over as many."""
    of_state = continuous and config.state_dependent_std
    body = make_network(config, inputs, 2 * actions if of_state else actions, generator, output_gain=0.01)
    if not continuous:
        return CategoricalActor(body)
    return StateGaussianActor(body, actions) if of_state else GaussianActor(body, actions)
