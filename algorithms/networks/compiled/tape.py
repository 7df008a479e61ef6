"""A tape of operations whose gradients are written out, beside autograd's graph.

At the sizes of our networks autograd's graph costs as much as the matrix products. While a tape records, an operation
that can differentiate itself notes how, and its outputs are leaves of autograd's graph: what leads to them is on the
tape, what follows them, if anything, in the graph.
"""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    # backward(gradient by each output, gradients by parameter, to be added to) -> gradient by the input, or None
    Backward = Callable[[Sequence[NDArray[Any]], Mapping[Any, NDArray[Any]]], NDArray[Any] | None]


class Tape:
    """Operations in the order in which they were done.

    Attributes:
        outputs: of the operations, leaves of autograd's graph.
    """

    def __init__(self) -> None:
        self.outputs: list[torch.Tensor] = []
        self._operations: list[tuple[torch.Tensor, Sequence[torch.Tensor], Backward]] = []

    def record(self, source: torch.Tensor, outputs: Sequence[torch.Tensor], backward: Backward) -> None:
        """Note an operation.

        Args:
            source: its input; the gradient goes on to it if it is an output on the tape.
            outputs: what it returns; they become leaves.
            backward: its gradient, called at most once.
        """
        self.outputs += [each.requires_grad_() for each in outputs]
        self._operations.append((source, outputs, backward))

    def __contains__(self, tensor: torch.Tensor) -> bool:
        """Whether ``tensor`` is an output on the tape."""
        return any(tensor is each for each in self.outputs)

    def add_gradients(
        self, by_outputs: Iterable[tuple[torch.Tensor, NDArray[Any]]], gradients: Mapping[Any, NDArray[Any]]
    ) -> None:
        """Lead the gradient of a loss by outputs on the tape back to the parameters.

        Args:
            by_outputs: pairs of an output and a gradient by it; they add up.
            gradients: by parameter, in its shape; they are added to.
        """
        found: dict[int, NDArray[Any]] = {}

        def add(tensor: torch.Tensor, gradient: NDArray[Any]) -> None:
            before = found.get(id(tensor))
            found[id(tensor)] = gradient if before is None else before + gradient

        for output, gradient in by_outputs:
            add(output, gradient)
        for source, outputs, backward in reversed(self._operations):
            if any(id(output) in found for output in outputs):
                full = [found[id(out)] if id(out) in found else np.zeros(out.shape, np.float32) for out in outputs]
                by_source = backward(full, gradients)
                if by_source is not None:
                    add(source, by_source)


_tape: ContextVar[Tape | None] = ContextVar("tape", default=None)


def current_tape() -> Tape | None:
    """The tape that records now, if one does and gradients are wanted."""
    return _tape.get() if torch.is_grad_enabled() else None


@contextmanager
def recording() -> Iterator[Tape]:
    """A new tape, which records within the context."""
    tape = Tape()
    token = _tape.set(tape)
    try:
        yield tape
    finally:
        _tape.reset(token)
