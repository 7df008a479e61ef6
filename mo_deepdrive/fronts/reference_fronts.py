"""Best-known Pareto fronts, and the reference points from which hypervolumes are measured.

A front has the best returns found so far, and the actions that earn them. It belongs to a scenario that is the same in
every episode (``fixed_destination``, ``fixed_obstacle``) with the default physics. It is stored as sequences of
actions, and the returns are computed by replaying them. So a front is exact for every discount factor, and anyone can
reproduce it. ``docs/fronts.md`` says how fronts are found and improved.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any, get_args

import moocore
import numpy as np
import yaml

from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.config import ActionType, EnvConfig
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES, signs
from mo_deepdrive.world.params import chosen_objectives
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.resources.abc import Traversable

    from numpy.typing import NDArray

GAMMA = 0.99  # the discount factor, besides 1.0, for which fronts are searched
TIME = "time"  # an objective that fronts have besides the scenario's own
DATA = resources.files("mo_deepdrive") / "data"
# The settings that the stored fronts do not depend on: they hold all objectives, maximised, and are replayed.
_SELECTION = ("objectives", "cost_sign", "charge_remaining_time")


@dataclass(frozen=True)
class ReferencePoint:
    """The point from which hypervolumes are measured, from ``data/reference_points.yaml``.

    It is part of a published result: hypervolumes that were measured from different points cannot be compared. A
    registered objective or scenario gives its own.

    Attributes:
        objectives: names of the d objectives, in order.
        values: (d,) one number per objective, maximised. A policy adds to the hypervolume if it is better in all of
            them.
        version: of the table of reference points.
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
    table: dict[str, Any] = yaml.safe_load((DATA / "reference_points.yaml").read_text(encoding="utf-8"))
    return table


def select_objectives(scenario: str, action_type: str, objectives: Sequence[str] | None) -> tuple[str, ...]:
    """The names of the selected objectives, in order; all of the scenario's for None. Unknown names are ValueErrors."""
    for name, value, allowed in (("scenario", scenario, SCENARIOS), ("action_type", action_type, get_args(ActionType))):
        if value not in allowed:
            raise ValueError(f"{name} = {value!r} is unknown; {nearest(value, allowed)}")
    chosen = None if objectives is None else tuple(objectives)
    return chosen_objectives(EnvConfig(scenario=scenario, objectives=chosen))


@dataclass(frozen=True)
class KnownPolicy:
    """One policy of a best-known front."""

    actions: str  #: its actions, as :func:`mo_deepdrive.world.action_sequences.encode` writes them; idle afterwards
    undiscounted: tuple[float, ...]  #: its return in each objective of the scenario, maximised
    discounted: tuple[float, ...]  #: the same, discounted with GAMMA
    source: str  #: the method that found it


def reference_front(
    scenario: str = "one_waypoint",
    action_type: str = "discrete",
    gamma: float | None = None,
    objectives: Sequence[str] | None = None,
    charge_remaining_time: bool = False,
) -> NDArray[np.float64]:
    """The best-known front of a scenario that is the same in every episode (see :func:`front_config`).

    Args:
        scenario: "one_waypoint" or "static_obstacle".
        action_type: "discrete", "discrete-16" or "continuous".
        gamma: discount factor in [0, 1]; the fronts are searched for 0.99, for 1.0, and for 1.0 with the time. None for
            :func:`default_discount`.
        objectives: names, to select and order; "time" may be among them. None for all of the scenario's.
        charge_remaining_time: the environment's setting.

    Returns:
        (K, d) returns of the non-dominated policies, discounted with ``gamma`` and maximised.

    Raises:
        ValueError: for an unknown name, a gamma out of range, or a scenario without a best-known front.
    """
    from mo_deepdrive.world.action_sequences import discounted_sum  # late, as the worlds are compiled

    names = select_objectives(scenario, action_type, objectives)
    gamma = default_discount(names) if gamma is None else gamma
    if not 0.0 <= gamma <= 1.0:
        raise ValueError(f"gamma = {gamma!r} must lie in [0, 1]")
    rewards = _rewards(scenario, action_type, charge_remaining_time)
    known = (*SCENARIOS[scenario].objectives, TIME)
    if absent := [name for name in names if name not in known]:
        raise ValueError(f"the best-known front has no {absent[0]!r}; {nearest(absent[0], known)}")
    columns = [known.index(name) for name in names]
    returns = discounted_sum(rewards, gamma)[:, columns]
    kept: NDArray[np.float64] = returns[moocore.is_nondominated(returns, maximise=True)]
    return kept


def pareto_front(config: EnvConfig, gamma: float) -> list[NDArray[np.float64]]:
    """The best-known returns (d,) of an environment, in its objectives and signs; a ValueError if there are none."""
    if _file(config.scenario, config.action_type).is_file():
        required = front_config(config.scenario, config.action_type)
        differing = [
            f"{name} = {getattr(required, name)!r} (not {getattr(config, name)!r})"
            for name in EnvConfig.model_fields
            if name not in _SELECTION and getattr(config, name) != getattr(required, name)
        ]
        if differing:
            raise ValueError(f"the best-known front requires {', '.join(differing)}")
    names = chosen_objectives(config)
    returns = reference_front(config.scenario, config.action_type, gamma, names, config.charge_remaining_time)
    if config.cost_sign == "paper":
        # Adding zero turns a cost of -0.0 into 0.0.
        returns = returns * signs(names) + 0.0
    return list(returns)


def front_config(scenario: str, action_type: str) -> EnvConfig:
    """The configuration of a best-known front: the same scenario in every episode, everything else at its default."""
    return EnvConfig(
        scenario=scenario,
        action_type=action_type,  # type: ignore[arg-type]
        fixed_destination=True,
        fixed_obstacle=SCENARIOS[scenario].obstacles > 0,
    )


def _file(scenario: str, action_type: str) -> Traversable:
    return DATA / f"front_{scenario}_{action_type}.json"


def shipped(scenario: str, action_type: str) -> tuple[KnownPolicy, ...]:
    """The policies of a best-known front that comes with the package; a ValueError if there is no such front."""
    file = _file(scenario, action_type)
    if not file.is_file():
        files = [entry.name for entry in DATA.iterdir() if entry.name.startswith("front_")]
        known = sorted(name.removeprefix("front_").removesuffix(".json") for name in files)
        raise ValueError(
            f"no best-known front is shipped for scenario = {scenario!r} with action_type = {action_type!r}; "
            f"known: {', '.join(known)}"
        )
    return read(file.read_text(encoding="utf-8"))


def read(text: str) -> tuple[KnownPolicy, ...]:
    """Parse the text of a front file, as :func:`write` returns it."""
    return tuple(
        KnownPolicy(row["actions"], tuple(row["undiscounted"]), tuple(row["discounted"]), row["source"])
        for row in json.loads(text)["policies"]
    )


def write(scenario: str, action_type: str, policies: Sequence[KnownPolicy]) -> str:
    """The text of a front file: JSON, one policy per line."""
    objectives = SCENARIOS[scenario].objectives
    head = {"scenario": scenario, "action_type": action_type, "objectives": objectives, "gamma": GAMMA}
    columns = ("undiscounted", "discounted", "source", "actions")
    rows = [{name: getattr(policy, name) for name in columns} for policy in policies]
    lines = ",\n".join(json.dumps(row) for row in rows)
    return json.dumps(head)[:-1] + ', "policies": [\n' + lines + "\n]}\n"


@functools.cache
def _rewards(scenario: str, action_type: str, charge_remaining_time: bool) -> NDArray[np.float32]:
    from mo_deepdrive.world.action_sequences import decode, replay

    policies = shipped(scenario, action_type)
    objectives = (*SCENARIOS[scenario].objectives, TIME)
    timed = {"objectives": objectives, "charge_remaining_time": charge_remaining_time}
    config = front_config(scenario, action_type).model_copy(update=timed)
    return replay(config, [decode(policy.actions, action_type) for policy in policies])
