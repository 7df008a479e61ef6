"""Functions of tensors that ``torch.compile`` makes into few kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils import _pytree as pytree

if TYPE_CHECKING:
    from collections.abc import Callable

BACKEND = "inductor"


class Compiled:
    """A function of trees of tensors, compiled at its first call with arguments of these shapes.

    It is traced through ``torch.func``, of which ``torch.compile`` then sees nothing but operations. What is no tensor,
    and tensors that are no arguments, stay what they were when it was traced; tensors in its results are new ones.

    Args:
        function: gives a tree of tensors, and may change its arguments in place.
        enabled: whether it is compiled; else it is called as it is.
    """

    def __init__(self, function: Callable[..., Any], *, enabled: bool):
        self._function, self._enabled = function, enabled
        self._compiled: dict[Any, tuple[Callable[..., Any], pytree.TreeSpec]] = {}

    @torch.no_grad()
    def __call__(self, *arguments: Any) -> Any:
        """The function's result."""
        if not self._enabled:
            return self._function(*arguments)
        leaves, form = pytree.tree_flatten(arguments)
        key = (str(form), *(tuple(each.shape) for each in leaves))
        if key not in self._compiled:
            forms: list[pytree.TreeSpec] = []

            def flat(*leaves: torch.Tensor) -> list[Any]:
                found, form_of_found = pytree.tree_flatten(self._function(*pytree.tree_unflatten(leaves, form)))
                forms.append(form_of_found)
                return found

            traced = make_fx(flat)(*map(_copy, leaves))
            self._compiled[key] = torch.compile(traced, backend=BACKEND, fullgraph=True, dynamic=False), forms[0]
        compiled, form = self._compiled[key]
        return pytree.tree_unflatten(compiled(*leaves), form)


def _copy(tensor: torch.Tensor) -> torch.Tensor:
    """A tensor of the same strides, for operations depend on them."""
    return torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device=tensor.device).copy_(tensor)
