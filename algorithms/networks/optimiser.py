"""Schedules of hyperparameters, and Adam with a clipped gradient."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch

from algorithms.networks.compiled.tape import Tape, recording
from algorithms.networks.losses import Loss
from mo_deepdrive.faults import NotFinite, check_numbers

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping


def linear_schedule(start: float, end: float | None, progress: float) -> float:
    """The value at ``progress`` in [0, 1] on the line from ``start`` to ``end``; ``start`` if ``end`` is None."""
    return start if end is None else start + (end - start) * min(1.0, progress)


def geometric_schedule(start: float, end: float, progress: float) -> float:
    """The value at ``progress`` in [0, 1] between ``start`` and ``end``, by a constant factor; 0 if ``start`` is 0."""
    return 0.0 if start == 0.0 else start * (end / start) ** min(1.0, progress)


class Adam:
    """Adam (Kingma and Ba 2015, algorithm 1) after clipping the norm of the gradient, as ``torch.optim.Adam`` does it.

    All parameters are views of one vector, so that a step is a handful of operations however many layers there are.

        optimiser = Adam(network.parameters())
        with optimiser.recording():
            loss = (network(x) - y).square().mean()
        optimiser.minimise(loss, learning_rate=1e-3, max_grad_norm=0.5)

    Args:
        parameters: of the networks, on their device; their data move into the vector.
        beta1, beta2: decay of the means of the gradient and of its square.
        epsilon: added to the root of the latter.

    Attributes:
        gradients: of the last step by parameter, after clipping.
        steps: number of steps so far.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        *,
        beta1: float = 0.9,
        beta2: float = 0.999,
        epsilon: float = 1e-8,
    ):
        self.parameters = list(parameters)
        self.beta1, self.beta2, self.epsilon = beta1, beta2, epsilon
        self.steps = 0
        self._vector = torch.cat([parameter.detach().flatten() for parameter in self.parameters])
        self._gradient, self._mean, self._mean_square = (torch.zeros_like(self._vector) for _ in range(3))
        self._step = torch.zeros((), device=self._vector.device)  # torch takes it as a tensor
        for parameter, values in zip(self.parameters, self._parts(self._vector), strict=True):
            parameter.data = values
        self.gradients = dict(zip(self.parameters, self._parts(self._gradient), strict=True))
        on_cpu = self._gradient.device.type == "cpu"
        self._arrays = {each: gradient.numpy() for each, gradient in self.gradients.items()} if on_cpu else {}
        self._tape = Tape()

    def _parts(self, vector: torch.Tensor) -> list[torch.Tensor]:
        """Views of a vector in the shapes of the parameters."""
        parts = vector.split([parameter.numel() for parameter in self.parameters])
        return [part.view_as(parameter) for part, parameter in zip(parts, self.parameters, strict=True)]

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Within the context, networks note their gradients for the next :meth:`minimise`, which is then faster."""
        with recording() as self._tape:
            yield

    def minimise(
        self,
        loss: torch.Tensor | Loss,
        learning_rate: float,
        max_grad_norm: float | None = None,
        parts: Mapping[str, float | Loss] | None = None,
    ) -> None:
        """One step down the gradient of ``loss``.

        Args:
            loss: a scalar.
            learning_rate: of the step.
            max_grad_norm: to which the norm of the gradient is reduced where it is larger.
            parts: what the loss consists of by name, for the message of an error.

        Raises:
            NotFinite: if a part, the loss or the norm of its gradient is not finite; no parameter has changed.
        """
        value = float(loss.detach() if isinstance(loss, torch.Tensor) else loss)
        if not math.isfinite(value):
            check_numbers({**(parts or {}), "loss": value})
        self._differentiate(loss)
        norm = float(torch.linalg.vector_norm(self._gradient))
        if not math.isfinite(norm):
            parts_text = "".join(f", {name} = {float(part):g}" for name, part in (parts or {}).items())
            raise NotFinite(f"the norm of the gradient = {norm} in single precision (loss = {value:g}{parts_text})")
        if max_grad_norm is not None and norm > max_grad_norm:
            self._gradient *= max_grad_norm / (norm + 1e-6)
        self.steps += 1
        torch._fused_adam_(
            [self._vector],
            [self._gradient],
            [self._mean],
            [self._mean_square],
            [],
            [self._step.fill_(self.steps)],
            lr=learning_rate,
            beta1=self.beta1,
            beta2=self.beta2,
            weight_decay=0.0,
            eps=self.epsilon,
            amsgrad=False,
            maximize=False,
        )

    def _differentiate(self, loss: torch.Tensor | Loss) -> None:
        """Fill the gradient: by autograd what is in its graph, and by the tape what leads to where the graph begins."""
        tape, self._tape = self._tape, Tape()
        by_outputs = loss.gradients if isinstance(loss, Loss) else [(loss, np.ones((), np.float32))]
        on_tape = [(outputs, gradient) for outputs, gradient in by_outputs if outputs in tape]
        in_graph = [(outputs, gradient) for outputs, gradient in by_outputs if outputs not in tape]
        self._gradient.zero_()
        if in_graph:
            outputs, gradients = zip(*in_graph, strict=True)
            found = torch.autograd.grad(
                outputs,
                [*tape.outputs, *self.parameters],
                [torch.from_numpy(each).to(self._vector) for each in gradients],
                allow_unused=True,
            )
            for leaf, by_leaf in zip((*tape.outputs, *self.parameters), found, strict=True):
                if by_leaf is None:
                    continue
                if isinstance(leaf, torch.nn.Parameter):
                    self.gradients[leaf] += by_leaf
                else:
                    on_tape.append((leaf, by_leaf.numpy()))
        tape.add_gradients(on_tape, self._arrays)

    def get_state(self) -> dict[str, torch.Tensor]:
        """The number of steps and both means as tensors named ``PARAMETER.ENTRY``; empty before the first step."""
        if self.steps == 0:
            return {}
        parts = zip(self._parts(self._mean), self._parts(self._mean_square), strict=True)
        return {
            f"{number}.{name}": tensor
            for number, (mean, mean_square) in enumerate(parts)
            for name, tensor in (
                ("step", torch.tensor(float(self.steps))),
                ("exp_avg", mean),
                ("exp_avg_sq", mean_square),
            )
        }

    def set_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`.

        Raises:
            ValueError: if the state covers only some of the parameters, or is not that of Adam for them.
        """
        entries: dict[int, dict[str, torch.Tensor]] = {}
        for name, tensor in state.items():
            index, _, entry = name.partition(".")
            if not index.isdecimal():
                raise ValueError(f"the optimiser's state has {name!r}; expected PARAMETER.ENTRY")
            entries.setdefault(int(index), {})[entry] = tensor
        if entries and sorted(entries) != list(range(len(self.parameters))):
            raise ValueError(
                f"the optimiser's state covers the parameters {sorted(entries)}; it has {len(self.parameters)}"
            )
        for number, found in sorted(entries.items()):
            parameter = self.parameters[number]
            expected = {"step": (), "exp_avg": tuple(parameter.shape), "exp_avg_sq": tuple(parameter.shape)}
            shapes = {entry: tuple(tensor.shape) for entry, tensor in found.items()}
            types = {tensor.dtype for tensor in found.values()}
            if shapes != expected or types != {parameter.dtype}:
                raise ValueError(
                    f"the optimiser's state of parameter {number} has {shapes} of {sorted(map(str, types))}; "
                    f"it must have {expected} of {parameter.dtype}"
                )
            step = float(found["step"])
            if not (0 < step < math.inf and step.is_integer()):
                raise ValueError(
                    f"the optimiser's state of parameter {number} has step = {step}; it must be a positive integer"
                )
            if bool((found["exp_avg_sq"] < 0).any()):
                raise ValueError(
                    f"the optimiser's state of parameter {number} has exp_avg_sq = {float(found['exp_avg_sq'].min())}; "
                    "it must not be negative"
                )
        steps = {int(found["step"]) for found in entries.values()} or {0}
        if len(steps) > 1:
            raise ValueError(f"the optimiser's state has parameters after different numbers of steps: {sorted(steps)}")
        (self.steps,) = steps
        means = zip(self._parts(self._mean), self._parts(self._mean_square), strict=True)
        for number, (mean, mean_square) in enumerate(means):
            mean.copy_(entries[number]["exp_avg"]) if entries else mean.zero_()
            mean_square.copy_(entries[number]["exp_avg_sq"]) if entries else mean_square.zero_()
