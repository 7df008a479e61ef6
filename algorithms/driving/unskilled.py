"""Drivers that know the road of the left turn or the roundabout, go after a fixed time, and are blind to traffic.

Floors of the suite are set by them: a task that one of them solves does not test how others are met.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving.intersection_rules import as_in_left_turn
from algorithms.driving.left_turn_rules import GapDriver
from algorithms.driving.roundabout_rules import RoundaboutDriver
from mo_deepdrive.world.action_sequences import idle

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from algorithms.driving.left_turn_rules import GapRule
    from algorithms.driving.roundabout_rules import RoundaboutRule

    Goes = bool | NDArray[np.bool_]


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
