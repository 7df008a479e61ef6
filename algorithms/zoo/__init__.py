"""The zoo: trained policies by name, each in a subfolder with only the files that are needed to act.

``config.yaml`` is the resolved experiment that trained the policy, ``checkpoint.safetensors`` has the policy without
the state of training, and ``about.json`` describes the run it is from. A front also has ``front.csv`` and
``evaluation.json``. Every script that reads a run also accepts the name of a policy.
:mod:`algorithms.zoo.exporting` adds policies.
"""

from __future__ import annotations

import re
from pathlib import Path

from mo_deepdrive.support.names import nearest_few

ZOO = Path(__file__).resolve().parent
CONFIG, CHECKPOINT, ABOUT = "config.yaml", "checkpoint.safetensors", "about.json"
NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")


def names() -> list[str]:
    """The policies of the zoo, in alphabetical order."""
    return sorted(path.parent.name for path in ZOO.glob(f"*/{CONFIG}") if is_policy(path.parent))


def is_policy(path: Path) -> bool:
    """Whether a folder has the name and files of a policy; the files are not read."""
    return NAME.fullmatch(path.name) is not None and (path / CONFIG).is_file() and (path / CHECKPOINT).is_file()


def find(name: str) -> Path:
    """The folder of a policy.

    Raises:
        ValueError: for an unknown name, with the nearest known ones.
    """
    known = names()
    if name not in known:
        if not known:
            raise ValueError("the zoo is empty")
        near = nearest_few(name, known)
        raise ValueError(f"the zoo has no policy {name!r}; the nearest: {near}; mo-deepdrive zoo lists all")
    return ZOO / name
