"""Which runs differ in their seed alone, and which have comparable scores: the rules of curves, tables and sweeps.

Two runs belong together if their resolved experiments are the same apart from the seed, from where they ran (device,
threads) and from what they logged; device, threads and logging change neither what is learnt, but for last bits, nor
how it is measured.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
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


def task_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """What runs must share for their scores to be comparable: environment, utility, and how scores are calculated.

    Final scores are comparable if they are also of the same split; evaluations during training are all of one.

    Args:
        config: a resolved experiment, as in a run's config.yaml.
    """
    evaluation = config.get("evaluation", {})
    return {
        "environment": config["environment"],
        "utility": config.get("utility"),
        "evaluation": {name: evaluation.get(name) for name in ("gamma", "reference_point")},
    }


def distinct_labels(sections: Sequence[Mapping[str, Any] | None], label_of: Callable[[Any], str]) -> list[str]:
    """The labels of some sections of configs; sections that share one also get the settings that differ between them.

    Args:
        sections: such as the utilities of some experiments; None for none.
        label_of: gives the label of a section.
    """
    labels = [label_of(section) for section in sections]
    flat = [flatten(section or {}) for section in sections]
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
