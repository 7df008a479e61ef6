"""Which runs differ in their seed alone, and which have comparable scores: the rules of curves, tables and sweeps.

Two runs belong together if their resolved experiments are the same apart from the seed, from where they ran (device,
threads, beside which seeds) and from what they logged; these change neither what is learnt, but for last bits, nor how
it is measured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from algorithms.reporting.run_records import ExperimentRecord, Recorded, RunRecord

SEED = "training.seed"
# Keys of a config, and one section, that change neither what is learnt nor how it is measured.
INCIDENTAL = ("training.device", "training.seeds", "training.threads", "logging")


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted keys: ``{"training": {"seed": 0}}`` as ``{"training.seed": 0}``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def identifying_settings(experiment: ExperimentRecord) -> dict[str, Any]:
    """The settings that runs must share to differ in their seed alone, by dotted keys in alphabetical order."""
    flat = flatten(experiment.model_dump())
    left_out = {SEED, *INCIDENTAL}
    return {key: flat[key] for key in sorted(flat) if key not in left_out and key.partition(".")[0] not in left_out}


def distinct_labels(labels: Sequence[str], sections: Sequence[Recorded | Mapping[str, Any] | None]) -> list[str]:
    """The labels of some sections of configs; sections that share one also get the settings that differ between them.

    Args:
        labels: one per section.
        sections: such as the utilities of some experiments; None for none.
    """
    flat = [
        flatten({} if section is None else section if isinstance(section, Mapping) else section.model_dump())
        for section in sections
    ]
    distinct = []
    for label, settings in zip(labels, flat, strict=True):
        namesakes = [other for name, other in zip(labels, flat, strict=True) if name == label]
        differing = [
            f"{key.removeprefix('arguments.')}={value}"
            for key, value in settings.items()
            if any(key not in other or other[key] != value for other in namesakes)
        ]
        distinct.append(" ".join(filter(None, (label, *differing))))
    return distinct


def group_by_experiment(runs: Sequence[RunRecord]) -> list[list[RunRecord]]:
    """Group runs that differ in their seed alone, groups and runs in the order given.

    Raises:
        ValueError: if two runs of a group have the same seed.
    """
    groups: dict[str, dict[int, RunRecord]] = {}
    for run in runs:
        key = json.dumps(identifying_settings(run.experiment), sort_keys=True, default=str)
        seed = run.experiment.training.seed
        other = groups.setdefault(key, {}).setdefault(seed, run)
        if other is not run:
            raise ValueError(
                f"runs {str(other.path)!r} and {str(run.path)!r} are the same experiment with the same seed, {seed}; "
                "give one of them"
            )
    return [list(members.values()) for members in groups.values()]
