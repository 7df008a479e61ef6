"""Reference points, from which hypervolumes are measured.

A reference point is part of a published result: hypervolumes that were measured from different points cannot be
compared. The points are in ``data/reference_points.yaml``. A registered objective or scenario gives its own.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import yaml

from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.config import ActionType, EnvConfig
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.params import chosen_objectives
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

TABLE = resources.files("mo_deepdrive") / "data" / "reference_points.yaml"


@dataclass(frozen=True)
class ReferencePoint:
    """The point from which hypervolumes are measured.

    Attributes:
        objectives: names of the d objectives, in order.
        values: (d,) one number per objective, maximised. A policy adds to the hypervolume if it is better in all of
            them.
        version: version of the table of reference points. Hypervolumes of different versions cannot be compared.
        reason: the rule behind each value.
    """

    objectives: tuple[str, ...]
    values: NDArray[np.float64]
    version: int
    reason: str


def default_discount(objectives: Sequence[str]) -> float:
    """The discount factor of fronts, unless another one is asked for: 1 where time is an objective, else 0.99.

    Without a price of its own, time counts by the discount alone. With one, a discount would count it twice, and put
    policies on the front that wait so that costs come later.
    """
    return 1.0 if "time" in objectives else 0.99


def reference_point(
    scenario: str = "one_waypoint",
    action_type: str = "discrete",
    gamma: float | None = None,
    objectives: Sequence[str] | None = None,
) -> ReferencePoint:
    """The agreed reference point for hypervolumes.

    Args:
        scenario: "one_waypoint", "static_obstacle", "intersection", "left_turn" or a registered one; it holds for each
            vehicle.
        action_type: "discrete", "discrete-16" or "continuous".
        gamma: discount factor of the returns: 0.99 or 1.0; any for a registered scenario; None for
            :func:`default_discount`.
        objectives: names, to select and order; None for all of the scenario's.

    Raises:
        ValueError: for an unknown scenario, action type or objective, a gamma without a reference point, or an
            objective that is registered without a reference value.
    """
    names = select_objectives(scenario, action_type, objectives)
    gamma = default_discount(names) if gamma is None else gamma
    table = _table()
    values, reasons = dict(SCENARIOS[scenario].reference), dict.fromkeys(names, "as registered")
    known = [
        point for point in table["points"] if scenario in point["scenarios"] and action_type in point["action_types"]
    ]
    if known:
        agreed = next((point for point in known if point["gamma"] == gamma), None)
        if agreed is None:
            gammas = ", ".join(str(point["gamma"]) for point in known)
            raise ValueError(f"gamma = {gamma!r} has no reference point; known: {gammas}")
        values |= agreed["values"]
        reasons |= table["reasons"]
    for name in names:
        registered = OBJECTIVES[INDEX[name]].reference
        if registered is not None:
            values.setdefault(name, registered)
        if name not in values:
            raise ValueError(f"objective {name!r} has no reference value in {scenario!r}; register it with one")
    return ReferencePoint(
        objectives=names,
        values=np.array([values[name] for name in names], dtype=np.float64),
        version=table["version"],
        reason="; ".join(f"{name}: {reasons[name]}" for name in names),
    )


@functools.cache
def _table() -> dict[str, Any]:
    table: dict[str, Any] = yaml.safe_load(TABLE.read_text(encoding="utf-8"))
    return table


def select_objectives(scenario: str, action_type: str, objectives: Sequence[str] | None) -> tuple[str, ...]:
    """The names of the selected objectives, in order; all of the scenario's for None.

    Raises:
        ValueError: for an unknown scenario, action type or objective.
    """
    for name, value, allowed in (
        ("scenario", scenario, SCENARIOS),
        ("action_type", action_type, get_args(ActionType)),
    ):
        if value not in allowed:
            raise ValueError(f"{name} = {value!r} is unknown; {nearest(value, allowed)}")
    chosen = None if objectives is None else tuple(objectives)
    return chosen_objectives(EnvConfig(scenario=scenario, objectives=chosen))
