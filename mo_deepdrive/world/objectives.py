"""The objectives: unit, sign, scale and bounds of each, and how it is measured.

An objective is one row of OBJECTIVES. Its *magnitude* (a g-force of 0.2, a collision of 1) is measured after every
decision, by the kernel or by a function of the row. The environments return rewards to be maximised: magnitude times
sign. ``cost_sign="paper"`` returns the magnitudes themselves.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.support.names import check_name
from mo_deepdrive.support.plain_values import is_finite, with_plain_fields

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

MEASURE_ARGUMENTS = ("vehicles", "v", "params")


@dataclass(frozen=True)
class Objective:
    """One objective of the benchmark.

    Attributes:
        name: the name in configurations and logs.
        unit: SI unit of the magnitude per decision; "1" for none.
        sign: +1 if more is better, -1 for a cost.
        scale: nominal magnitude of the *return* of an episode, by which learners divide.
        description: what the magnitude measures.
        bound: largest magnitude of one decision, which bounds the reward space: a number or a function of the
            :class:`mo_deepdrive.world.config.EnvConfig`. In a row of the package it may be a key of
            :func:`mo_deepdrive.world.limits.limits`.
        signed: whether the magnitude may be negative, down to minus the bound.
        measure: ``measure(vehicles, v, params)`` returns the magnitude of the decision that vehicle ``v`` has just
            made, from the world after it: ``vehicles`` (vehicles,) of ``mo_deepdrive.simulation.state.VEHICLE`` and
            ``params`` of ``PARAMS``, both to be read only. A plain function, which Numba compiles on its first use, or
            one with ``numba.njit``. It is not called for vehicles that had ended before; their magnitude is zero.
            Every scenario can have such an objective. None if the kernel measures it, where the scenario lists it.
            In a row of the package it may be the path ``package.module:name`` of a compiled function of (worlds, i, v,
            params), which is imported when it is needed.
        needs_others: whether only scenarios with other vehicles or cars can have it.
        needs_roads: whether only scenarios on roads of segments can have it.
        reference: coordinate of the reference point for hypervolumes, maximised, for every discount factor; None where
            ``data/reference_points.yaml`` has it, or for none.
    """

    name: str
    unit: str
    sign: int
    scale: float
    description: str
    bound: float | str | Callable[[Any], float]
    signed: bool = False
    measure: Callable[[Any, int, Any], float] | str | None = None
    needs_others: bool = False
    needs_roads: bool = False
    reference: float | None = None


OBJECTIVES: list[Objective] = [
    Objective("distance", "m", +1, 10.0, "route distance gained in the decision", bound="distance", signed=True),
    Objective("destination", "1", +1, 1.0, "1 on the decision that arrives", bound=1.0),
    Objective("g_force", "g", -1, 5.0, "acceleration at the end of the decision", bound="g"),
    Objective("collision", "1", -1, 1.0, "1 on the decision that collides", bound=1.0),
    Objective("jerk", "m/s^3", -1, 500.0, "jerk at the end of the decision", bound="m/s^3"),
    Objective("lane_violation", "m", -1, 10.0, "metres outside the lane at the end of the decision", "lane_violation"),
    Objective(
        "time",
        "s",
        -1,
        30.0,
        "duration of the decision; under charge_remaining_time also what an early end leaves of the time limit",
        bound="time",
        measure="mo_deepdrive.simulation.measures:duration",
        reference=-60.0,
    ),
    Objective(
        "near_miss",
        "1",
        -1,
        5.0,
        "1 on a decision after which the time to collision is below 1.5 s (0.95 s in Roundabout)",
        bound=1.0,
        measure="mo_deepdrive.simulation.measures:near_miss",
        needs_others=True,
        reference=-15.0,
    ),
    Objective(
        "right_of_way",
        "m/s^2 s",
        -1,
        5.0,
        "deceleration that entering forces on who has right of way, times the duration of the decision",
        bound="right_of_way",
        measure="mo_deepdrive.simulation.measures:right_of_way",
        needs_others=True,
        needs_roads=True,
        reference=-10.0,
    ),
    Objective(
        "energy",
        "J/kg",
        -1,
        50.0,
        "positive work of the traction force per mass in the decision",
        bound="energy",
        measure="mo_deepdrive.simulation.measures:energy",
        reference=-200.0,
    ),
]
INDEX: dict[str, int] = {objective.name: index for index, objective in enumerate(OBJECTIVES)}


def signs(names: tuple[str, ...]) -> NDArray[np.float64]:
    """Sign of each named objective, shape (d,): reward = sign * magnitude under ``cost_sign="maximise"``."""
    return np.array([OBJECTIVES[INDEX[name]].sign for name in names], dtype=np.float64)


def scales(names: tuple[str, ...]) -> NDArray[np.float64]:
    """Nominal scale of the return of each named objective, shape (d,)."""
    return np.array([OBJECTIVES[INDEX[name]].scale for name in names], dtype=np.float64)


def register_objective(objective: Objective) -> None:
    """Add an objective, which every scenario can then have: ``objectives=["distance", "energy"]``.

    Call it in the module that defines the objective: ``make("module:id")``, and ``environment.id: "module:id"`` in
    YAML, import the module first, in worker processes too. Registering the same objective again changes nothing.

    Args:
        objective: the row; it needs a ``measure``.

    Raises:
        ValueError: for an invalid field, or another objective of the same name.
    """
    objective = with_plain_fields(objective)
    check_name(objective.name, "objective")
    for field, fine, allowed in (
        ("sign", is_finite(objective.sign) and objective.sign in (-1, 1), "+1 (more is better) or -1 (a cost)"),
        ("scale", _is_positive(objective.scale), "a positive number"),
        ("bound", callable(objective.bound) or _is_positive(objective.bound), "a positive number or a function"),
        ("signed", isinstance(objective.signed, bool), "True or False"),
        ("needs_others", isinstance(objective.needs_others, bool), "True or False"),
        ("needs_roads", isinstance(objective.needs_roads, bool), "True or False"),
        ("measure", _is_measure(objective.measure), "a function of (vehicles, v, params)"),
        ("reference", objective.reference is None or is_finite(objective.reference), "a finite number or None"),
    ):
        if not fine:
            raise ValueError(f"objective {objective.name!r}: {field} = {getattr(objective, field)!r} must be {allowed}")
    if objective.name not in INDEX:
        INDEX[objective.name] = len(OBJECTIVES)
        OBJECTIVES.append(objective)
    elif _contents(objective) != _contents(OBJECTIVES[INDEX[objective.name]]):
        raise ValueError(f"objective {objective.name!r} is registered already, with other fields; choose another name")


def _is_positive(value: Any) -> bool:
    return is_finite(value) and bool(value > 0)


def _is_measure(value: object) -> bool:
    """Whether ``value`` is a function of three arguments, compiled or not."""
    function = getattr(value, "py_func", value)
    return inspect.isfunction(function) and len(inspect.signature(function).parameters) == len(MEASURE_ARGUMENTS)


def _contents(objective: Objective) -> list[Any]:
    return [_content(getattr(objective, field.name)) for field in fields(objective)]


def _content(value: Any) -> Any:
    """What is compared of a value: of a function its code and what it holds, as a module imported twice makes two."""
    value = getattr(value, "py_func", value)
    if inspect.isfunction(value):
        cells = (cell.cell_contents for cell in value.__closure__ or ())
        return [value.__code__, *map(_content, (*(value.__defaults__ or ()), *cells))]
    return value.tolist() if isinstance(value, np.ndarray) else value
