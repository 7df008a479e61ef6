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


def action_of_keys(
    table: NDArray[np.float64],
    steer: float,
    speed: float,
    throttle: float,
    accelerate: bool,
    brake: bool,
    left: bool,
    right: bool,
) -> int:
    """The discrete action that comes closest to what the keys that are held down would do in a car.

    Left and right steer as far as any action does at this speed; without them the steering returns to straight. Without
    a key for the speed the car coasts, and without any key the action is idle. If both keys of a pair are down, the car
    brakes, or drives straight on. It is plain enough for Numba.

    Args:
        table: of :func:`action_table`.
        steer: of the car (rad).
        speed: of the car (m/s).
        throttle: of the car (m/s^2).
        accelerate: whether this key is down; so are the others.
        brake: likewise.
        left: likewise.
        right: likewise.
    """
    if not (accelerate or brake or left or right):
        return 0
    change = MAINTAIN
    if brake or (not accelerate and throttle > 0.0):  # the first "decrease" only releases the throttle
        change = DECREASE
    elif accelerate:
        change = INCREASE
    side = int(left) - int(right)
    chosen, best = 0, -np.inf
    for action in range(1, len(table)):
        decay, offset, curl, its_change = table[action]
        target = decay * steer + offset + curl / max(speed, 1.0) ** 2
        if its_change == change and (side == 0 or decay == 0.0):
            closeness = side * target if side else -abs(target)
            if closeness > best:
                chosen, best = action, closeness
    return chosen
