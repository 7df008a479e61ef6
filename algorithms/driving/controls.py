"""What scripted drivers share: from what a rule wants, a curvature and a speed, to the actions of an environment."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.actions import CURL, DECAY, DECREASE, INCREASE, MAINTAIN, OFFSET, SPEED_CHANGE
from mo_deepdrive.simulation.jit import separate_jit
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE
from mo_deepdrive.world.actions import CONTINUOUS, action_table
from mo_deepdrive.world.observation import OWN

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

PREFIX = "rule:"  # of the names of scripted drivers
COLUMN = {entry.name: column for column, entry in enumerate(OWN)}

# Of the simulator's vehicle, by its equations of motion (docs/simulator.md).
CURVATURE_PER_STEER = 8.4  # 1/m per rad
DRAG = 0.06  # deceleration by friction (m/s^2) per m/s
BRAKING = 2.45  # deceleration (m/s^2) per m/s and unit of brake
DECISION = 0.1  # s
# A vehicle that brakes fully from the next decision on stands after so many metres per m/s.
BRAKING_TIME = 1.0 / BRAKING + 1.5 * DECISION  # s
THROTTLE = 1.0  # m/s^2, of the discrete actions
BRAKE_LIMIT = 4.35  # m/s above which a discrete brake would be harmful

SOFT_CHANGE = 0.15  # m/s^2 by which the throttle changes in a decision, of continuous actions


def forward(heading: Floats) -> Floats:
    """The direction (..., 2) of a heading (...) (rad)."""
    return np.stack([-np.sin(heading), np.cos(heading)], axis=-1)


class Rule:
    """Base of what drivers are made of: finite numbers of at least 0.1, or 0 for a gap, a distance or a least speed.

    They may be arrays (N,), one number for each of the vehicles that are driven.
    """

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            least = 0.0 if name in ("gap", "stop_distance", "least_speed") else 0.1
            if not np.all(np.isfinite(value) & (value >= least)):
                raise ValueError(f"{name} = {value!r} of a rule must be a finite number of at least {least:g}")


class Driver:
    """Base of scripted drivers: actions (N,), or (N, 3) if they are continuous, for observations (N, size)."""

    vehicle: int | None = None  # that it drives; None for any
    slack = 0.04  # share of the target speed that may be lost before the vehicle speeds up again
    calm = 0.0  # by how much a change of the steering counts, where 1 is as much as what it is off

    def __init__(self, action_type: str = "discrete"):
        self._table = None if action_type == CONTINUOUS else action_table(action_type)

    def control(
        self, seen: Floats, curvature: Floats, target: Floats, brakes: NDArray[np.bool_], room: Floats
    ) -> NDArray[Any]:
        """The actions for a wanted curvature (N,) (1/m) and speed (N,) (m/s), or for braking within a room (N,) (m)."""
        speed, throttle = seen[:, COLUMN["speed"]], seen[:, COLUMN["throttle"]]
        steer = curvature / CURVATURE_PER_STEER
        if self._table is not None:
            return self._nearest(self._table, seen, steer, target, brakes)
        wanted = np.clip(target - speed, 0.0, THROTTLE) + DRAG * speed
        wanted = np.where(brakes | (target < speed - 0.5), 0.0, wanted)
        push = np.clip(wanted, throttle - SOFT_CHANGE, throttle + SOFT_CHANGE)
        push = np.where(brakes, 0.0, np.clip(push, 0.0, MAX_ACCELERATION))
        # To rest within the distance that is left: v' = -BRAKING b v, so b = v / (BRAKING distance).
        brake = np.where(brakes, speed / (BRAKING * np.maximum(room, 0.3 * np.maximum(speed, 0.5))), 0.0)
        actions = (steer / STEER_RANGE, push / MAX_ACCELERATION, 2.0 * brake / MAX_ACCELERATION - 1.0)
        return np.clip(np.stack(actions, axis=1), -1.0, 1.0).astype(np.float32)

    def _nearest(
        self, table: Floats, seen: Floats, steer: Floats, target: Floats, brakes: NDArray[np.bool_]
    ) -> NDArray[Any]:
        """The discrete actions whose change of speed is the right one and whose steering comes nearest."""
        speed, throttle, held = (seen[:, COLUMN[name]] for name in ("speed", "throttle", "steer"))
        wanted = np.where(throttle > 0.0, target, target * (1.0 - self.slack))
        change = np.where(speed < wanted, INCREASE, np.where(throttle > 0.0, DECREASE, MAINTAIN))
        change = np.where(brakes, DECREASE, change)
        return nearest(table, change, steer, np.stack([speed, held], axis=1), self.calm)


@separate_jit
def nearest(table: Floats, change: NDArray[np.int64], steer: Floats, own: Floats, calm: float) -> NDArray[np.int64]:
    """The discrete actions (N,) of a change of speed that steer nearest; ``own`` (N, 2) is speed and steering."""
    actions = np.zeros(len(change), dtype=np.int64)
    for i in range(len(change)):
        speed, held, least = max(own[i, 0], 1.0), own[i, 1], math.inf
        for action in range(len(table)):
            if table[action, SPEED_CHANGE] == change[i]:
                offered = table[action, DECAY] * held + table[action, OFFSET] + table[action, CURL] / speed**2
                error = abs(offered - steer[i]) + calm * abs(offered - held)
                if error < least:
                    actions[i], least = action, error
    return actions


def make_driver(forms: Mapping[str, Callable[..., Driver]], name: str, action_type: str) -> Any:
    """The scripted driver of a name, of the form "kind" or "kind_NUMBER"."""
    for form, make in forms.items():
        pattern = form.replace("NUMBER", r"(\d+(?:\.\d+)?)").replace("INTEGER", r"(\d+)")
        if found := re.fullmatch(PREFIX + pattern, name):
            return make(*map(float, found.groups()), action_type)
    raise ValueError(f"there is no scripted driver {name!r}; write {', '.join(PREFIX + form for form in forms)}")
