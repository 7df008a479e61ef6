"""The networks of one learner for S seeds: parameters with the seeds as their first axis, and Adam for all of them."""

from __future__ import annotations

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


class _Networks(nn.Module):
    """Both networks of a learner, so that whatever it does can be called with other parameters."""

    def __init__(self, learner: TrainedNetworks):
        super().__init__()
        self.actor, self.critic = learner.actor, learner.critic

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
        parameters: the same by name, (S, ...).
    """

    def __init__(self, learner: TrainedNetworks, learners: Sequence[TrainedNetworks]):
        self.learner = learner
        self._networks = _Networks(learner)
        self._shapes = {name: each.shape for name, each in self._networks.named_parameters()}
        self._size = sum(shape.numel() for shape in self._shapes.values())
        device = next(self._networks.parameters()).device
        # Padded, so that every number of a seed is in the lane of a vector instruction in which it is alone.
        padded = -(-self._size // LANES) * LANES
        self.vector, self.mean, self.mean_square = torch.zeros(3, len(learners), padded, device=device)
        self._padding = torch.zeros(len(learners), padded - self._size, device=device)
        self.count = torch.zeros((), device=device)
        sizes = [shape.numel() for shape in self._shapes.values()]
        parts = zip(self._shapes.items(), self.vector[:, : self._size].split(sizes, dim=1), strict=True)
        self.parameters = {name: part.unflatten(1, shape) for (name, shape), part in parts}

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """``function`` of every seed's networks and its part of the arguments, trees of tensors (S, ...)."""
        return vmap(lambda parameters, *own: functional_call(self._networks, parameters, (function, *own)))(
            self.parameters, *arguments
        )

    def minimise(
        self,
        loss: Callable[[dict[str, torch.Tensor]], tuple[torch.Tensor, dict[str, torch.Tensor]]],
        samples: Mapping[str, torch.Tensor],
        learning_rate: torch.Tensor,
        max_grad_norm: float,
    ) -> dict[str, torch.Tensor]:
        """One step of every seed down the gradient of its loss, whose norm is clipped.

        Args:
            loss: the loss, and its parts by name, of a seed's samples.
            samples: by name, (S, ...).
            learning_rate: of Adam, a scalar.
            max_grad_norm: of each seed.

        Returns:
            The parts (S,).
        """

        def of_parameters(parameters: dict[str, torch.Tensor], own: dict[str, torch.Tensor]) -> Any:
            return functional_call(self._networks, parameters, (loss, own))

        differentiate = vmap(grad_and_value(of_parameters, has_aux=True))
        gradients, (_, parts) = differentiate(self.parameters, dict(samples))
        gradient = torch.cat([*(gradients[name].flatten(1) for name in self._shapes), self._padding], dim=1)
        norms = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
        gradient *= (max_grad_norm / (norms + TINY)).clamp(max=1.0)
        self.count += 1
        torch._fused_adam_(
            [self.vector],
            [gradient],
            [self.mean],
            [self.mean_square],
            [],
            [self.count],
            lr=learning_rate,
            beta1=BETA1,
            beta2=BETA2,
            weight_decay=0.0,
            eps=EPSILON,
            amsgrad=False,
            maximize=False,
        )
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
