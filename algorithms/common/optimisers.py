"""Schedules of hyperparameters, and the state of an optimiser as named tensors for checkpoints."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import torch


def linear_schedule(start: float, end: float | None, progress: float) -> float:
    """The value at ``progress`` in [0, 1] on the line from ``start`` to ``end``; ``start`` if ``end`` is None."""
    return start if end is None else start + (end - start) * min(1.0, progress)


def geometric_schedule(start: float, end: float, progress: float) -> float:
    """The value at ``progress`` in [0, 1] between ``start`` and ``end``, by a constant factor; 0 if ``start`` is 0."""
    return 0.0 if start == 0.0 else start * (end / start) ** min(1.0, progress)


def set_learning_rate(optimiser: torch.optim.Optimizer, learning_rate: float) -> None:
    """Use ``learning_rate`` for all parameters from now on."""
    for group in optimiser.param_groups:
        group["lr"] = learning_rate


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """The state of the optimiser as tensors named ``index.entry``."""
    return {
        f"{index}.{name}": tensor
        for index, entries in optimiser.state_dict()["state"].items()
        for name, tensor in entries.items()
    }


def set_optimiser_state(optimiser: torch.optim.Optimizer, state: Mapping[str, torch.Tensor]) -> None:
    """Resume from :func:`optimiser_state`.

    Raises:
        ValueError: if the state covers only some of the optimiser's parameters, or is not that of Adam for them.
    """
    entries: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in state.items():
        index, _, entry = name.partition(".")
        if not index.isdecimal():
            raise ValueError(f"the optimiser's state has {name!r}; expected PARAMETER.ENTRY")
        entries.setdefault(int(index), {})[entry] = tensor
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    if entries and sorted(entries) != list(range(len(parameters))):
        raise ValueError(f"the optimiser's state covers the parameters {sorted(entries)}; it has {len(parameters)}")
    for number, found in sorted(entries.items()):
        parameter = parameters[number]
        # Fused steps do not check what they are given.
        expected = {"step": (), "exp_avg": tuple(parameter.shape), "exp_avg_sq": tuple(parameter.shape)}
        shapes = {entry: tuple(tensor.shape) for entry, tensor in found.items()}
        types = {tensor.dtype for tensor in found.values()}
        if shapes != expected or types != {parameter.dtype}:
            raise ValueError(
                f"the optimiser's state of parameter {number} has {shapes} of {sorted(map(str, types))}; "
                f"it must have {expected} of {parameter.dtype}"
            )
        if not 0 <= float(found["step"]) < math.inf:
            raise ValueError(f"the optimiser's state of parameter {number} has step = {float(found['step'])}")
    optimiser.load_state_dict({**optimiser.state_dict(), "state": entries})
