"""Multilayer perceptrons, users' own networks, and the network of PCN."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from algorithms.learning.threads import limited_threads
from mo_deepdrive.support.importing import import_named

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from algorithms.hyperparameters import Activation, NetworkSettings

ACTIVATIONS: dict[Activation, type[nn.Module]] = {
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "silu": nn.SiLU,
    "leaky_relu": nn.LeakyReLU,
}


class _Linear(nn.Linear):
    """A linear layer whose parameters are initialised by its maker, from a generator."""

    def reset_parameters(self) -> None:
        """Leave them: torch's own initialisation would draw from the global generator."""


@limited_threads()
def mlp(
    inputs: int,
    hidden: Sequence[int],
    outputs: int,
    generator: torch.Generator,
    output_gain: float,
    activation: Activation = "relu",
) -> nn.Sequential:
    """Linear layers, orthogonally initialised from ``generator``, with ReLU (paper, appendix A) or another function."""
    layers: list[nn.Module] = []
    gains = [math.sqrt(2)] * len(hidden) + [output_gain]
    for (fan_in, fan_out), gain in zip(pairwise([inputs, *hidden, outputs]), gains, strict=True):
        layer = _Linear(fan_in, fan_out)
        nn.init.orthogonal_(layer.weight, gain=gain, generator=generator)
        nn.init.zeros_(layer.bias)
        layers += [layer, ACTIVATIONS[activation]()]
    return nn.Sequential(*layers[:-1])


@limited_threads()
def make_network(
    config: NetworkSettings, inputs: int, outputs: int, generator: torch.Generator, *, output_gain: float = 1.0
) -> nn.Module:
    """A network from (..., inputs) to (..., outputs): ``config.network``'s, else a multilayer perceptron.

    ``output_gain`` scales the initial weights of the last layer; a user's network has its own initialisation.
    """
    if config.network is None:
        return mlp(inputs, config.hidden, outputs, generator, output_gain, config.activation)
    return _users_network(config.network, inputs, outputs, generator)


def _users_network(path: str, inputs: int, outputs: int, generator: torch.Generator) -> nn.Module:
    function = import_named("algorithm.network", path)
    # Layers initialise themselves from the global generator, which is seeded for the call and then restored.
    with torch.random.fork_rng(devices=()), torch.enable_grad():  # noqa: TID251
        torch.manual_seed(int(torch.randint(2**62, (1,), generator=generator)))  # noqa: TID251
        try:
            network = function(inputs, outputs, generator)
            if not isinstance(network, nn.Module):
                raise TypeError(f"it returns {network!r}, not a torch.nn.Module")
            state = torch.get_rng_state()
            result = network(torch.zeros(3, 2, inputs))
            if result.shape != (3, 2, outputs):
                raise TypeError(f"it maps shape {(3, 2, inputs)} to {tuple(result.shape)}, not {(3, 2, outputs)}")
            if not torch.equal(torch.get_rng_state(), state):
                raise TypeError("the network draws random numbers when it is called, as dropout does")
            result.sum().backward()
            unused = [name for name, parameter in network.named_parameters() if parameter.grad is None]
            if unused:
                raise TypeError(f"the network does not learn its parameters {', '.join(unused)}")
        except Exception as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            call = f"algorithm.network = {path!r}: ({inputs}, {outputs}, generator)"
            raise ValueError(f"{call} cannot be used: {reason}") from error
    network.zero_grad()
    return network


class CommandNetwork(nn.Module):
    """The network of Pareto Conditioned Networks: f(s, c) = MLP(sigmoid(W_s s) * sigmoid(W_c c)), W with biases.

    That is figure 2 of Reymond et al. (2022). ``hidden`` are the widths of the embeddings, then of the layers after
    them. With ``standardised`` inputs, of mean 0 and standard deviation 1, the embeddings before the sigmoid begin with
    a variance near 1, else with a smaller one.
    """

    FEW_ROWS = 64

    def __init__(
        self,
        inputs: int,
        commands: int,
        hidden: Sequence[int],
        outputs: int,
        generator: torch.Generator,
        *,
        standardised: bool = False,
    ):
        super().__init__()
        widths = (inputs, commands)
        gains = [math.sqrt(max(1.0, hidden[0] / width)) if standardised else 1.0 for width in widths]
        self.observation = mlp(inputs, (), hidden[0], generator, output_gain=gains[0])
        self.command = mlp(commands, (), hidden[0], generator, output_gain=gains[1])
        self.body = mlp(hidden[0], hidden[1:], outputs, generator, output_gain=0.01)
        self._tensors = [*self.parameters()]

    def forward(self, observations: Tensor, commands: Tensor) -> Tensor:
        """(n, outputs) for scaled observations (n, o) and commands (n, c)."""
        outputs: Tensor = self.body(self.observation(observations).sigmoid() * self.command(commands).sigmoid())
        return outputs

    def respond(self, observations: NDArray[np.float32], commands: NDArray[np.float32]) -> NDArray[np.float32]:
        """:meth:`forward` of arrays, without a gradient.

        On few rows the time goes into calling operations, and NumPy's take half as long as torch's.
        """
        if len(observations) > self.FEW_ROWS:
            with torch.inference_mode():
                return np.asarray(self(torch.from_numpy(observations), torch.from_numpy(commands)))
        seen, seen_bias, asked, asked_bias, *body = (tensor.detach().numpy() for tensor in self._tensors)
        # sigmoid(x) = (1 + tanh(x / 2)) / 2
        x = np.tanh(0.5 * (observations @ seen.T + seen_bias)) + 1.0
        x *= np.tanh(0.5 * (commands @ asked.T + asked_bias)) + 1.0
        x *= 0.25
        for weight, bias in zip(body[:-2:2], body[1:-2:2], strict=True):
            x = np.maximum(x @ weight.T + bias, 0.0)
        return np.asarray(x @ body[-2].T + body[-1])
