"""Fixed rules for the roundabout: follow the lane, keep a distance, and give way to whoever is inside.

A rule knows the roads, and of everything that moves what an agent observes. It remembers nothing: an action follows
from one observation. Before the roundabout it stops for whoever has right of way and would be at the end of its entry
within ``gap`` seconds, unless it is turning off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from algorithms.driving.controls import BRAKE_LIMIT, Driver, Rule, braking_distance, forward, make_driver
from mo_deepdrive.simulation.geometry import HALF_LENGTH
from mo_deepdrive.simulation.neighbours import NEIGHBOURS
from mo_deepdrive.simulation.roads import NEXT_POINT, POINT_AFTER
from mo_deepdrive.simulation.state import STANDSTILL_GAP
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

ROUNDABOUTS = ("roundabout", "roundabout_solo")
SCENARIO = SCENARIOS["roundabout"]
COLUMN = {entry.name: column for column, entry in enumerate(layout(SCENARIO))}
# The routes from one arm; those from the others are the same ones, turned.
ROUTES = SCENARIO.routes[:3]
LENGTHS = np.array([route.length for route in ROUTES])
LINE = ROUTES[0].priority[0]  # type: ignore[index]  # m along the route, from where it has right of way
_JOINED = ROUTES[0].joints()[2]
RADIUS = 1.0 / ROUTES[0].segments[2].curvature
CENTRE = np.array([_JOINED[0] - RADIUS * math.cos(_JOINED[2]), _JOINED[1] - RADIUS * math.sin(_JOINED[2])])
ENTERED = math.atan2(_JOINED[1] - CENTRE[1], _JOINED[0] - CENTRE[0])  # where entries end, as an angle at the centre
TO_EXIT = sum(segment.length for segment in ROUTES[0].segments[-2:])  # m, from the circle to the end of a route

# The lines of the routes as tables: x, y (m), heading (rad) and curvature (1/m) every STEP from BEFORE the start on.
STEP, BEFORE, BEYOND = 0.1, 5.0, 30.0  # m

PREVIEW = 0.7  # s by which the wheel is ahead of the lane; the yaw rate lags by about 0.4
HEADING_GAIN = 0.08  # curvature (1/m) per rad of error
OFFSET_GAIN = 0.042  # curvature (1/m) per m of error
MAX_CURVATURE = 0.16  # 1/m

LOOK_AHEAD = np.arange(0.0, 27.0, 2.0)  # m along the lane, where others are ahead
REACH = 0.5  # m from the middle of somebody's front or rear to what is first in the way
STANDING = 3.3  # m/s, the least speed by which the time to the entry is counted
TURNS_OFF = 0.5  # rad from the direction of the circle, outwards, from which on somebody is leaving it
STOP = 2.0  # m before the line where it stops
BRAKE_SLACK = 1.4  # m/s above the target speed at which it brakes
RELEASE = -0.5  # m/s above the target speed down to which it brakes
STOP_GAIN = 1.4  # 1/s, of the speed before the line over the distance to it


@dataclass(frozen=True)
class RoundaboutRule(Rule):
    """What a fixed rule for the roundabout is made of."""

    gap: float = 3.0  # it enters if nobody with right of way is this close to the end of the entry (s)
    approach_speed: float = 4.2  # on the way to the roundabout (m/s)
    inside_speed: float = 4.0
    exit_speed: float = 4.5
    headway: float = 0.9  # to the one ahead (s)


def _tables() -> Floats:
    """(4, routes, M) x, y, heading and curvature of the lines of the routes."""
    tables, along = [], np.arange(-BEFORE, LENGTHS.max() + BEYOND, STEP)
    for route in ROUTES:
        joints, segments = route.joints(), route.segments
        starts = np.cumsum([0.0, *(segment.length for segment in segments[:-1])])
        numbers = np.maximum(np.searchsorted(starts, along, side="right") - 1, 0).tolist()
        places = zip(along.tolist(), numbers, strict=True)
        poses = [replace(segments[k], length=distance - starts[k]).end(joints[k]) for distance, k in places]
        tables.append([*np.array(poses).T, np.array([segments[k].curvature for k in numbers])])
    return np.array(tables).transpose(1, 0, 2)


TABLES = _tables()


def lane(route: NDArray[np.intp], along: Floats) -> Floats:
    """x, y (m), heading (rad) and curvature (1/m) (4, ...) of the line ``along`` (...) (m) routes (...)."""
    place = np.clip((along + BEFORE) / STEP, 0.0, TABLES.shape[2] - 1.001)
    cell = place.astype(np.intp)
    part = place - cell
    return np.asarray(TABLES[:, route, cell] * (1.0 - part) + TABLES[:, route, cell + 1] * part)


class Place(NamedTuple):
    """Where N vehicles are, in the coordinates of the routes from the first arm."""

    route: NDArray[np.intp]  # (N,) indices of routes
    along: Floats  # (N,) from the start of the route to the projection of the front (m)
    front: Floats  # (N, 2) (m)
    heading: Floats  # (N,) (rad)


def locate(seen: Floats) -> Place:
    """Where vehicles are, from observations (N, size).

    The route is the one on which the entry and the two points ahead are where they are seen.
    """
    error = seen[:, COLUMN["heading_error"]]
    nearer, farther = _point(seen, "next", error), _point(seen, "after", error)
    routes = np.arange(len(ROUTES))
    along = LENGTHS - seen[:, COLUMN["remaining_distance"], None]
    here = lane(routes, along)
    first, second = (_from(here, lane(routes, along + ahead)) for ahead in (NEXT_POINT, POINT_AFTER))
    off = np.abs(np.maximum(LINE - along, 0.0) - seen[:, COLUMN["entry_distance"], None])
    # The front may be beside the lane, by the same distance at both points.
    off += np.abs(first[0] - nearer[0][:, None]) + np.abs(second[0] - farther[0][:, None])
    off += np.abs(first[1] - second[1] - (nearer[1] - farther[1])[:, None])
    route = off.argmin(axis=1)
    rows = np.arange(len(seen))
    x, y, heading, _ = here[:, rows, route]
    left = first[1][rows, route] - nearer[1]
    front = np.stack([x - left * np.cos(heading), y - left * np.sin(heading)], axis=1)
    return Place(route, along[rows, route], front, heading + error)


def _point(seen: Floats, which: str, error: Floats) -> tuple[Floats, Floats]:
    """The next point of the route or the one after it (N,) each: metres ahead along the lane, and to its left."""
    distance = seen[:, COLUMN[f"{which}_distance"]]
    if which == "after":  # it is observed by way of the next one
        distance = distance - seen[:, COLUMN["next_distance"]]
    angle = error - seen[:, COLUMN[f"{which}_angle"]]
    return distance * np.cos(angle), distance * np.sin(angle)


def _from(here: Floats, there: Floats) -> tuple[Floats, Floats]:
    """How far points (2 or more, ...) are ahead and to the left of those ``here``, which are as of :func:`lane`."""
    dx, dy, cos, sin = there[0] - here[0], there[1] - here[1], np.cos(here[2]), np.sin(here[2])
    return dy * cos - dx * sin, -dx * cos - dy * sin


def lane_curvature(place: Place, speed: Floats) -> Floats:
    """The curvature (N,) (1/m) that leads vehicles with a speed (N,) (m/s) along their lane."""
    ahead = PREVIEW * speed - HALF_LENGTH
    point = (place.front + ahead[:, None] * forward(place.heading)).T
    along = place.along + ahead
    for _ in range(2):  # to where the lane is the nearest to the point
        along = along + _from(lane(place.route, along), point)[0]
    line = lane(place.route, along)
    angle, left = line[2] - place.heading, _from(line, point)[1]
    wanted = line[3] + HEADING_GAIN * angle - OFFSET_GAIN * left
    return np.asarray(np.clip(wanted, -MAX_CURVATURE, MAX_CURVATURE))


class Others(NamedTuple):
    """The nearest others of N vehicles, in the coordinates of :class:`Place`."""

    centre: Floats  # (N, 5, 2) (m)
    heading: Floats  # (N, 5) (rad)
    speed: Floats  # (N, 5) (m/s)
    prior: NDArray[np.bool_]  # (N, 5) whether they have right of way over the vehicle
    present: NDArray[np.bool_]  # (N, 5)


def locate_others(seen: Floats, place: Place) -> Others:
    """Where the nearest others of vehicles are, from observations (N, size)."""

    def of(name: str) -> Floats:
        return seen[:, [COLUMN[f"near_{number}_{name}"] for number in range(1, NEIGHBOURS + 1)]]

    ahead = forward(place.heading)[:, None]
    right = np.stack([ahead[..., 1], -ahead[..., 0]], axis=-1)
    centre = place.front[:, None] - HALF_LENGTH * ahead
    centre = centre + of("ahead")[..., None] * ahead + of("right")[..., None] * right
    turned = np.arctan2(of("sin_heading"), of("cos_heading"))
    speed = of("v_ahead") * np.cos(turned) - of("v_right") * np.sin(turned)
    return Others(centre, place.heading[:, None] + turned, speed, of("right_of_way") > 0.5, of("present") > 0.5)


def room_ahead(place: Place, others: Others) -> Floats:
    """The distance (N,) (m) along the lane to the next one that is in it; inf if there is none."""
    rows = place.route[:, None]
    stations = place.along[:, None] + LOOK_AHEAD
    line = lane(rows, stations)
    least = np.full(len(place.along), np.inf)
    reach = HALF_LENGTH * forward(others.heading)
    for point, half in ((others.centre, HALF_LENGTH), (others.centre + reach, REACH), (others.centre - reach, REACH)):
        x, y = np.moveaxis(point, -1, 0)
        dx, dy = x[..., None] - line[0][:, None], y[..., None] - line[1][:, None]
        nearest = (dx * dx + dy * dy).argmin(axis=-1)
        ahead, left = _from(lane(rows, np.take_along_axis(stations, nearest, axis=1)), np.stack([x, y]))
        along = LOOK_AHEAD[nearest] + ahead
        inside = others.present & (np.abs(left) < SCENARIO.routes[0].lane_width / 2)
        inside &= (along > 0.0) & (along < LOOK_AHEAD[-1])
        least = np.minimum(least, np.where(inside, along - half, np.inf).min(axis=1))
    return np.asarray(np.maximum(least, 0.0))


def time_to_entry(others: Others) -> Floats:
    """The time (N,) (s) until somebody with right of way is where the entry ends; inf if there is nobody."""
    x, y = np.moveaxis(others.centre - CENTRE, -1, 0)
    angle = np.arctan2(y, x)
    distance = RADIUS * np.mod(ENTERED - angle, math.tau) - HALF_LENGTH
    outwards = np.mod(angle - others.heading + math.pi, math.tau) - math.pi
    comes = others.present & others.prior & (outwards < TURNS_OFF)
    time = np.maximum(distance, 0.0) / np.maximum(others.speed, STANDING)
    return np.asarray(np.where(comes, time, np.inf).min(axis=1))


class RoundaboutDriver(Driver):
    """Drives any vehicle through the roundabout by a rule; a blind one sees the lane alone, and nobody on it."""

    slack, calm = 0.25, 0.12

    def __init__(self, rule: RoundaboutRule, action_type: str = "discrete", *, blind: bool = False):
        super().__init__(action_type)
        self.rule, self._blind = rule, blind

    def __call__(self, observations: NDArray[Any], *_: Any) -> NDArray[Any]:
        """Actions (...) or (..., 3) for observations (..., size)."""
        size = observations.shape[-1]
        actions = self._actions(np.asarray(observations, dtype=np.float64).reshape(-1, size))
        return actions.reshape(*observations.shape[:-1], *actions.shape[1:])

    def _actions(self, seen: Floats) -> NDArray[Any]:
        rule, place = self.rule, locate(seen)
        speed, entry = seen[:, COLUMN["speed"]], seen[:, COLUMN["entry_distance"]]
        outside = entry > 0.0
        leaving = seen[:, COLUMN["remaining_distance"]] < TO_EXIT
        target = np.where(outside, rule.approach_speed, np.where(leaving, rule.exit_speed, rule.inside_speed))
        room = np.full(len(seen), np.inf)
        if not self._blind:
            others = locate_others(seen, place)
            room = room_ahead(place, others) - STANDSTILL_GAP
            target = np.minimum(target, np.maximum(room, 0.0) / rule.headway)
            line = entry - STOP
            waits = outside & (time_to_entry(others) < rule.gap)
            target = np.where(waits, np.minimum(target, np.where(line > 0.3, STOP_GAIN * line, 0.0)), target)
            waits &= line <= braking_distance(speed)
            room = np.where(waits, np.minimum(room, line), room)
        slack = np.where(seen[:, COLUMN["brake"]] > 0.0, RELEASE, np.minimum(BRAKE_SLACK, 0.1 + target))
        brakes = (speed > target + slack) & (speed < BRAKE_LIMIT)
        return self.control(seen, lane_curvature(place, speed), target, brakes, room)


# Drivers of three characters, by name.
TYPES = {
    "hurried": RoundaboutRule(gap=2.8, approach_speed=4.2, inside_speed=4.3, exit_speed=7.0, headway=0.5),
    "balanced": RoundaboutRule(),
    "careful": RoundaboutRule(gap=5.0, approach_speed=3.0, inside_speed=3.3, exit_speed=4.0, headway=1.4),
}
# From what the drawn ones are, uniform, in the order of the fields.
DRAWN = ((2.5, 6.0), (2.8, 4.2), (3.3, 5.0), (4.0, 7.0), (0.6, 1.8))


def drawn_rule(number: int) -> RoundaboutRule:
    """The rule of a number, which is drawn from DRAWN; no learner trains with them."""
    rng = np.random.default_rng(number)
    return RoundaboutRule(*(float(rng.uniform(*span)) for span in DRAWN))


# ``rule:enters_3`` is the balanced one with a gap of 3 s, ``rule:drawn_7`` the rule that is drawn for the number 7.
make_rule = partial(
    make_driver,
    {
        **{kind: partial(RoundaboutDriver, rule) for kind, rule in TYPES.items()},
        "enters_NUMBER": lambda gap, action_type: RoundaboutDriver(RoundaboutRule(gap=gap), action_type),
        "drawn_INTEGER": lambda number, action_type: RoundaboutDriver(drawn_rule(int(number)), action_type),
    },
)
