"""Cores and memory in containers: files of control groups, as Linux writes them."""

from __future__ import annotations

import math
import os
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.support.machine import GIB, available_cores, available_memory

V2 = "0::/user/a\n"


def lay_out(root: Path, cgroup: str, files: dict[str, str]) -> None:
    """Write files below a root; their names are relative to the folder of control groups, or begin with "proc"."""
    for name, text in {"proc/self/cgroup": cgroup, **files}.items():
        path = root / name if name.startswith("proc") else root / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.mark.parametrize(
    ("cgroup", "files", "cores"),
    [
        ("", {}, 8),
        (V2, {"cpu.max": "250000 100000\n"}, 2),
        (V2, {"user/cpu.max": "150000 100000", "user/a/cpu.max": "400000 100000"}, 1),
    ],
)
def test_the_quota_of_a_container_limits_the_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cgroup: str, files: dict[str, str], cores: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    lay_out(tmp_path, cgroup, files)
    assert available_cores(tmp_path) == cores


MEMINFO = {"proc/meminfo": "MemTotal: 64 kB\nMemAvailable:  32 kB\nSwapFree: 8 kB\n"}


@pytest.mark.parametrize(
    ("cgroup", "files", "available"),
    [
        ("", {}, math.inf),
        ("", MEMINFO, 40960),
        (
            V2,
            {"user/memory.max": "9000", "user/memory.current": "5000", "user/memory.stat": "active_file 70"},
            4070,
        ),
    ],
)
def test_the_limit_of_a_container_limits_the_memory(
    tmp_path: Path, cgroup: str, files: dict[str, str], available: float
) -> None:
    lay_out(tmp_path, cgroup, files)
    assert available_memory(tmp_path) == available


def test_worlds_and_episodes_that_do_not_fit_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mo_deepdrive.support.machine.available_memory", lambda: GIB)
    with pytest.raises(ValueError, match=r"^num_envs = 10000000 takes at least 5\.5 GiB of memory; 1\.0 GiB are"):
        gymnasium.make_vec("mo-deepdrive-one-waypoint-v0", num_envs=10**7)
    with pytest.raises(ValueError, match=r"^episodes = 1000000000 takes at least 37\.3 GiB of memory; 1\.0 GiB are"):
        evaluate(lambda seen, *_: np.zeros(len(seen)), "mo-deepdrive-one-waypoint-v0", seed=0, episodes=10**9)
