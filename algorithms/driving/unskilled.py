"""Policies that need no skill, by which the floors of the suite are set: a task that one of them solves tests nothing.

They see nothing of what a task is about: they stand still, act at random, hold one action, go at once, or go after a
fixed time. Those of the left turn and of the roundabout know the road, and are blind to traffic.
"""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving.intersection_rules import as_in_left_turn
from algorithms.driving.left_turn_rules import GapDriver, GapRule
from algorithms.driving.roundabout_rules import ROUNDABOUTS, RoundaboutDriver, RoundaboutRule
from mo_deepdrive.world.action_sequences import idle
from mo_deepdrive.world.actions import CONTINUOUS, action_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig

    Function = Callable[..., NDArray[Any]]

WAITS = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0, 25.0, 30.0)  # s
LONG_WAITS = (0.0, 20.0, 30.0, 40.0)  # s, of vehicles among others in a roundabout
SPEEDS = (3.0, 4.0, 5.0)  # m/s
STEERS, ACCELERATIONS = (-1.0, -0.3, 0.0, 0.3, 1.0), (0.25, 0.5, 1.0)  # of continuous actions that are held


class Timed:
    """Goes after a fixed time ``wait`` (s), whatever comes; a ``decision`` takes some time (s), too.

    ``drives`` gives actions for observations (N, o) or (N, V, o) and whether to go, else it waits.
    """

    def __init__(self, wait: float, decision: float, drives: Callable[[NDArray[Any], bool], NDArray[Any]]):
        self._decisions, self._past, self._drives = round(wait / decision), 0, drives

    def __call__(self, observations: NDArray[Any], accrued: NDArray[Any], _discounts: NDArray[Any]) -> NDArray[Any]:
        """Actions for observations (N, o) or (N, V, o)."""
        self._past = self._past + 1 if accrued.any() else 0
        return self._drives(observations, self._past >= self._decisions)


def blind_turner(action_type: str, *, others: bool) -> Callable[[NDArray[Any], bool], NDArray[Any]]:
    """Turns left along the lanes and sees nobody on them, alone or as one of two vehicles."""
    driver = GapDriver(GapRule(gap=0.0), action_type)

    def drives(observations: NDArray[Any], goes: bool) -> NDArray[Any]:
        seen = np.asarray(observations, dtype=np.float64)
        seen = as_in_left_turn(seen[:, 0]) if others else seen
        actions = driver.actions(seen, np.full(len(seen), goes))
        return np.stack([actions] * 2, axis=1) if others else actions

    return drives


def blind_follower(speed: float, action_type: str) -> Callable[[NDArray[Any], bool], NDArray[Any]]:
    """Follows its lane at a constant speed (m/s), and sees nobody on it."""
    rule = RoundaboutRule(gap=0.0, approach_speed=speed, inside_speed=speed, exit_speed=speed)
    driver, waiting = RoundaboutDriver(rule, action_type, blind=True), idle(action_type)

    def drives(observations: NDArray[Any], goes: bool) -> NDArray[Any]:
        if goes:
            return driver(observations)
        return np.broadcast_to(waiting, (*observations.shape[:-1], *waiting.shape)).copy()

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
    decision = 1.0 / config.decision_frequency
    if scenario.lanes:
        turner = blind_turner(action_type, others=scenario.vehicles > 1)
        found |= {_timed(wait): Timed(wait, decision, turner) for wait in WAITS}
    if scenario.name in ROUNDABOUTS:
        for speed in SPEEDS:
            follower = blind_follower(speed, action_type)
            found |= {f"{_timed(wait)} at {speed:g} m/s": Timed(wait, decision, follower) for wait in LONG_WAITS}
    return found


def _timed(wait: float) -> str:
    return f"goes after {wait:g} s" if wait else "goes at once"


def _holding(action: NDArray[Any], axes: tuple[int, ...]) -> Function:
    return lambda observations, *_: np.broadcast_to(action, (len(observations), *axes, *action.shape)).copy()


def _random(
    rng: np.random.Generator, action_type: str, axes: tuple[int, ...], observations: NDArray[Any], *_: Any
) -> NDArray[Any]:
    size = (len(observations), *axes)
    if action_type == CONTINUOUS:
        return rng.uniform(-1.0, 1.0, (*size, 3)).astype(np.float32)
    return rng.integers(len(action_names(action_type)), size=size)
