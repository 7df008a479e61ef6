"""The state of an optimiser as named tensors, for checkpoints."""

from __future__ import annotations

from collections.abc import Mapping

import torch


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """Everything that the optimiser remembers, as ``index.name``."""
    return {
        f"{index}.{name}": tensor
        for index, entries in optimiser.state_dict()["state"].items()
        for name, tensor in entries.items()
    }


def set_optimiser_state(optimiser: torch.optim.Optimizer, state: Mapping[str, torch.Tensor]) -> None:
    """Resume from :func:`optimiser_state`."""
    entries: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in state.items():
        index, _, entry = name.partition(".")
        entries.setdefault(int(index), {})[entry] = tensor
    optimiser.load_state_dict({**optimiser.state_dict(), "state": entries})
