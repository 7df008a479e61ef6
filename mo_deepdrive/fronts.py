"""Reference points, from which hypervolumes are measured, and best-known fronts, the best returns found so far.

A front belongs to a scenario that is the same in every episode (``fixed_destination``, ``fixed_obstacle``) with the
default physics. It is shipped as sequences of actions and their returns are computed by driving them, so it is right
for every discount factor and anybody can drive it. ``scripts/front.py`` finds and improves fronts; ``docs/fronts.md``
says how.
"""

from __future__ import annotations

import functools
import json
import re
import string
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, get_args

import moocore
import numpy as np
import yaml
from numpy.typing import NDArray

from mo_deepdrive.actions import CONTINUOUS, action_table
from mo_deepdrive.batch import WorldBatch
from mo_deepdrive.config import ActionType, EnvConfig, ScenarioName, nearest
from mo_deepdrive.objectives import signs
from mo_deepdrive.scenarios import DRAWS, SCENARIOS
from mo_deepdrive.simulation.params import chosen_objectives

GAMMA = 0.99  # beside 1.0, the discount factor for which fronts are made
CONTINUOUS_UNIT = 1.0 / 1024.0  # of a shipped continuous action; exact in float32
DATA = resources.files("mo_deepdrive") / "data"
_NO_BRAKE = -1024  # units
# What the shipped fronts do not depend on: they are made for all objectives, maximised.
_FREE = ("objectives", "cost_sign")
_RUN = {
    True: re.compile(r"(-?\d+),(-?\d+)(?:,(-?\d+))?(?:\*(\d+))?(?: |$)"),
    False: re.compile(r"([a-z])(\d+)?"),
}


@dataclass(frozen=True)
class ReferencePoint:
    """What hypervolumes are measured from.

    Attributes:
        objectives: the names of the d objectives, in order.
        values: (d,) one number per objective, maximised: a policy counts by how far it lies above all of them.
        version: of the table of reference points; hypervolumes of different versions cannot be compared.
        reason: the rule behind each value.
    """

    objectives: tuple[str, ...]
    values: NDArray[np.float64]
    version: int
    reason: str


@dataclass(frozen=True)
class KnownPolicy:
    """One policy of a best-known front.

    Attributes:
        actions: its decisions, as :func:`encode` writes them; after the last of them it idles.
        undiscounted: its return per objective of the scenario, maximised.
        discounted: the same, discounted with GAMMA.
        source: what found it.
    """

    actions: str
    undiscounted: tuple[float, ...]
    discounted: tuple[float, ...]
    source: str


# -------------------------------------------------------------------------------------------------- reference points


def reference_point(
    scenario: str = "one_waypoint",
    action_type: str = "discrete",
    gamma: float = 0.99,
    objectives: Sequence[str] | None = None,
) -> ReferencePoint:
    """The agreed reference point for hypervolumes.

    Args:
        scenario: "one_waypoint", "static_obstacle" or "intersection" (there for each vehicle).
        action_type: "discrete", "discrete-16" or "continuous".
        gamma: with which the returns are discounted: 0.99 or 1.0.
        objectives: names, to select and order; None for all of the scenario's.

    Raises:
        ValueError: for an unknown scenario, action type or objective, or a gamma without a point.
    """
    names = _objectives(scenario, action_type, objectives)
    table = _points()
    known = [
        point for point in table["points"] if scenario in point["scenarios"] and action_type in point["action_types"]
    ]
    for point in known:
        if point["gamma"] == gamma:
            return ReferencePoint(
                objectives=names,
                values=np.array([point["values"][name] for name in names], dtype=np.float64),
                version=table["version"],
                reason="; ".join(f"{name}: {table['reasons'][name]}" for name in names),
            )
    gammas = ", ".join(str(point["gamma"]) for point in known)
    raise ValueError(f"gamma = {gamma!r} has no reference point; known: {gammas}")


@functools.cache
def _points() -> dict[str, Any]:
    table: dict[str, Any] = yaml.safe_load((DATA / "reference_points.yaml").read_text(encoding="utf-8"))
    return table


def _objectives(scenario: str, action_type: str, objectives: Sequence[str] | None) -> tuple[str, ...]:
    """The chosen objectives of a scenario.

    Raises:
        ValueError: for an unknown scenario, action type or objective.
    """
    for name, value, allowed in (
        ("scenario", scenario, get_args(ScenarioName)),
        ("action_type", action_type, get_args(ActionType)),
    ):
        if value not in allowed:
            raise ValueError(f"{name} = {value!r} is unknown; {nearest(value, allowed)}")
    chosen = None if objectives is None else tuple(objectives)
    return chosen_objectives(EnvConfig(scenario=scenario, objectives=chosen))  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------------------ best-known fronts


def reference_front(
    scenario: str = "one_waypoint",
    action_type: str = "discrete",
    gamma: float = 0.99,
    objectives: Sequence[str] | None = None,
) -> NDArray[np.float64]:
    """The best-known front of a scenario that is the same in every episode (see :func:`front_config`).

    Args:
        scenario: "one_waypoint" or "static_obstacle".
        action_type: "discrete", "discrete-16" or "continuous".
        gamma: in [0, 1]; the fronts are made for 0.99 and 1.0.
        objectives: names, to select and order; None for all of the scenario's.

    Returns:
        (K, d) returns of the shipped policies, discounted with ``gamma`` and maximised; none dominates another.

    Raises:
        ValueError: for an unknown name, a gamma out of range, or where no front is shipped.
    """
    names = _objectives(scenario, action_type, objectives)
    if not 0.0 <= gamma <= 1.0:
        raise ValueError(f"gamma = {gamma!r} must lie in [0, 1]")
    rewards = _shipped_rewards(scenario, action_type)
    columns = [SCENARIOS[scenario].objectives.index(name) for name in names]
    returns = discounted_sum(rewards, gamma)[:, columns]
    kept: NDArray[np.float64] = returns[moocore.is_nondominated(returns, maximise=True)]
    return kept


def pareto_front(config: EnvConfig, gamma: float) -> list[NDArray[np.float64]]:
    """The best-known front of an environment, in its own objectives and signs.

    Args:
        config: of the environment.
        gamma: in [0, 1].

    Returns:
        The K returns (d,) of policies none of which dominates another.

    Raises:
        ValueError: where no front is shipped for an environment of this configuration.
    """
    if _file(config.scenario, config.action_type).is_file():
        required = front_config(config.scenario, config.action_type)
        differing = [
            f"{name} = {getattr(required, name)!r} (not {getattr(config, name)!r})"
            for name in EnvConfig.model_fields
            if name not in _FREE and getattr(config, name) != getattr(required, name)
        ]
        if differing:
            raise ValueError(f"the best-known front requires {', '.join(differing)}")
    names = chosen_objectives(config)
    returns = reference_front(config.scenario, config.action_type, gamma, names)
    if config.cost_sign == "paper":
        # Adding zero turns a cost of -0.0 into 0.0.
        returns = returns * signs(names) + 0.0
    return list(returns)


def front_config(scenario: str, action_type: str) -> EnvConfig:
    """The configuration to which a best-known front belongs: the same scenario in every episode, all else default."""
    return EnvConfig(
        scenario=scenario,  # type: ignore[arg-type]
        action_type=action_type,  # type: ignore[arg-type]
        fixed_destination=True,
        fixed_obstacle=SCENARIOS[scenario].obstacle,
    )


def _file(scenario: str, action_type: str) -> Any:
    return DATA / f"front_{scenario}_{action_type}.json"


def shipped(scenario: str, action_type: str) -> tuple[KnownPolicy, ...]:
    """The policies of a best-known front, as they are shipped.

    Raises:
        ValueError: where none is shipped.
    """
    file = _file(scenario, action_type)
    if not file.is_file():
        found = [each.name for each in DATA.iterdir() if each.name.startswith("front_")]
        known = sorted(name.removeprefix("front_").removesuffix(".json") for name in found)
        raise ValueError(
            f"no best-known front is shipped for scenario = {scenario!r} with action_type = {action_type!r}; "
            f"known: {', '.join(known)}"
        )
    return read(file.read_text(encoding="utf-8"))


def read(text: str) -> tuple[KnownPolicy, ...]:
    """The policies of a file that :func:`write` made."""
    return tuple(
        KnownPolicy(row["actions"], tuple(row["undiscounted"]), tuple(row["discounted"]), row["source"])
        for row in json.loads(text)["policies"]
    )


def write(scenario: str, action_type: str, policies: Sequence[KnownPolicy]) -> str:
    """The file of a front: JSON, one policy per line."""
    head = {
        "scenario": scenario,
        "action_type": action_type,
        "objectives": SCENARIOS[scenario].objectives,
        "gamma": GAMMA,
    }
    rows = [
        {
            "undiscounted": policy.undiscounted,
            "discounted": policy.discounted,
            "source": policy.source,
            "actions": policy.actions,
        }
        for policy in policies
    ]
    lines = ",\n".join(json.dumps(row) for row in rows)
    return json.dumps(head)[:-1] + ', "policies": [\n' + lines + "\n]}\n"


@functools.cache
def _shipped_rewards(scenario: str, action_type: str) -> NDArray[np.float32]:
    policies = shipped(scenario, action_type)
    return replay(scenario, action_type, [decode(policy.actions, action_type) for policy in policies])


# ---------------------------------------------------------------------------------------------- sequences of actions


def encode(actions: NDArray[Any]) -> str:
    """Write a sequence of actions.

    Args:
        actions: (n,) actions of a discrete set, or (n, 3) continuous actions in whole multiples of CONTINUOUS_UNIT.

    Returns:
        Runs of equal actions. Discrete: a letter (a for 0) and how often, if more than once: "d12a". Continuous:
        steer, acceleration and, where it is used, brake, in units of CONTINUOUS_UNIT, and how often: "0,512*12 0,0,3".
    """
    rows = np.rint(actions / CONTINUOUS_UNIT).astype(np.int64) if actions.ndim == 2 else actions[:, None]
    starts = np.flatnonzero(np.r_[len(rows) > 0, (rows[1:] != rows[:-1]).any(axis=1)])
    counts = np.diff(np.r_[starts, len(rows)])
    runs = list(zip(rows[starts].tolist(), counts.tolist(), strict=True))
    if actions.ndim == 1:
        return "".join(string.ascii_lowercase[action] + (str(n) if n > 1 else "") for (action,), n in runs)
    written = (action if action[2] != _NO_BRAKE else action[:2] for action, _ in runs)
    return " ".join(
        ",".join(map(str, action)) + (f"*{n}" if n > 1 else "") for action, (_, n) in zip(written, runs, strict=True)
    )


def decode(text: str, action_type: str) -> NDArray[Any]:
    """Read a sequence of actions that :func:`encode` wrote: (n,) int64, or (n, 3) float64 of a continuous set.

    Raises:
        ValueError: if the text is no such sequence.
    """
    continuous = action_type == CONTINUOUS
    matches = list(_RUN[continuous].finditer(text))
    if "".join(match[0] for match in matches) != text:
        raise ValueError(f"{text!r} is no sequence of {action_type} actions")
    counts = [int(match.groups()[-1] or 1) for match in matches]
    if continuous:
        runs = [[match[1], match[2], match[3] or _NO_BRAKE] for match in matches]
        numbers = np.array(runs, dtype=np.float64).reshape(-1, 3)
        return np.repeat(numbers * CONTINUOUS_UNIT, counts, axis=0)
    letters = np.array([string.ascii_lowercase.index(match[1]) for match in matches], dtype=np.int64)
    if len(letters) and letters.max() >= len(action_table(action_type)):
        raise ValueError(f"{text!r} is no sequence of {action_type} actions")
    return np.repeat(letters, counts)


def idle(action_type: str) -> NDArray[Any]:
    """The action that does nothing: no steering, no throttle, no brake."""
    return np.array([0.0, 0.0, -1.0]) if action_type == CONTINUOUS else np.array(0, dtype=np.int64)


def replay(scenario: str, action_type: str, sequences: Iterable[NDArray[Any]]) -> NDArray[np.float32]:
    """Drive sequences of actions, each in a world of its own; a sequence that has ended idles.

    Returns:
        (K, decisions, d) rewards of all objectives, maximised; zero once an episode has ended.
    """
    config = front_config(scenario, action_type)
    listed = list(sequences)
    batch = WorldBatch(config, len(listed))
    actions = np.empty((config.max_decisions, len(listed), 1, *idle(action_type).shape), idle(action_type).dtype)
    actions[:] = idle(action_type)
    for row, sequence in enumerate(listed):
        actions[: len(sequence), row, 0] = sequence[: config.max_decisions]
    batch.place(np.arange(len(listed)), lambda rows: np.zeros((len(rows), DRAWS)))
    rewards: list[NDArray[np.float32]] = []
    while not batch.over().all():
        batch.step(actions[len(rewards)])
        rewards.append(batch.rewards[:, 0].copy())
    return np.stack(rewards, axis=1)


def discounted_sum(rewards: NDArray[Any], gamma: float) -> NDArray[np.float64]:
    """Returns (K, d) of rewards (K, decisions, d), in double precision."""
    weights = gamma ** np.arange(rewards.shape[1], dtype=np.float64)
    return np.asarray(np.einsum("ktd,t->kd", rewards.astype(np.float64), weights))
