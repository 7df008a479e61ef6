"""Policies that need no skill, by which the floors of the suite are set: a task that one of them solves tests nothing.

They see nothing of what a task is about: they stand still, act at random, hold one action, go at once, or go after a
fixed time. Those of the left turn know the road, and are blind to traffic.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving.intersection_rules import as_in_left_turn
from algorithms.driving.left_turn_rules import GapRule, LeftTurner
from mo_deepdrive.action_sequences import idle
from mo_deepdrive.actions import CONTINUOUS, action_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from mo_deepdrive.config import EnvConfig

    Function = Callable[..., NDArray[Any]]

WAITS = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0, 25.0, 30.0)  # s
STEERS, ACCELERATIONS = (-1.0, -0.3, 0.0, 0.3, 1.0), (0.25, 0.5, 1.0)  # of continuous actions that are held


class Timed:
    """Turns left along the lanes after a fixed time, whatever comes.

    Args:
        wait: seconds before it goes.
        action_type: "discrete", "discrete-16" or "continuous".
        decision: seconds per decision.
        others: whether it is one of two vehicles, whose observations have a second axis.
    """

    def __init__(self, wait: float, action_type: str, decision: float, *, others: bool):
        self._turner = LeftTurner(GapRule(gap=0.0), action_type)
        self._decisions = round(wait / decision)
        self._others = others
        self._past = 0

    def __call__(self, observations: NDArray[Any], accrued: NDArray[Any], _discounts: NDArray[Any]) -> NDArray[Any]:
        """Actions for observations (N, o) or (N, V, o)."""
        self._past = self._past + 1 if accrued.any() else 0
        seen = np.asarray(observations, dtype=np.float64)
        if self._others:
            seen = as_in_left_turn(seen[:, 0])
        actions = self._turner.actions(seen, np.full(len(seen), self._past >= self._decisions))
        return np.stack([actions] * 2, axis=1) if self._others else actions


def unskilled_policies(config: EnvConfig) -> dict[str, Function]:
    """The policies by name, as functions for :func:`mo_deepdrive.evaluation.evaluate`.

    Args:
        config: of the environment.
    """
    scenario = config.row
    axes = (scenario.vehicles,) if scenario.vehicles > 1 else ()
    found: dict[str, Function] = {
        "stands still": _holding(idle(config.action_type), axes),
        "acts at random": partial(_random, np.random.default_rng(0), config.action_type, axes),
    }
    if config.action_type == CONTINUOUS:
        for steer in STEERS:
            for acceleration in ACCELERATIONS:
                action = np.array([steer, acceleration, -1.0], dtype=np.float32)
                found[f"holds steer {steer:g}, acceleration {acceleration:g}"] = _holding(action, axes)
    else:
        names = action_names(config.action_type)
        found |= {f"holds '{name}'": _holding(np.array(i), axes) for i, name in enumerate(names) if i}
    if scenario.lanes:
        decision = 1.0 / config.decision_frequency
        for wait in WAITS:
            name = f"goes after {wait:g} s" if wait else "goes at once"
            found[name] = Timed(wait, config.action_type, decision, others=scenario.vehicles > 1)
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
