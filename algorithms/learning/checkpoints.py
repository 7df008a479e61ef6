"""Checkpoints: named tensors and the identity of their agent in one safetensors file; reading one runs no code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_safetensors

from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.support.faults import NotFinite

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

FORMAT = 1
POLICY_ONLY = "policy_only"  # entry of the identity in files that hold the policy alone
PARTNERS = "partners"  # entry of the identity: what identifies the drivers of vehicles that do not learn
GUIDES = "guides"  # entry of the identity: what identifies the guides of vehicles that learn, and when they drive
# Entries of the identity: environment steps taken, updates, and the seed of the run.
STEP, UPDATES, SEED = "step", "updates", "seed"
RESIDENT = "resident"  # entry: whether the worlds were on the device


def strip_prefix(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The entries whose names start with ``prefix``, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


def write_checkpoint(path: str | Path, tensors: Mapping[str, Tensor], identity: Mapping[str, Any]) -> None:
    """Write named tensors and the identity of their agent, atomically; none if a number is not finite."""
    if wrong := _not_finite(tensors):
        raise NotFinite(f"a checkpoint would have {wrong}; every number must be finite")
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    metadata = {"checkpoint": json.dumps({"format": FORMAT, **identity})}
    atomic_write(Path(path), to_safetensors(plain, metadata=metadata))


def read_checkpoint(
    path: str | Path, identity: Mapping[str, Any], may_differ: tuple[str, ...] = (), *, whole: bool = False
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of a checkpoint and the identity of the agent that wrote it, which must be that of the reader.

    Entries in ``may_differ`` need not be equal; ``whole`` refuses a file that holds the policy alone.
    """
    try:
        with safe_open(path, framework="pt") as file:
            found = json.loads((file.metadata() or {}).get("checkpoint", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (OSError, SafetensorError, ValueError) as error:
        raise ValueError(f"checkpoint {path} cannot be read: {error}") from None
    if whole and found.get(POLICY_ONLY):
        raise ValueError(
            f"checkpoint {path} holds the policy alone, like those of the zoo: it can be evaluated, "
            "but training cannot be resumed from it"
        )
    for key, value in {"format": FORMAT, **identity}.items():
        if key not in may_differ and found.get(key) != value:
            raise ValueError(f"checkpoint {path} has {key} = {found.get(key)!r}; this agent has {value!r}")
    if wrong := _not_finite(tensors):
        raise ValueError(f"checkpoint {path} has {wrong}; every number must be finite")
    return tensors, found


def check_tensors(
    path: str | Path,
    tensors: Mapping[str, Tensor],
    expected: Mapping[str, Tensor],
    varying: tuple[str, ...] = (),
    *,
    whole: bool,
) -> dict[str, Tensor]:
    """The tensors of a checkpoint that the reader expects, of the same shapes and types unless a part of a name varies.

    ``whole`` refuses tensors that are not expected.
    """

    def varies(name: str) -> bool:
        return any(part in name for part in varying)

    for name in [name for name in expected if not varies(name)]:
        found, needed, where = tensors.get(name), expected[name], f"checkpoint {path} has {name!r} of"
        if found is None or found.shape != needed.shape:
            shape = None if found is None else tuple(found.shape)
            raise ValueError(f"{where} shape {shape}; this agent needs {tuple(needed.shape)}")
        if found.dtype != needed.dtype:
            raise ValueError(f"{where} {found.dtype}; this agent needs {needed.dtype}")
    known = {name: tensor for name, tensor in tensors.items() if name in expected or varies(name)}
    if whole and len(known) < len(tensors):
        unknown = min(tensors.keys() - known.keys())
        raise ValueError(f"checkpoint {path} has {unknown!r}, which this agent does not know")
    return known


def _not_finite(tensors: Mapping[str, Tensor]) -> str:
    """The first tensor that is not finite, with the first such number; nothing if all are."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            return f"{name!r} with {float(tensor[~tensor.isfinite()][0])}"
    return ""
