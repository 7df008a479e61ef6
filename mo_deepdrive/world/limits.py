"""Largest magnitudes that the dynamics allow: they bound the spaces, and a state that is restored.

The kernel trusts its state: an index out of range would read foreign memory, and a speed of 10^9 m/s would be tested
for collisions in 10^9 poses. So a state from outside, of a file for example, passes :func:`check_state` first.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.road_traffic import ACCEPTED_GAPS
from mo_deepdrive.simulation.state import (
    ENDS,
    GRAVITY,
    LENGTH,
    MAP_SIZE,
    MAX_ACCELERATION,
    NEVER,
    RUNNING,
    SPENT_NAMES,
    STANDSTILL_GAP,
    STEER_RANGE,
    TOP_SPEED,
)
from mo_deepdrive.simulation.traffic import DESIRED_SPEEDS, HEADWAYS, MAX_BRAKING, YIELDINGS
from mo_deepdrive.support.plain_values import is_finite
from mo_deepdrive.world.actions import CONTINUOUS, action_table
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.observation import FAR

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig

# The held throttle is below this (m/s^2): "maintain speed" raises it only while friction is larger, and friction at
# top speed is 6 m/s^2.
TOP_THROTTLE = 10.0
# Far more than any heading (rad) and any turn in a physics step.
TOP_HEADING = 1e5
ROUNDING = 1e-6  # relative

# The fields of VEHICLE by the limit of their magnitude.
_SIGNED = {
    "m": (
        *("x", "y", "front_x", "front_y", "route_distance", "furthest", "lane_centre"),
        *("left_lane_distance", "right_lane_distance", "waypoints", "obstacle", "lane_offset"),
    ),
    "rad": ("heading", "start_heading", "yaw_step", "heading_error"),
    "m/s": ("speed", "previous_speed", "vx", "vy"),
    "m/s^2": ("ax", "ay"),
    "1": ("cos_heading", "sin_heading", "cos_before", "sin_before"),
    "steer": ("steer",),
    "throttle": ("throttle",),
    "objective": ("objectives",),
}
_POSITIVE = {
    "m": ("next_distance", "along"),
    "travelled": ("travelled",),
    "m/s^3": ("jerk",),
    "g": ("g_force",),
    "brake": ("brake",),
}


def limits(config: EnvConfig) -> dict[str, float]:
    """Largest magnitudes that the dynamics allow, by unit (m/s, m/s^2, m/s^3, g, ...) and entry name."""
    rate = float(config.simulation_frequency)
    longest = max(route.length for route in config.scenario_data.routes)  # of lanes of segments; 0 where there are none
    speed = TOP_SPEED + TOP_THROTTLE / rate + 1.0
    acceleration = 2 * speed * rate
    return {
        "m/s": speed,
        "m/s^2": acceleration,
        "m/s^3": 2 * acceleration * rate,
        "g": acceleration / GRAVITY,
        "steer": STEER_RANGE,
        "throttle": TOP_THROTTLE,
        # The distance of one decision, the swing of the front, and the change to the next waypoint. In a bend the inner
        # edge of the road is shorter than its line.
        "distance": speed / config.decision_frequency + 2 * LENGTH + 2.0 + longest,
        "lane_violation": 2 * FAR + 2 * config.lane_margin,
        "right_of_way": MAX_BRAKING / config.decision_frequency,
        "energy": TOP_THROTTLE * speed / config.decision_frequency,
        "time": (config.max_decisions if config.charge_remaining_time else 1) / config.decision_frequency,
    }


def objective_bound(name: str, config: EnvConfig) -> float:
    """Largest magnitude of an objective in one decision; a ValueError if a registered one gives no positive number."""
    bound = OBJECTIVES[INDEX[name]].bound
    spent = dict(zip(SPENT_NAMES, config.scenario_data.spent, strict=True)).get(name, 0.0)
    if isinstance(bound, str):
        return limits(config)[bound] + spent
    value = bound(config) if callable(bound) else bound
    if not (is_finite(value) and value > 0):
        raise ValueError(f"objective {name!r}: its bound is {value!r}; it must be a positive number")
    return float(value)


def _state_ranges(config: EnvConfig, n_waypoints: NDArray[np.int64]) -> dict[str, tuple[Any, Any]]:
    """The lowest and the highest value of every field of VEHICLE, for vehicles with ``n_waypoints`` (vehicles,).

    The name of a field of a car is a path such as ``cars.driver.headway``.
    """
    most = limits(config)
    most |= {
        "m": FAR,
        "rad": TOP_HEADING,
        "1": 1.0,
        "brake": MAX_ACCELERATION,
        "travelled": most["m/s"] * config.max_decisions / config.decision_frequency,
        "objective": max(most.values()) + max(config.scenario_data.spent),
    }
    most = {name: value * (1 + ROUNDING) for name, value in most.items()}
    pending = (-MAX_ACCELERATION, MAX_ACCELERATION)  # of delayed actions
    if config.action_type != CONTINUOUS:
        pending = (0, len(action_table(config.action_type)) - 1)
    return {
        **{name: (-most[limit], most[limit]) for limit, names in _SIGNED.items() for name in names},
        **{name: (0.0, most[limit]) for limit, names in _POSITIVE.items() for name in names},
        "next_waypoint": (0, n_waypoints - 1),
        "n_waypoints": (n_waypoints, n_waypoints),
        "crossing": (0, 1),
        "approaching": (0, 1),
        "route": (0, max(len(config.scenario_data.routes) - 1, 0)),
        "segment": (0, max(max(len(route.segments) for route in config.scenario_data.routes) - 1, 0)),
        "entered": (NEVER, config.max_decisions),
        "decisions": (0, config.max_decisions),
        "end": (0, len(ENDS) - 1),
        "pending": pending,
        "spent": (0.0, max(config.scenario_data.spent)),
        **{f"cars.{name}": bounds for name, bounds in _car_ranges(config, most).items()},
    }


def _car_ranges(config: EnvConfig, most: dict[str, float]) -> dict[str, tuple[float, float]]:
    """The lowest and the highest value of every field of CAR."""
    longest_gap = HEADWAYS[1] * DESIRED_SPEEDS[1] + STANDSTILL_GAP + LENGTH
    return {
        "x": (-most["m"], most["m"]),
        "y": (-most["m"], MAP_SIZE + config.scenario_data.cars * longest_gap),
        "cos_heading": (-most["1"], most["1"]),
        "sin_heading": (-most["1"], most["1"]),
        "route": (0, len(config.scenario_data.routes) - 1),
        "route_distance": (-most["m"], most["m"]),
        "entered": (NEVER, config.max_decisions),
        "speed": (0.0, most["m/s"]),
        "acceleration": (-MAX_BRAKING * (1 + ROUNDING), MAX_ACCELERATION * (1 + ROUNDING)),
        "driver.desired_speed": DESIRED_SPEEDS,
        "driver.headway": HEADWAYS,
        "driver.yielding": YIELDINGS,
        "driver.accepted_gap": ACCEPTED_GAPS,
        "present": (0, 1),
    }


def check_state(state: NDArray[Any], config: EnvConfig, n_waypoints: NDArray[np.int64]) -> None:
    """Refuse a state (worlds, vehicles) of VEHICLE that the kernel cannot take.

    The vehicles have ``n_waypoints`` (vehicles,). The ValueError names the first field out of range or not finite, its
    value and its range.
    """
    # Worlds that were never reset have no waypoints, and nothing in them moves.
    unplaced = (state["n_waypoints"] == 0) & (state["end"] != RUNNING)
    for name, (low, high) in _state_ranges(config, n_waypoints).items():
        values = state
        for part in name.split("."):
            values = values[part]
        if values.dtype == np.bool_:
            values = values.view(np.uint8)
        wrong = ~((values >= low) & (values <= high))
        if name in ("n_waypoints", "cars.driver.desired_speed"):
            wrong &= ~unplaced.reshape(unplaced.shape + (1,) * (wrong.ndim - unplaced.ndim))
        if wrong.any():
            world, vehicle, *_ = where = tuple(int(i) for i in np.argwhere(wrong)[0])
            least, greatest = (np.broadcast_to(bound, values.shape[:2])[world, vehicle] for bound in (low, high))
            raise ValueError(
                f"state has {name} = {values[where]} for vehicle {vehicle} of world {world}; "
                f"it must be between {least:g} and {greatest:g}"
            )
