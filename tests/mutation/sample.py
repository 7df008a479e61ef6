"""The sample of mutants in ``docs/results/mutants.csv``, for Cosmic Ray, which cannot draw or repeat one.

    python -m tests.mutation.sample keep GROUP.sqlite        # after cosmic-ray init: only the mutants of the sample
    python -m tests.mutation.sample record GROUP.sqlite ...  # after cosmic-ray exec: their outcomes, in the CSV

A mutant is recognised by its operator and its line, so it is found again where the line has moved or changed a little.
Those that make no difference are not run; the CSV has the reason. The session of a group is named after it.
"""

from __future__ import annotations

import csv
import difflib
import linecache
import sys
from collections import Counter
from pathlib import Path

from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator
from cosmic_ray.work_db import use_db
from cosmic_ray.work_item import MutationSpec, WorkItem, WorkResult

from tests.helpers.paths import REPOSITORY

SAMPLE = REPOSITORY / "docs" / "results" / "mutants.csv"
ALIKE = 0.7  # likeness above which a line is the same one, changed


def read() -> list[dict[str, str]]:
    """The rows of the sample."""
    with SAMPLE.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def job_of(row: dict[str, str]) -> str:
    """The name of a row's job in a session."""
    return f"{row['module']}:{row['operator']}:{row['occurrence']}"


def alike(first: str, second: str) -> float:
    """The likeness of two lines, from 0 to 1."""
    return difflib.SequenceMatcher(None, first, second, autojunk=False).ratio()


def change(mutation: MutationSpec) -> tuple[str, str]:
    """The lines that a mutation changes, before and after, each as one line."""
    text = Path(mutation.module_path).read_text(encoding="utf-8")
    mutated = mutate_code(text, get_operator(mutation.operator_name)(), mutation.occurrence)
    old, new = text.splitlines(), mutated.splitlines()
    changes = [c for c in difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes() if c[0] != "equal"]
    removed = " ".join(line for _, i, j, _, _ in changes for line in old[i:j])
    added = " ".join(line for _, _, _, i, j in changes for line in new[i:j])
    return " ".join(removed.split()), " ".join(added.split())


def matching(row: dict[str, str], places: list[tuple[str, MutationSpec]]) -> MutationSpec | None:
    """The mutation that a row describes, or the one by its operator that is most like it; None if none is like it."""

    def likeness(place: tuple[str, MutationSpec]) -> tuple[float, bool]:
        return alike(row["before"], place[0]), str(place[1].module_path) == row["module"]

    same = [place for place in places if place[1].operator_name == f"core/{row['operator']}"]
    best = max(map(likeness, same), default=(0.0, False))
    if best[0] < ALIKE:
        return None
    return max(
        (place[1] for place in same if likeness(place) == best),
        key=lambda found: (alike(row["after"], change(found)[1]), -abs(found.occurrence - int(row["occurrence"]))),
    )


def keep(session: Path) -> None:
    """Remove all mutants from a new session but those of the sample, and show which lines of it have changed."""
    with use_db(session) as db:
        places = []
        for mutation in (item.mutations[0] for item in db.work_items):
            line = linecache.getline(str(mutation.module_path), mutation.start_pos[0])
            places.append((" ".join(line.split()), mutation))
        jobs = []
        for row in read():
            if row["group"] == session.stem and row["outcome"] != "equivalent":
                found = matching(row, places)
                after = change(found)[1] if found else "not in the code"
                if after != row["after"]:
                    print(f"{row['module']}: {row['operator']}\n    was {row['after']}\n    now {after}")
                if found:
                    places = [place for place in places if place[1] is not found]
                    jobs.append(WorkItem.single(job_of(row), found))
        db.clear()
        db.add_work_items(jobs)
    print(f"{session.stem}: {len(jobs)} mutants to test")


def outcome(result: WorkResult) -> str:
    """What became of a mutant: "killed" by a failed test, or by the "timeout", or "survived"."""
    return "survived" if not result.is_killed else "timeout" if result.output == "timeout" else "killed"


def record(sessions: list[Path]) -> None:
    """Write the outcomes of finished sessions to the CSV, and print how many there are of each."""
    rows = read()
    for session in sessions:
        with use_db(session) as db:
            results = dict(db.results)
            mutations = {item.job_id: item.mutations[0] for item in db.work_items}
        for row in rows:
            if row["group"] == session.stem and row["outcome"] != "equivalent":
                job = job_of(row)
                row["outcome"] = outcome(results[job]) if job in results else "not run"
                if job in mutations:
                    found = mutations[job]
                    row["module"], row["line"] = str(found.module_path), str(found.start_pos[0])
                    row["occurrence"], (row["before"], row["after"]) = str(found.occurrence), change(found)
        print(session.stem, dict(Counter(row["outcome"] for row in rows if row["group"] == session.stem)))
    with SAMPLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    command, *paths = sys.argv[1:]
    {"keep": lambda: keep(Path(paths[0])), "record": lambda: record([Path(path) for path in paths])}[command]()
