"""Policies that need no skill, by which the floors of the suite are set: a task that one of them solves tests nothing.

They see nothing of what a task is about: they stand still, act at random, hold one action, or go after a fixed time.
The last ones know the road of the left turn or the roundabout, and are blind to traffic.
"""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving.intersection_rules import as_in_left_turn
from algorithms.driving.left_turn_rules import GapDriver
from algorithms.driving.roundabout_rules import RoundaboutDriver
from mo_deepdrive.world.action_sequences import idle
from mo_deepdrive.world.actions import CONTINUOUS, action_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from algorithms.driving.left_turn_rules import GapRule
    from algorithms.driving.roundabout_rules import RoundaboutRule
    from mo_deepdrive.world.config import EnvConfig

    Goes = bool | NDArray[np.bool_]
    Function = Callable[..., NDArray[Any]]

STEERS, ACCELERATIONS = (-1.0, -0.3, 0.0, 0.3, 1.0), (0.25, 0.5, 1.0)  # of continuous actions that are held


class Timed:
    """Goes after a fixed time ``wait`` (s), one or (N,), whatever comes; a ``decision`` takes some time (s), too.

    ``drives`` gives actions for observations (N, o) and whether to go (N,), else it waits.
    """

    def __init__(self, wait: Any, decision: float, drives: Callable[[NDArray[Any], Goes], NDArray[Any]]):
        self._decisions, self._past, self._drives = np.rint(wait / decision), 0, drives

    def __call__(self, observations: NDArray[Any], accrued: NDArray[Any], _discounts: NDArray[Any]) -> NDArray[Any]:
        """Actions for observations (N, o)."""
        self._past = self._past + 1 if accrued.any() else 0
        return self._drives(observations, self._past >= self._decisions)


def blind_turner(rule: GapRule, action_type: str, *, meets: bool) -> Callable[[NDArray[Any], Goes], NDArray[Any]]:
    """Turns left along the lanes and sees nobody on them: alone, or as vehicle 0 that ``meets`` vehicle 1."""
    driver = GapDriver(rule, action_type)

    def drives(observations: NDArray[Any], goes: Goes) -> NDArray[Any]:
        seen = np.asarray(observations, dtype=np.float64)
        return driver.actions(as_in_left_turn(seen) if meets else seen, np.broadcast_to(goes, len(seen)))

    return drives


def blind_follower(rule: RoundaboutRule, action_type: str) -> Callable[[NDArray[Any], Goes], NDArray[Any]]:
    """Follows its lane, and sees nobody on it."""
    driver, waiting = RoundaboutDriver(rule, action_type, blind=True), idle(action_type)

    def drives(observations: NDArray[Any], goes: Goes) -> NDArray[Any]:
        actions = driver(observations)
        actions[~np.broadcast_to(goes, len(actions))] = waiting
        return actions

    return drives


def unskilled_policies(config: EnvConfig) -> dict[str, Function]:
    """The policies of an environment by name, as functions for :func:`mo_deepdrive.evaluation.evaluate`."""
    scenario, action_type = config.scenario_data, config.action_type
    axes = (scenario.vehicles,) if scenario.vehicles > 1 else ()
    found: dict[str, Function] = {
        "stands still": _holding(idle(action_type), axes),
        "acts at random": partial(_random, np.random.default_rng(0), action_type, axes),
    }
    if action_type == CONTINUOUS:
        for steer, acceleration in product(STEERS, ACCELERATIONS):
            action = np.array([steer, acceleration, -1.0], dtype=np.float32)
            found[f"holds steer {steer:g}, acceleration {acceleration:g}"] = _holding(action, axes)
    else:
        names = action_names(action_type)
        found |= {f"holds '{name}'": _holding(np.array(i), axes) for i, name in enumerate(names) if i}
    return found


def _holding(action: NDArray[Any], axes: tuple[int, ...]) -> Function:
    return lambda observations, *_: np.broadcast_to(action, (len(observations), *axes, *action.shape)).copy()


def _random(
    rng: np.random.Generator, action_type: str, axes: tuple[int, ...], observations: NDArray[Any], *_: Any
) -> NDArray[Any]:
    size = (len(observations), *axes)
    if action_type == CONTINUOUS:
        return rng.uniform(-1.0, 1.0, (*size, 3)).astype(np.float32)
    return rng.integers(len(action_names(action_type)), size=size)
