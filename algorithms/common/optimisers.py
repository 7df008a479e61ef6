"""Schedules of optimisers, and their state as named tensors for checkpoints."""

from __future__ import annotations

from collections.abc import Mapping

import torch


def linear(start: float, end: float | None, progress: float) -> float:
    """What has come at ``progress`` in [0, 1] of the way from ``start`` to ``end``; ``start`` where there is no end."""
    return start if end is None else start + (end - start) * min(1.0, progress)


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """Everything that the optimiser remembers, as ``index.name``."""
    return {
        f"{index}.{name}": tensor
        for index, entries in optimiser.state_dict()["state"].items()
        for name, tensor in entries.items()
    }


def set_optimiser_state(optimiser: torch.optim.Optimizer, state: Mapping[str, torch.Tensor]) -> None:
    """Resume from :func:`optimiser_state`.

    Raises:
        ValueError: if the state is of some of the optimiser's parameters only.
    """
    entries: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in state.items():
        index, _, entry = name.partition(".")
        entries.setdefault(int(index), {})[entry] = tensor
    count = sum(len(group["params"]) for group in optimiser.param_groups)
    if entries and sorted(entries) != list(range(count)):
        raise ValueError(f"the optimiser's state is of parameters {sorted(entries)}; it has {count}")
    optimiser.load_state_dict({**optimiser.state_dict(), "state": entries})
