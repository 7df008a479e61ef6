"""Schedules of hyperparameters, and Adam over one vector with a clipped gradient."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

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


class Adam:
    """Adam (Kingma and Ba 2015, algorithm 1), with the interface and the numbers of ``torch.optim.Adam``.

    All parameters, and their gradients, are views of one vector, so that a step is a handful of operations, however
    many layers there are. Torch's own spends more time around a step than in it, and seconds on its import.

        optimiser = Adam(network.parameters(), lr=1e-3)
        loss = (network(x) - y).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.clip(0.5)
        optimiser.step()

    Args:
        parameters: of the networks, on their device; their data move into the vector.
        lr: learning rate; ``param_groups[0]["lr"]`` changes it.
        betas: decay of the means of the gradient and of its square.
        eps: added to the root of the latter.

    Attributes:
        vector: all parameters, with their gradient as ``vector.grad``.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ):
        parameters = list(parameters)
        self.param_groups: list[dict[str, Any]] = [{"params": parameters, "lr": lr, "betas": betas, "eps": eps}]
        self.vector = torch.cat([each.detach().flatten() for each in parameters])
        self.vector.grad, self._mean, self._mean_square = (torch.zeros_like(self.vector) for _ in range(3))
        self._steps = torch.zeros((), device=self.vector.device)
        sizes = [each.numel() for each in parameters]
        views = zip(parameters, self.vector.split(sizes), self.vector.grad.split(sizes), strict=True)
        for each, data, gradient in views:
            each.data, each.grad = data.view_as(each), gradient.view_as(each)

    @property
    def _gradient(self) -> torch.Tensor:
        assert self.vector.grad is not None
        return self.vector.grad

    def zero_grad(self) -> None:
        """Set the gradients to 0."""
        self._gradient.zero_()

    def step(self) -> None:
        """One step down the gradient."""
        group = self.param_groups[0]
        beta1, beta2 = group["betas"]
        torch._fused_adam_(
            [self.vector],
            [self._gradient],
            [self._mean],
            [self._mean_square],
            [],
            [self._steps.add_(1.0)],
            lr=group["lr"],
            beta1=beta1,
            beta2=beta2,
            weight_decay=0.0,
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
        )

    def clip(self, max_norm: float, parts: Callable[[], Mapping[str, float]] = dict) -> None:
        """Reduce the norm of the gradient to ``max_norm`` where it is larger.

        Args:
            max_norm: infinite for a check alone.
            parts: what the loss consists of by name, for the message of an error.

        Raises:
            NotFinite: if the norm is not finite; no parameter has changed.
        """
        norm = float(torch.linalg.vector_norm(self._gradient))
        if not math.isfinite(norm):
            named = ", ".join(f"{name} = {value:g}" for name, value in parts().items())
            raise NotFinite(f"the norm of the gradient = {norm} in single precision" + f" ({named})" * bool(named))
        if norm > max_norm:
            self._gradient.mul_(max_norm / (norm + 1e-6))

    def get_state(self) -> dict[str, torch.Tensor]:
        """The number of steps and the means of the gradient and of its square, in the order of the parameters."""
        return {"step": self._steps, "exp_avg": self._mean, "exp_avg_sq": self._mean_square}

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
