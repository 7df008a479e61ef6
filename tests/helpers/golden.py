"""Trajectories recorded from the original simulator: the sample in the repository and, where present, the full set.

    python -m tests.helpers.golden ../shared/golden

writes the sample again from the full set in that directory. The result depends on the full set alone.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.helpers.paths import REPOSITORY

SAMPLE = REPOSITORY / "tests" / "mo_deepdrive" / "simulation" / "data" / "golden"
FULL_SET = REPOSITORY.parent / "shared" / "golden"
FILES = ("episodes.json", "steps.npz")
ALWAYS = (55, 105)  # a scenario that the environments refuse; vehicles that touch as the left turn ends for itself
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


def select(episodes: dict[int, list[Entry]]) -> list[int]:
    """The numbers of the episodes in the sample.

    In each scenario these are the shortest episode (the first one of equals) with each action set, with each changed
    setting, and with each combination of ends; and ALWAYS.
    """
    shortest: dict[tuple[str, ...], tuple[int, int]] = {}
    for number, vehicles in sorted(episodes.items()):
        first = vehicles[0]
        length = first["rows"][1] - first["rows"][0]
        for name, value in (
            ("actions", first["actions"]),
            ("settings", first["settings"]),
            ("ends", [entry["end"] for entry in vehicles]),
        ):
            key = (first["scenario"], name, json.dumps(value))
            shortest[key] = min(shortest.get(key, (length, number)), (length, number))
    return sorted({*(number for _, number in shortest.values()), *ALWAYS})


def make_sample(full: Golden) -> tuple[list[Entry], dict[str, np.ndarray]]:
    """The entries of the sample, with their rows renumbered, and the rows by column."""
    entries, rows, count = [], [], 0
    for number in select(full.episodes):
        for entry in full.episodes[number]:
            first, last = entry["rows"]
            rows.append(np.arange(first, last))
            entries.append({**entry, "rows": [count, count + last - first]})
            count += last - first
    kept = np.concatenate(rows)
    return entries, {name: column[kept] for name, column in full.steps.items()}


def main(arguments: list[str]) -> int:
    """Write the sample from the full set in the directory ``arguments[0]``; the exit code."""
    if len(arguments) != 1 or not is_complete(Path(arguments[0])):
        print("usage: python -m tests.helpers.golden DIRECTORY_OF_THE_FULL_SET", file=sys.stderr)
        return 2
    entries, steps = make_sample(read_golden("full set", Path(arguments[0])))
    lines = ",\n".join(json.dumps(entry) for entry in entries)
    (SAMPLE / "episodes.json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    np.savez_compressed(SAMPLE / "steps.npz", **steps)  # type: ignore[arg-type]  # NumPy's stub forgets **arrays
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
