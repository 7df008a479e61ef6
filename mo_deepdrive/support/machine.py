"""The cores, the memory and the devices that this process may use, in a container as well."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path("/")
KIB, GIB = 2**10, 2**30
LITTLE = GIB // 4  # bytes that are not worth a look
CACHES = ("active_file", "inactive_file")  # in memory.stat: what the kernel takes back when it needs memory


def available_cores(root: Path = ROOT) -> int:
    """The number of cores that this process may use: those of its affinity mask, or fewer by its container's quota."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quotas: list[float] = [cores]
    for folder in _control_groups(root):
        quota, period = [*_text(folder / "cpu.max").split(), "", ""][:2]  # "max" for no quota
        if quota.isdecimal():
            quotas.append(int(quota) / int(period))
    return max(1, math.floor(min(quotas)))


def available_memory(root: Path = ROOT) -> float:
    """Bytes that this process can still use, of the machine (with swap) and of its container; infinite if unknown."""
    machine = _table(root / "proc/meminfo")
    swap = KIB * machine.get("SwapFree", 0)
    free = [KIB * machine["MemAvailable"] + swap] if "MemAvailable" in machine else []
    for folder in _control_groups(root):
        most, used = (_text(folder / f"memory.{name}").strip() for name in ("max", "current"))
        if most.isdecimal() and used.isdecimal():
            statistics = _table(folder / "memory.stat")
            free.append(int(most) - int(used) + sum(statistics.get(name, 0) for name in CACHES) + swap)
    return max(0, min(free)) if free else math.inf


def check_memory(what: str, needed: float) -> None:
    """Refuse an argument, ``what``, that cannot fit into memory before the bytes that it takes are allocated."""
    if needed > LITTLE and needed > (available := available_memory()):
        raise ValueError(
            f"{what} takes at least {needed / GIB:,.1f} GiB of memory; {available / GIB:,.1f} GiB are available"
        )


def check_device(argument: str, name: str, here: bool = True) -> None:
    """Refuse a device of PyTorch, the value of ``argument``, that does not exist; ``here`` means on this machine."""
    import torch  # as late as this, because it takes seconds and much memory

    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(f"{argument} = {name!r} is not a valid device; write cpu, cuda or cuda:0") from None
    count = torch.cuda.device_count()
    if here and device.type == "cuda" and (device.index or 0) >= count:
        raise ValueError(f"{argument} = {name!r} does not exist; PyTorch finds {count} CUDA devices")
    if device.type not in ("cpu", "cuda") or (device.type == "cpu" and name != "cpu"):
        raise ValueError(f"{argument} = {name!r} is not supported; write cpu, cuda or cuda:0")


def _control_groups(root: Path) -> Iterator[Path]:
    """The folders of this process's control group and of those around it, of version 2."""
    top = root / "sys/fs/cgroup"
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, group = line.split(":", 2)
        if not controllers:  # version 1 has them
            folder = top / group.lstrip("/")
            yield from (folder, *(parent for parent in folder.parents if parent.is_relative_to(top)))


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:  # there is no such file on other systems
        return ""


def _table(path: Path) -> dict[str, int]:
    """The numbers in lines of the form ``NAME NUMBER`` or ``NAME: NUMBER UNIT``."""
    rows = [line.replace(":", " ").split() for line in _text(path).splitlines()]
    return {row[0]: int(row[1]) for row in rows if len(row) > 1 and row[1].isdecimal()}
