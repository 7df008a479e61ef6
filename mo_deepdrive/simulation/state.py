"""The state of a vehicle and the parameters of a simulation, as NumPy records.

The state is one record array of shape (worlds, vehicles): a copy of it is a checkpoint, and assigning the copy back
resumes exactly. The simulation has no other memory.
"""

from __future__ import annotations

import functools
import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Types of arguments: a record of one of the dtypes in this module, or an array of them (NumPy's stubs know no fields).
Record: TypeAlias = Any
Records: TypeAlias = NDArray[Any]

# The magnitudes that the kernel measures, in the order of ``objectives`` in the state of a vehicle.
KERNEL_NAMES = ("distance", "destination", "g_force", "collision", "jerk", "lane_violation")
# Those of which something may have been spent before an episode begins.
SPENT_NAMES = ("g_force", "jerk", "time")

MAX_VEHICLES = 16  # of a world, cars included; of routes of waypoints two
MAX_OBJECTIVES = 32  # of a vehicle's reward
MAX_WAYPOINTS = 3
MAX_ROUTES = 16  # of segments, of a scenario
MAX_SEGMENTS = 8  # of a route
NEAREST_CARS = 2  # oncoming cars that an observation has room for: the next ones that have not passed the crossing

# Vehicle constants of DeepDrive Zero (m, m/s^2). The wheelbase is split over the *width*, as in the original.
WIDTH = 2.300675555555556
LENGTH = 5.17652
REAR_AXLE = WIDTH / 8
CENTRE_OF_GRAVITY = WIDTH / 2 + 0.05 * WIDTH
AXLE_B = CENTRE_OF_GRAVITY - REAR_AXLE
AXLE_A = (WIDTH - REAR_AXLE) - CENTRE_OF_GRAVITY
STEER_RANGE = np.pi / 6
MAX_ACCELERATION = 3.625
GRAVITY = 9.807
TOP_SPEED = 100.0
YAW_FRICTION = 0.95
SPEED_FRICTION = 0.999
BRAKE_FRICTION = 0.96
LANE_WIDTH = 3.048
# Below this time to collision encounters in towns are conflicts: the threshold of A. R. A. van der Horst and J.
# Hogema, "Time-to-collision and collision avoidance systems", ICTCT workshop, 1993, and the default of the Surrogate
# Safety Assessment Model (D. Gettman et al., FHWA-HRT-08-051, 2008).
CONFLICT_TIME = 1.5  # s
STANDSTILL_GAP = 2.0  # m, S0 of the Intelligent Driver Model (traffic.py)
ARRIVAL_RADIUS = 1.0
BACKWARDS_LIMIT = 2.0
LANE_TOLERANCE = 0.25
CIRCLING_LIMIT = np.radians(400.0)

# Why a vehicle's episode ended; the position is the code in ``vehicle.end``.
ENDS: tuple[str, ...] = (
    "",
    "collision",
    "harmful_g_force",
    "harmful_jerk",
    "off_lane",
    "circling",
    "skipped_waypoint",
    "backwards",
    "arrived",
    "time_limit",
    "other_vehicle",
)
RUNNING = ENDS.index("")
COLLISION = ENDS.index("collision")
HARMFUL_G_FORCE = ENDS.index("harmful_g_force")
HARMFUL_JERK = ENDS.index("harmful_jerk")
OFF_LANE = ENDS.index("off_lane")
CIRCLING = ENDS.index("circling")
SKIPPED_WAYPOINT = ENDS.index("skipped_waypoint")
BACKWARDS = ENDS.index("backwards")
ARRIVED = ENDS.index("arrived")
TIME_LIMIT = ENDS.index("time_limit")
OTHER_VEHICLE = ENDS.index("other_vehicle")

NEVER = -1  # of ``entered``

# The square on which scenarios are drawn, and the crossing in its middle (m). The original draws on a 1000 px square
# with a 50 px margin.
PIXELS_PER_METRE = 405 / LENGTH / 4
MAP_UNIT = 900 / PIXELS_PER_METRE
MAP_ORIGIN = 50 / PIXELS_PER_METRE
MAP_CENTRE = MAP_ORIGIN + MAP_UNIT / 2
MAP_SIZE = 1000 / PIXELS_PER_METRE
HALF_LANE = LANE_WIDTH / 2

# Up to 16 worlds are computed side by side, in lanes: two vectors of AVX-512, or four of AVX2. A loop over the lanes
# without branches and calls becomes vector instructions. Each lane is computed as if it were alone, so results do not
# depend on which worlds share a block.
LANES = 16

_FLOAT = np.float64


def _fields(kind: Any, *names: str, shape: tuple[int, ...] = ()) -> list[tuple[Any, ...]]:
    """The fields of a record that have one type and shape."""
    return [(name, kind, shape) for name in names]


def _record(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    return np.dtype((np.record, list(fields)))


# What is drawn of the driver of a car, and hidden (m/s, s, m/s^2, s): how hard it brakes for a left-turner at most, see
# traffic.py, and which gap it accepts to enter, see road_traffic.py.
DRIVER = _record(*_fields(_FLOAT, "desired_speed", "headway", "yielding", "accepted_gap"))

# One car with a scripted driver, which drives down its lane or along its route (m, m/s, m/s^2). It is present until it
# has left the map, or arrived.
CAR = _record(
    *_fields(_FLOAT, "x", "y", "speed", "acceleration", "cos_heading", "sin_heading"),
    # on roads of segments: as of a vehicle
    ("route", np.int64),
    ("route_distance", _FLOAT),
    ("entered", np.int64),
    ("driver", DRIVER),
    ("present", np.bool_),
)

VEHICLE = _record(
    # pose and motion (m, rad, m/s, rad per physics step, m/s^2, m/s^3)
    *_fields(_FLOAT, "x", "y", "heading", "speed", "yaw_step", "vx", "vy", "ax", "ay", "g_force", "jerk"),
    # cosine and sine of the heading, and of the heading one physics step ago
    *_fields(_FLOAT, "cos_heading", "sin_heading", "cos_before", "sin_before"),
    # held controls (rad, m/s^2, 1) and the speed at the previous decision
    *_fields(_FLOAT, "steer", "throttle", "brake", "previous_speed"),
    # progress along the route (m, rad)
    *_fields(_FLOAT, "front_x", "front_y", "travelled", "next_distance", "route_distance", "furthest", "start_heading"),
    *_fields(_FLOAT, "lane_centre", "left_lane_distance", "right_lane_distance"),
    *_fields(np.int64, "next_waypoint", "n_waypoints"),
    *_fields(np.bool_, "crossing", "approaching"),
    # on roads of segments: route and segment, how far the front is to the left of the line, and the heading
    # from its direction (m, rad); the decision on which the front reached the stretch with right of way, or -1
    *_fields(np.int64, "route", "segment"),
    *_fields(_FLOAT, "lane_offset", "heading_error"),
    ("entered", np.int64),
    # the episode so far
    *_fields(np.int64, "decisions", "end"),
    ("objectives", _FLOAT, (len(KERNEL_NAMES),)),
    ("spent", _FLOAT, (len(SPENT_NAMES),)),
    # the scenario drawn at reset: waypoints, distance along the route to each, the obstacle's two ends
    ("waypoints", _FLOAT, (MAX_WAYPOINTS, 2)),
    ("along", _FLOAT, (MAX_WAYPOINTS,)),
    ("obstacle", _FLOAT, (2, 2)),
    # the actions on their way, that of decision t in the row t mod delay: the number of a discrete one, or the
    # controls of a continuous one; zeros idle
    ("pending", _FLOAT, (0, 3)),
    # the cars with scripted drivers, oncoming ones the first one first; of vehicle 0
    ("cars", CAR, (0,)),
)

# One scenario, ready to be placed in a world: poses (x, y, heading), waypoints and the obstacle's two ends (m, rad),
# what has been spent before, the number of oncoming cars and their drivers. On roads of segments, of the vehicles and
# then the cars: routes, and where along them the fronts are (m); of every entry how many wait there, and where the next
# front can be (m).
SPAWN = _record(
    *_fields(_FLOAT, "routes", "distances", shape=(MAX_VEHICLES,)),
    *_fields(_FLOAT, "waiting", "room", shape=(MAX_ROUTES,)),
    ("starts", _FLOAT, (MAX_VEHICLES, 3)),
    ("waypoints", _FLOAT, (MAX_VEHICLES, MAX_WAYPOINTS, 2)),
    ("obstacle", _FLOAT, (2, 2)),
    ("spent", _FLOAT, (len(SPENT_NAMES),)),
    ("n_cars", _FLOAT),
    ("drivers", DRIVER, (0,)),
)


def aligned(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The same record with every number at a multiple of its size, from where alone a GPU can load it.

    Gaps are fields, too, because a copy of a record leaves anything in gaps without a name.
    """
    if dtype.names is None:
        return dtype
    fields: list[tuple[str, Any, tuple[int, ...]]] = []
    end = 0
    for name in (*dtype.names, None):
        base = aligned(dtype[name].base) if name else None
        gap = -end % (base.itemsize if base is not None and base.names is None else 8)
        if gap:
            fields.append((f"gap_{end}", np.uint8, (gap,)))
        if name and base is not None:
            fields.append((name, base, dtype[name].shape))
            end += gap + base.itemsize * math.prod(dtype[name].shape)
    return np.dtype((np.record, np.dtype(fields, align=True)))


@functools.cache  # one object for all batches: Numba takes microseconds per call to find that two dtypes are equal
def with_room(dtype: np.dtype[Any], obstacles: int, cars: int, delay: int) -> np.dtype[Any]:
    """VEHICLE or SPAWN with room for what not all worlds have.

    That is the two ends of every obstacle, or of one if there is none, ``cars`` oncoming cars, and the actions of
    ``delay`` decisions.
    """
    shapes: dict[str, tuple[int, ...]] = {
        "obstacle": (2 * max(1, obstacles), 2),
        "cars": (cars,),
        "drivers": (cars,),
        "pending": (delay, 3),
    }
    fields = ((name, dtype[name].base, shapes.get(name, dtype[name].shape)) for name in dtype.names or ())
    return aligned(np.dtype(list(fields)))


def in_lanes(*names: str) -> np.dtype[Any]:
    """A scratch record with an array (LANES,) of float64 for every name."""
    return _record(*_fields(_FLOAT, *names, shape=(LANES,)))


# A straight or an arc, from its start (m, rad). Curvature is positive to the left (1/m), ``along`` is how far along the
# route it begins, and the half angle is half of what the arc turns by.
SEGMENT = _record(
    *_fields(_FLOAT, "x", "y", "heading", "cos_heading", "sin_heading"),
    *_fields(_FLOAT, "length", "curvature", "along", "cos_half_angle", "sin_half_angle"),
)

# The part of an environment's configuration that the kernel needs.
PARAMS = _record(
    ("dt", _FLOAT),
    ("physics_steps", np.int64),
    *_fields(_FLOAT, "yaw_friction", "speed_friction", "log_brake_friction"),
    ("max_decisions", np.int64),
    *_fields(_FLOAT, "harmful_g_force", "harmful_jerk", "lane_margin"),
    *_fields(
        np.bool_, "constrain_controls", "ignore_brake", "end_on_lane_violation", "yield_to_oncoming", "end_together"
    ),
    *_fields(np.bool_, "charge_remaining_time", "has_obstacle", "has_lanes"),
    # the objectives that are emitted: columns of the reward, and signs; first the ``n_objectives`` that the
    # kernel measures, with their indices, then those with a measure of their own
    ("n_objectives", np.int64),
    ("objective_index", np.int64, (len(KERNEL_NAMES),)),
    ("objective_column", np.int64, (MAX_OBJECTIVES,)),
    ("objective_sign", _FLOAT, (MAX_OBJECTIVES,)),
    # the scenario: see scenarios.py
    ("vehicles", np.int64),
    ("conflict_time", _FLOAT),
    ("n_waypoints", np.int64, (MAX_VEHICLES,)),
    ("starts", _FLOAT, (MAX_VEHICLES, 3)),
    *_fields(_FLOAT, "start_span", "lane_centre", shape=(MAX_VEHICLES,)),
    ("waypoints", _FLOAT, (MAX_VEHICLES, MAX_WAYPOINTS, 2)),
    ("destination_span", _FLOAT, (2,)),
    ("destination_draw", np.int64),
    ("spent_span", _FLOAT, (len(SPENT_NAMES),)),
    ("spent_draw", np.int64),
    *_fields(np.bool_, "fixed_destination", "fixed_obstacle"),
    ("map_centre", _FLOAT),
    *_fields(np.int64, "n_cars", "observed_cars"),
    ("mean_headway", _FLOAT),
    ("driver_draw", np.int64),
    # the routes of segments, none where routes are waypoints: which entry each begins at, its segments, length,
    # the stretch on which it has right of way, half the width of its lane (m), and where along every other
    # route it joins that one (NaN if it does not)
    ("n_routes", np.int64),
    *_fields(np.int64, "entry", "n_segments", shape=(MAX_ROUTES,)),
    ("segments", SEGMENT, (MAX_ROUTES, MAX_SEGMENTS)),
    ("route_length", _FLOAT, (MAX_ROUTES,)),
    ("priority", _FLOAT, (MAX_ROUTES, 2)),
    ("half_lane", _FLOAT, (MAX_ROUTES,)),
    ("joins", _FLOAT, (MAX_ROUTES, MAX_ROUTES)),
    # the entries: the first of its routes and their number, how many vehicles it has room for, the range of
    # where each starts behind the one ahead, and where the first front is at most (m)
    ("n_entries", np.int64),
    *_fields(np.int64, "first_route", "n_routes_there", "entry_room", shape=(MAX_ROUTES,)),
    *_fields(_FLOAT, "entry_span", "entry_length", shape=(MAX_ROUTES,)),
)
PARAMS = aligned(PARAMS)
