"""The action sets: tables of discrete actions, and the functions that decode actions into target controls.

A discrete action is a row: target ``steer = decay * held + offset + curl / max(speed, 1)^2`` and a speed change.
Only "decay steer" depends on the held steer. Target controls are steer (rad),
throttle (m/s^2) and brake (1); see ``simulation.dynamics.drive``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import MAX_ACCELERATION, RUNNING, STEER_RANGE, Records

if TYPE_CHECKING:
    from numpy.typing import NDArray

IDLE, MAINTAIN, DECREASE, INCREASE = 0, 1, 2, 3
SPEED_CHANGES = {MAINTAIN: "maintain speed", DECREASE: "decrease speed", INCREASE: "increase speed"}

# Columns of an action table.
DECAY, OFFSET, CURL, SPEED_CHANGE = 0, 1, 2, 3

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


@jit
def find_unknown(actions: NDArray[np.int64], count: int) -> int:
    """The first world with a discrete action (worlds, vehicles) outside [0, count), or -1."""
    for i in range(actions.shape[0]):
        for v in range(actions.shape[1]):
            if not 0 <= actions[i, v] < count:
                return i
    return -1


@jit
def find_infinite(actions: NDArray[np.float64]) -> int:
    """The first world with a continuous action (worlds, vehicles, 3) that is not finite, or -1."""
    for i in range(actions.shape[0]):
        for v in range(actions.shape[1]):
            for axis in range(actions.shape[2]):
                if not math.isfinite(actions[i, v, axis]):
                    return i
    return -1


@jit
def delay(worlds: Records, sent: NDArray[Any], arriving: NDArray[Any]) -> None:
    """Send actions on their way, and write those that arrive: idle ones in the first decisions of an episode.

    Args:
        worlds: (worlds, vehicles) of VEHICLE with room for pending actions; those of running vehicles change.
        sent: (worlds, vehicles, k) numbers of discrete actions with k = 1, or controls of continuous ones with k = 3.
        arriving: likewise, written; it may be ``sent``.
    """
    for i in range(sent.shape[0]):
        for v in range(sent.shape[1]):
            vehicle = worlds[i, v]
            row = vehicle.decisions % len(vehicle.pending)
            for k in range(sent.shape[2]):
                number = sent[i, v, k]
                arriving[i, v, k] = vehicle.pending[row, k]
                if vehicle.end == RUNNING:
                    vehicle.pending[row, k] = number


@jit
def decode_discrete(
    worlds: Records, actions: NDArray[np.int64], table: NDArray[np.float64], controls: NDArray[np.float64]
) -> None:
    """Write the target controls of discrete actions.

    Args:
        worlds: (worlds, vehicles) of VEHICLE, read only.
        actions: (worlds, vehicles) integers in [0, len(table)).
        table: (actions, 4), from :func:`action_table`.
        controls: (worlds, vehicles, 3), written: steer (rad), throttle (m/s^2), brake.
    """
    for i in range(actions.shape[0]):
        for v in range(actions.shape[1]):
            # Random actions make branches slow, so these are selections of one value of several.
            action = actions[i, v]
            vehicle = worlds[i, v]
            change = table[action, SPEED_CHANGE]
            speed = max(vehicle.speed, 1.0)
            steer = table[action, DECAY] * vehicle.steer + table[action, OFFSET] + table[action, CURL] / (speed * speed)
            drift = 0.99 if vehicle.speed > vehicle.previous_speed else 1.0
            drift = 1.01 if vehicle.speed < vehicle.previous_speed else drift
            throttle = 1.0 if change == INCREASE else 0.0
            throttle = vehicle.throttle * drift if change == MAINTAIN else throttle
            brake = 1.0 if vehicle.throttle == 0.0 else 0.0
            brake = brake if change == DECREASE else 0.0
            controls[i, v, 0] = steer
            controls[i, v, 1] = throttle
            controls[i, v, 2] = brake


@jit
def decode_continuous(actions: NDArray[np.float64], controls: NDArray[np.float64]) -> None:
    """Write the target controls of continuous actions (worlds, vehicles, 3), clipped to [-1, 1]."""
    for i in range(actions.shape[0]):
        for v in range(actions.shape[1]):
            controls[i, v, 0] = min(max(actions[i, v, 0], -1.0), 1.0) * STEER_RANGE
            controls[i, v, 1] = min(max(actions[i, v, 1], -1.0), 1.0) * MAX_ACCELERATION
            controls[i, v, 2] = MAX_ACCELERATION * (1.0 + min(max(actions[i, v, 2], -1.0), 1.0)) / 2
