"""Trajectories recorded from the original simulator: the sample in the repository and, where present, the full set."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.helpers.paths import REPOSITORY

SAMPLE = REPOSITORY / "tests" / "mo_deepdrive" / "simulation" / "data" / "golden"
FULL_SET = REPOSITORY.parent / "shared" / "golden"
FILES = ("episodes.json", "steps.npz")
Entry = dict[str, Any]


@dataclass(frozen=True)
class Golden:
    """Recorded trajectories.

    Attributes:
        name: "sample" or "full set".
        episodes: by number, each a list with one entry per vehicle.
        steps: the rows of all decisions, by column.
    """

    name: str
    episodes: dict[int, list[Entry]]
    steps: dict[str, np.ndarray]

    def of(self, scenario: str) -> dict[int, list[Entry]]:
        return {number: vehicles for number, vehicles in self.episodes.items() if vehicles[0]["scenario"] == scenario}


def is_complete(directory: Path) -> bool:
    return all((directory / name).is_file() for name in FILES)


def read_golden(name: str, directory: Path) -> Golden:
    episodes: dict[int, list[Entry]] = {}
    for entry in json.loads((directory / "episodes.json").read_text(encoding="utf-8")):
        episodes.setdefault(entry["episode"], []).append(entry)
    with np.load(directory / "steps.npz") as arrays:
        return Golden(name, episodes, {column: arrays[column] for column in arrays.files})
