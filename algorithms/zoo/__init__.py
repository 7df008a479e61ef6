"""Trained policies by name: each is a folder here that holds what driving needs, and no more.

``config.yaml`` is the resolved experiment that trained it, ``checkpoint.safetensors`` the policy alone, ``about.json``
where it comes from. One that is a front also has its ``front.csv`` and ``evaluation.json``. To every script that reads
a run a name stands for one. :mod:`algorithms.zoo.exporting` adds to them.
"""

from __future__ import annotations

import re
from pathlib import Path

from mo_deepdrive.config import nearest

ZOO = Path(__file__).resolve().parent
CONFIG, CHECKPOINT = "config.yaml", "checkpoint.safetensors"
NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")


def names() -> list[str]:
    """The policies of the zoo, in alphabetical order."""
    return sorted(path.parent.name for path in ZOO.glob(f"*/{CONFIG}") if is_policy(path.parent))


def is_policy(path: Path) -> bool:
    """Whether a folder looks like a policy: by its name and files, whatever is in them."""
    return NAME.fullmatch(path.name) is not None and (path / CONFIG).is_file() and (path / CHECKPOINT).is_file()


def find(name: str) -> Path:
    """The folder of a policy.

    Raises:
        ValueError: naming the nearest policy that there is.
    """
    known = names()
    if name not in known:
        raise ValueError(f"the zoo has no policy {name!r}; {nearest(name, known)}" if known else "the zoo is empty")
    return ZOO / name
