"""Compiled twins of what is plain torch elsewhere, for float32 on the CPU: the same numbers, with less around them."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

import numba
import torch

if TYPE_CHECKING:
    from collections.abc import Iterator

_enabled = True


def set_compiled(enabled: bool) -> None:
    """Let the compiled twins serve where they can, or torch alone everywhere."""
    global _enabled
    _enabled = enabled


@contextmanager
def plain_torch() -> Iterator[None]:
    """Torch alone within the context, as ``torch.func`` needs it."""
    before = _enabled
    set_compiled(False)
    try:
        yield
    finally:
        set_compiled(before)


def serves(tensor: torch.Tensor) -> bool:
    """Whether a compiled twin takes a tensor."""
    jitted = not numba.config.DISABLE_JIT  # type: ignore[attr-defined]  # no types
    return _enabled and jitted and tensor.is_cpu and tensor.dtype == torch.float32
