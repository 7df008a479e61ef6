"""The action sets: their names, and tables of discrete actions; :mod:`mo_deepdrive.simulation.actions` decodes them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.simulation.actions import DECREASE, IDLE, INCREASE, MAINTAIN

if TYPE_CHECKING:
    from numpy.typing import NDArray

SPEED_CHANGES = {MAINTAIN: "maintain speed", DECREASE: "decrease speed", INCREASE: "increase speed"}

SMALL_STEER = 0.0174533
MICRO_STEER = 0.00174533
LARGE_STEER = math.pi / 30


@dataclass(frozen=True)
class Steer:
    """How a group of discrete actions steers."""

    name: str
    decay: float = 0.0
    offset: float = 0.0
    curl: float = 0.0


_DECAY = Steer("decay steer", decay=0.9)
_SMALL = (Steer("small steer left", offset=SMALL_STEER), Steer("small steer right", offset=-SMALL_STEER))
_MICRO = (Steer("micro steer left", offset=MICRO_STEER), Steer("micro steer right", offset=-MICRO_STEER))
_LARGE = (
    Steer("large steer left", curl=LARGE_STEER),
    Steer("large steer right", curl=-LARGE_STEER),
)

DISCRETE: dict[str, tuple[Steer, ...]] = {
    "discrete": (_DECAY, *_SMALL, *_MICRO, *_LARGE),
    "discrete-16": (_DECAY, *_SMALL, *_LARGE),
}
CONTINUOUS = "continuous"
ACTION_TYPES: tuple[str, ...] = (*DISCRETE, CONTINUOUS)
CONTINUOUS_NAMES: tuple[str, ...] = ("steer", "acceleration", "brake")


def action_table(action_type: str) -> NDArray[np.float64]:
    """The rows of a discrete action set, shape (actions, 4): decay, offset, curl, speed change."""
    rows = [[0.0, 0.0, 0.0, IDLE]]
    rows += [[s.decay, s.offset, s.curl, change] for s in DISCRETE[action_type] for change in SPEED_CHANGES]
    return np.array(rows, dtype=np.float64)


def action_names(action_type: str) -> tuple[str, ...]:
    """A name for each discrete action (or each continuous axis), in order."""
    if action_type == CONTINUOUS:
        return CONTINUOUS_NAMES
    steers = DISCRETE[action_type]
    return ("idle", *(f"{s.name}, {change}" for s in steers for change in SPEED_CHANGES.values()))
