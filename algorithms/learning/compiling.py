"""Functions of tensors that ``torch.compile`` makes into few kernels."""

from __future__ import annotations

import shutil
from contextlib import contextmanager
from pathlib import Path
from traceback import extract_tb
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

BACKEND = "inductor"
# Seconds of a CPU that compiled gradient steps must save in a training to make up for the time that compiling takes.
WORTHWHILE = {"cpu": 8.0, "cuda": 140.0}


def has_compiler(device: str) -> bool:
    """Whether ``torch.compile`` finds what it needs: a C++ compiler, and on a GPU Triton."""
    if device != "cpu":
        return torch.utils._triton.has_triton()
    from torch._inductor import config  # not earlier: it takes a second

    return any(name and shutil.which(name) for name in config.cpp.cxx)


@contextmanager
def pure(what: str, tensors: Mapping[str, Tensor]) -> Iterator[None]:
    """Refuse that tensors are changed in place where something is calculated."""
    versions = [each._version for each in tensors.values()]
    yield
    for (name, each), version in zip(tensors.items(), versions, strict=True):
        if each._version != version:
            raise ValueError(
                f"{what} must not change its tensors in place, as it does {name!r}; write x = x + y in place of x += y"
            )


class Compiled:
    """A function of trees of tensors, compiled at its first call with arguments of these shapes.

    It is traced with all that autograd does, of which the compiler then sees nothing but operations. What is no tensor,
    and tensors that are no arguments, stay what they were when it was traced; tensors in its results are new, and its
    arguments may be changed in place. It is called as it is unless ``enabled``, or with "auto" if compiling fails.
    """

    def __init__(self, function: Callable[..., Any], *, enabled: bool | Literal["auto"]):
        self._function, self._enabled = function, enabled
        self._compiled: dict[Any, tuple[Callable[..., Any], pytree.TreeSpec]] = {}

    @torch.no_grad()
    def __call__(self, *arguments: Any) -> Any:
        """The function's result."""
        if not self._enabled:
            return self._function(*arguments)
        leaves, form = pytree.tree_flatten(arguments)
        key = (str(form), *((tuple(each.shape), each.stride()) for each in leaves))
        if key not in self._compiled:
            try:
                self._compiled[key] = self._compile(leaves, form)
            except ValueError:
                if self._enabled != "auto":
                    raise
                self._enabled = False
                return self._function(*arguments)
        compiled, form = self._compiled[key]
        return pytree.tree_unflatten(compiled(*leaves), form)

    def _compile(self, leaves: list[Tensor], form: pytree.TreeSpec) -> tuple[Callable[..., Any], pytree.TreeSpec]:
        # Not earlier: it takes a second.
        from torch._dynamo import lookup_backend
        from torch._subclasses.fake_tensor import FakeTensorMode
        from torch.fx.experimental.proxy_tensor import make_fx
        from torch.fx.experimental.symbolic_shapes import ShapeEnv

        forms: list[pytree.TreeSpec] = []

        def flat(*leaves: Tensor) -> list[Any]:
            found, form_of_found = pytree.tree_flatten(self._function(*pytree.tree_unflatten(leaves, form)))
            forms.append(form_of_found)
            return found

        try:
            traced = make_fx(flat)(*map(_copy, leaves))
            # What torch.compile does after tracing. Its own tracer has nothing left to do, and its checks at every call
            # would take a tenth of a gradient step of small networks.
            mode = FakeTensorMode(shape_env=ShapeEnv())
            compiled = lookup_backend(BACKEND)(traced, [mode.from_tensor(each, static_shapes=True) for each in leaves])
            compiled(*map(_copy, leaves))
        except Exception as error:
            raise ValueError(
                f"training.compiled = True: this update cannot be compiled, because of {origin(error)}; take false, or "
                "operations of torch on whole tensors, such as torch.where instead of if"
            ) from error
        return compiled, forms[0]


def origin(error: Exception) -> str:
    """The last line outside of torch in which an error arose, and what it says, as one line."""
    inside = str(Path(torch.__file__).parent)
    last = [frame for frame in extract_tb(error.__traceback__) if not frame.filename.startswith(inside)][-1]
    reason = " ".join(str(error).split())[:300].partition(". ")[0]  # the rest asks for a report to torch
    return f"{Path(last.filename).name}:{last.lineno} `{last.line}` ({type(error).__name__}: {reason})"


def _copy(tensor: Tensor) -> Tensor:
    """A tensor of the same strides, for operations depend on them."""
    return torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device=tensor.device).copy_(tensor)
