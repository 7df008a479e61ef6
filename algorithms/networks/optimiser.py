"""Schedules of hyperparameters, and Adam over one vector with a clipped gradient."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from mo_deepdrive.faults import NotFinite

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping


def linear_schedule(start: float, end: float | None, progress: float) -> float:
    """The value at ``progress`` in [0, 1] on the line from ``start`` to ``end``; ``start`` if ``end`` is None."""
    return start if end is None else start + (end - start) * min(1.0, progress)


def geometric_schedule(start: float, end: float, progress: float) -> float:
    """The value at ``progress`` in [0, 1] between ``start`` and ``end``, by a constant factor; 0 if ``start`` is 0."""
    return 0.0 if start == 0.0 else start * (end / start) ** min(1.0, progress)


class Adam(torch.optim.Adam):
    """``torch.optim.Adam`` over one vector, of which the parameters and their gradients are views.

    A step is then a handful of operations, however many layers there are.

        optimiser = Adam(network.parameters(), lr=1e-3)
        loss = (network(x) - y).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.clip(0.5)
        optimiser.step()

    Args:
        parameters: of the networks, on their device; their data move into the vector.
        lr: learning rate.
    """

    def __init__(self, parameters: Iterable[torch.nn.Parameter], lr: float = 1e-3):
        parameters = list(parameters)
        self.vector = torch.nn.Parameter(torch.cat([each.detach().flatten() for each in parameters]))
        self.vector.grad = torch.zeros_like(self.vector)
        sizes = [each.numel() for each in parameters]
        for each, data, grad in zip(
            parameters, self.vector.detach().split(sizes), self.vector.grad.split(sizes), strict=True
        ):
            each.data, each.grad = data.view_as(each), grad.view_as(each)
        super().__init__([self.vector], lr=lr, fused=True)
        self.state[self.vector] = {
            "step": torch.zeros((), device=self.vector.device),
            "exp_avg": torch.zeros_like(self.vector.detach()),
            "exp_avg_sq": torch.zeros_like(self.vector.detach()),
        }

    def zero_grad(self, set_to_none: bool = False) -> None:
        """Set the gradients to 0, in their place."""
        del set_to_none
        assert self.vector.grad is not None
        self.vector.grad.zero_()

    def clip(self, max_norm: float, parts: Callable[[], Mapping[str, float]] = dict) -> None:
        """Reduce the norm of the gradient to ``max_norm`` where it is larger.

        Args:
            max_norm: infinite for a check alone.
            parts: what the loss consists of by name, for the message of an error.

        Raises:
            NotFinite: if the norm is not finite; no parameter has changed.
        """
        assert self.vector.grad is not None
        norm = float(torch.linalg.vector_norm(self.vector.grad))
        if not math.isfinite(norm):
            named = ", ".join(f"{name} = {value:g}" for name, value in parts().items())
            raise NotFinite(f"the norm of the gradient = {norm} in single precision" + f" ({named})" * bool(named))
        if norm > max_norm:
            self.vector.grad *= max_norm / (norm + 1e-6)

    def get_state(self) -> dict[str, torch.Tensor]:
        """The number of steps and the means of the gradient and of its square, in the order of the parameters."""
        return dict(self.state[self.vector])

    def set_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`.

        Raises:
            ValueError: for numbers that no optimiser has.
        """
        step, least = float(state["step"]), float(state["exp_avg_sq"].min())
        if not (step >= 0.0 and step.is_integer()):
            raise ValueError(f"the optimiser's state has step = {step}; it must be an integer from 0 on")
        if least < 0.0:
            raise ValueError(f"the optimiser's state has exp_avg_sq = {least}; it must not be negative")
        for name, tensor in self.get_state().items():
            tensor.copy_(state[name])
