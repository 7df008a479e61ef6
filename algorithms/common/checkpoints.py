"""Checkpoints: named tensors and the identity of their agent in one safetensors file; reading one runs no code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_safetensors

from algorithms.common.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Mapping

    import torch

FORMAT = 1
POLICY_ONLY = "policy_only"  # entry of the identity in files that hold the policy alone


def strip_prefix(state: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """The entries whose names start with ``prefix``, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


def write_checkpoint(path: str | Path, tensors: Mapping[str, torch.Tensor], identity: Mapping[str, Any]) -> None:
    """Write named tensors and the identity of their agent, atomically."""
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    metadata = {"checkpoint": json.dumps({"format": FORMAT, **identity})}
    atomic_write(Path(path), to_safetensors(plain, metadata=metadata))


def read_checkpoint(
    path: str | Path, identity: Mapping[str, Any], may_differ: tuple[str, ...] = (), *, whole: bool = False
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """The tensors of a checkpoint and the identity of the agent that wrote it.

    Args:
        path: the file.
        identity: of the agent that reads; every entry must equal that in the file.
        may_differ: entries that need not be equal.
        whole: refuse a file that holds the policy alone.

    Raises:
        ValueError: if the file is missing or broken, its identity differs, or it holds the policy alone.
    """
    try:
        with safe_open(path, framework="pt") as file:
            found = json.loads((file.metadata() or {}).get("checkpoint", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (OSError, SafetensorError, json.JSONDecodeError) as error:
        raise ValueError(f"checkpoint {path} cannot be read: {error}") from None
    if whole and found.get(POLICY_ONLY):
        raise ValueError(
            f"checkpoint {path} holds the policy alone, like those of the zoo: it can be evaluated, "
            "but training cannot be resumed from it"
        )
    for key, value in {"format": FORMAT, **identity}.items():
        if key not in may_differ and found.get(key) != value:
            raise ValueError(f"checkpoint {path} has {key} = {found.get(key)!r}; this agent has {value!r}")
    return tensors, found
