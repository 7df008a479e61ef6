"""Which optional dependencies ("extras") bring a package that is not installed."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

_TRAIN = (
    "PIL",
    "filelock",
    "imageio",
    "matplotlib",
    "polars",
    "rich",
    "safetensors",
    "tensorboard",
    "torch",
)
# The extra that brings a package, by the name under which the package is imported.
EXTRAS = {
    **dict.fromkeys(_TRAIN, "train"),
    **dict.fromkeys(("optuna", "ray", "submitit"), "sweep"),
    "morl_baselines": "peers",
    "stable_baselines3": "sb3",
    **dict.fromkeys(("onnx", "onnxruntime"), "onnx"),
    "minari": "minari",
    "numba_cuda": "cuda",
    "momaland": "momaland",
    "wandb": "wandb",
    "ziglang": "web",
}


class MissingExtraError(ImportError):
    """A package of an extra is not installed; the message says what needs it, and how to install it."""


@contextlib.contextmanager
def needed_for(what: str, extra: str | None = None) -> Iterator[None]:
    """In this context, a package that cannot be imported is reported with the extra that brings it.

    Such as "training needs torch: pip install --editable '.[train]'", where "training" is ``what`` needs it; packages
    that no extra brings keep their own error.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extra = extra or EXTRAS.get(package)
        if extra is None:
            raise
        message = f"{what} needs {package}: pip install --editable '.[{extra}]'"
        raise MissingExtraError(message, name=error.name) from error
