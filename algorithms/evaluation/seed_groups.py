"""Which runs differ in their seed alone: the rule by which curves, tables and sweeps group runs.

Two runs belong together if their resolved experiments are the same apart from the seed, from where they ran (device,
threads) and from what they logged; device, threads and logging change neither what is learnt nor how it is measured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

SEED = "training.seed"
# Keys of a config, and one section, that change neither what is learnt nor how it is measured.
INCIDENTAL = ("training.device", "training.threads", "logging")


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted keys: ``{"training": {"seed": 0}}`` as ``{"training.seed": 0}``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def identifying_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that runs must share to differ in their seed alone, by dotted keys in alphabetical order.

    Args:
        config: a resolved experiment, as in a run's config.yaml.
    """
    flat = flatten(config)
    left_out = {SEED, *INCIDENTAL}
    return {key: flat[key] for key in sorted(flat) if key not in left_out and key.partition(".")[0] not in left_out}


def group_by_experiment(directories: Sequence[Path], configs: Sequence[Mapping[str, Any]]) -> list[list[int]]:
    """Group runs that differ in their seed alone.

    Args:
        directories: of the runs, for messages.
        configs: their resolved experiments.

    Returns:
        The indices of the runs of every group, groups and runs in the order given.

    Raises:
        ValueError: if two runs of a group have the same seed.
    """
    groups: dict[str, dict[int, int]] = {}
    for i, config in enumerate(configs):
        key = json.dumps(identifying_settings(config), sort_keys=True)
        seed = config["training"]["seed"]
        other = groups.setdefault(key, {}).setdefault(seed, i)
        if other != i:
            raise ValueError(
                f"runs {str(directories[other])!r} and {str(directories[i])!r} are the same experiment with the same "
                f"seed, {seed}; give one of them"
            )
    return [list(members.values()) for members in groups.values()]
