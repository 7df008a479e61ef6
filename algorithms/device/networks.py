"""The networks of one learner for S seeds: parameters with the seeds as their first axis, and Adam for all of them."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.func import functional_call, grad_and_value, vmap

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from algorithms.networks.trained import TrainedNetworks

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
LANES = 64
TINY = 1e-6  # added to the norm of a gradient that is clipped
# Of the products of a gradient on a GPU: rows of a part, and how many parts of all seeds keep it busy.
ROWS, PARTS = 128, 256


def linear(layer: nn.Linear, most_parts: int, x: torch.Tensor) -> torch.Tensor:
    """X W^T + b, for which many rows x (M, inputs) are parted.

    The gradient dL/dW = sum_m g_m x_m^T is then a sum of products that a GPU calculates at the same time; as a single
    product of two long and narrow matrices it would leave most of the GPU idle.

    Args:
        layer: with W and b.
        most_parts: at most so many.
        x: (..., inputs).
    """
    rows = len(x) if x.dim() == 2 else 0
    parts = min(rows // ROWS, most_parts, rows & -rows)  # the last one is the greatest power of two that divides rows
    if parts < 2:
        return nn.functional.linear(x, layer.weight, layer.bias)
    parts = 1 << (parts.bit_length() - 1)
    weights = layer.weight.t().expand(parts, layer.in_features, layer.out_features)
    return torch.bmm(x.view(parts, rows // parts, layer.in_features), weights).flatten(0, 1) + layer.bias


class _Networks(nn.Module):
    """Both networks of a learner, so that whatever it does can be called with other parameters."""

    def __init__(self, learner: TrainedNetworks, most_parts: int):
        super().__init__()
        self.actor, self.critic = learner.actor, learner.critic
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                layer.forward = partial(linear, layer, most_parts)  # type: ignore[method-assign]

    def forward(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return function(*arguments)


class SeedNetworks:
    """Actor and critic of S seeds, with Adam and a clipped gradient for each.

    What a learner does for one seed, :meth:`call` does for all of them at once, by ``torch.func.vmap``; seeds do not
    meet. All parameters are views of one matrix, so that a step of Adam is one operation.

    Args:
        learner: on the device; its networks lend their structure, and their parameters are not used.
        learners: the S learners whose parameters are the first ones.

    Attributes:
        vector: (S, P) the parameters.
    """

    def __init__(self, learner: Any, learners: Sequence[TrainedNetworks]):
        on_gpu = next(learner.actor.parameters()).is_cuda
        self._networks = _Networks(learner, PARTS // len(learners) if on_gpu else 1)
        self._shapes = {name: each.shape for name, each in self._networks.named_parameters()}
        self._size = sum(shape.numel() for shape in self._shapes.values())
        self._max_grad_norm = learner.config.max_grad_norm
        device = next(self._networks.parameters()).device
        # Padded, so that every number of a seed is in the lane of a vector instruction in which it is alone.
        padded = -(-self._size // LANES) * LANES
        self.vector, self.mean, self.mean_square = torch.zeros(3, len(learners), padded, device=device)
        self._padding = torch.zeros(len(learners), padded - self._size, device=device)
        self.count = torch.zeros((), device=device)

    @property
    def state(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """What a gradient step changes: parameters, Adam's moments and the number of steps."""
        return self.vector, self.mean, self.mean_square, self.count

    def _parameters(self, vector: torch.Tensor) -> dict[str, torch.Tensor]:
        """Views of a matrix of parameters by their names, (S, ...)."""
        sizes = [shape.numel() for shape in self._shapes.values()]
        parts = zip(self._shapes.items(), vector[:, : self._size].split(sizes, dim=1), strict=True)
        return {name: part.unflatten(1, shape) for (name, shape), part in parts}

    def call(self, function: Callable[..., Any], vector: torch.Tensor, *arguments: Any) -> Any:
        """``function`` of every seed's networks and its part of the arguments, trees of tensors (S, ...).

        Args:
            function: of one seed.
            vector: (S, P), as :attr:`vector`.
            *arguments: of the function.
        """
        return vmap(lambda parameters, *own: functional_call(self._networks, parameters, (function, *own)))(
            self._parameters(vector), *arguments
        )

    def minimise(
        self,
        loss: Callable[..., tuple[torch.Tensor, dict[str, torch.Tensor]]],
        state: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
        samples: Mapping[str, torch.Tensor],
        entropy_coefficient: torch.Tensor,
        learning_rate: torch.Tensor,
    ) -> dict[str, torch.Tensor]:
        """One step of every seed down the gradient of its loss, whose norm is clipped.

        Args:
            loss: the loss, and its parts by name, of a seed's samples and c_e.
            state: as :attr:`state`; it changes in place.
            samples: by name, (S, ...).
            entropy_coefficient: c_e, a scalar.
            learning_rate: of Adam, a scalar.

        Returns:
            The parts (S, ...).
        """
        vector, mean, mean_square, count = state

        def of_parameters(parameters: dict[str, torch.Tensor], own: dict[str, torch.Tensor]) -> Any:
            return functional_call(self._networks, parameters, (loss, own, entropy_coefficient))

        differentiate = vmap(grad_and_value(of_parameters, has_aux=True))
        gradients, (_, parts) = differentiate(self._parameters(vector), dict(samples))
        gradient = torch.cat([*(gradients[name].flatten(1) for name in self._shapes), self._padding], dim=1)
        norms = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
        gradient = gradient * (self._max_grad_norm / (norms + TINY)).clamp(max=1.0)
        # Adam (Kingma and Ba 2015, algorithm 1).
        count += 1.0
        mean.lerp_(gradient, 1.0 - BETA1)
        mean_square.lerp_(gradient.square(), 1.0 - BETA2)
        root = (mean_square / (1.0 - BETA2**count)).sqrt()
        vector -= learning_rate / (1.0 - BETA1**count) * mean / (root + EPSILON)
        return {name: part.detach() for name, part in parts.items()}

    # ------------------------------------------------------------------------------- from and to a learner of one seed

    def read(self, seed: int, learner: TrainedNetworks) -> None:
        """Take the parameters and the optimiser's state of a learner as those of a seed."""
        state = learner.optimiser.get_state()
        self.vector[seed, : self._size] = learner.optimiser.vector.detach()
        self.mean[seed, : self._size], self.mean_square[seed, : self._size] = state["exp_avg"], state["exp_avg_sq"]
        self.count.copy_(state["step"])

    def write(self, seed: int, learner: TrainedNetworks) -> None:
        """Give a learner the parameters of a seed, and the optimiser's state."""
        matrices = (self.vector, self.mean, self.mean_square)
        parameters, mean, mean_square = (matrix[seed, : self._size].cpu() for matrix in matrices)
        with torch.no_grad():
            learner.optimiser.vector.copy_(parameters)
        learner.optimiser.set_state({"step": self.count.cpu(), "exp_avg": mean, "exp_avg_sq": mean_square})
