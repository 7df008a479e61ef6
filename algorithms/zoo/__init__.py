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
    """The policies of the zoo, in alphabetical order; their files are not read."""
    folders = {path.parent for path in ZOO.glob(f"*/{CONFIG}")} & {path.parent for path in ZOO.glob(f"*/{CHECKPOINT}")}
    return sorted(folder.name for folder in folders if NAME.fullmatch(folder.name))


def find(name: str) -> Path:
    """The folder of a policy; an unknown name is a ValueError with the nearest known ones."""
    known = names()
    if name not in known:
        near = f"the zoo has no policy {name!r}; the nearest: {nearest_few(name, known)}; mo-deepdrive zoo lists all"
        raise ValueError(near if known else "the zoo is empty")
    return ZOO / name
