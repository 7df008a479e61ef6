"""Fixed rules for the roundabout: follow the lane, keep a distance, and give way to whoever is inside.

A rule knows the roads, and of everything that moves what an agent observes. It remembers nothing: an action follows
from one observation. Before the roundabout it stops for whoever has right of way and would be at the end of its entry
within ``gap`` seconds, unless it is turning off.

Points are complex numbers x + iy (m). What is seen from a place is ahead of it (real) and to its left (imaginary).
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from algorithms.driving.controls import BRAKE_LIMIT, BRAKING_TIME, Driver, Rule, make_driver
from mo_deepdrive.simulation.geometry import HALF_LENGTH
from mo_deepdrive.simulation.jit import jit, separate_jit, uncounted_jit
from mo_deepdrive.simulation.neighbours import NEIGHBOURS
from mo_deepdrive.simulation.roads import NEXT_POINT, POINT_AFTER
from mo_deepdrive.simulation.state import LENGTH, STANDSTILL_GAP
from mo_deepdrive.simulation.trigonometry import angle_of, sine_cosine
from mo_deepdrive.world.observation import NEIGHBOUR, OWN, ROAD
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.simulation.state import Record, Records
    from mo_deepdrive.world.routes import Route

    Floats = NDArray[np.float64]

ROUNDABOUTS = ("roundabout", "roundabout_solo")
SCENARIO = SCENARIOS["roundabout"]
# The routes from one arm; those from the others are the same ones, turned.
ROUTES = SCENARIO.routes[:3]
LENGTHS = tuple(route.length for route in ROUTES)
LINE = ROUTES[0].priority[0]  # type: ignore[index]  # m along the route, from where it has right of way
_JOINED = ROUTES[0].joints()[2]
RADIUS = 1.0 / ROUTES[0].segments[2].curvature
CENTRE = complex(*_JOINED[:2]) - cmath.rect(RADIUS, _JOINED[2])
ENTERED = cmath.phase(complex(*_JOINED[:2]) - CENTRE)  # where entries end, as an angle at the centre
TO_EXIT = sum(segment.length for segment in ROUTES[0].segments[-2:])  # m, from the circle to the end of a route
HALF_LANE = SCENARIO.routes[0].lane_width / 2

# The lines of the routes as tables: x, y (m), heading (rad) and curvature (1/m) every STEP from BEFORE the start on.
STEP, BEFORE, BEYOND = 0.1, 5.0, 30.0  # m

PREVIEW = 0.7  # s by which the wheel is ahead of the lane; the yaw rate lags by about 0.4
HEADING_GAIN = 0.08  # curvature (1/m) per rad of error
OFFSET_GAIN = 0.042  # curvature (1/m) per m of error
MAX_CURVATURE = 0.16  # 1/m

STATIONS, SPACING = 14, 2.0  # points of the lane where others are looked for, and m from one to the next
ASIDE = (
    LENGTH + HALF_LANE + SPACING
)  # m from one end of somebody to the lane, from which on the other is beside it, too
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


RULE = np.dtype([(field.name, np.float64) for field in fields(RoundaboutRule)])
_NEAR = [(entry.name.removeprefix("near_"), np.float64) for entry in NEIGHBOUR]
SEEN = np.dtype([*((entry.name, np.float64) for entry in (*OWN, *ROAD)), ("near", _NEAR, NEIGHBOURS)])


def _table(route: Route) -> Floats:
    """(M, 4) x, y, heading and curvature of the line of a route."""
    starts = np.cumsum([0.0, *(segment.length for segment in route.segments[:-1])]).tolist()
    joints, line = route.joints(), []
    for along in np.arange(-BEFORE, max(LENGTHS) + BEYOND, STEP).tolist():
        k = sum(start <= along for start in starts[1:])
        segment = replace(route.segments[k], length=along - starts[k])
        line.append((*segment.end(joints[k]), segment.curvature))
    return np.array(line)


TABLES = np.array([_table(route) for route in ROUTES])


class Place(NamedTuple):
    """Where a vehicle is, in the coordinates of the routes from the first arm."""

    route: int  # index of routes
    along: float  # from the start of the route to the projection of the front (m)
    front: complex
    heading: float  # rad


@uncounted_jit
def lane(tables: Floats, route: int, along: float) -> tuple[complex, float, float]:
    """Point, heading (rad) and curvature (1/m) of the line ``along`` (m) a route."""
    place = min(max((along + BEFORE) / STEP, 0.0), tables.shape[1] - 1.001)
    cell = int(place)
    part, here, there = place - cell, tables[route, cell], tables[route, cell + 1]
    x, y = here[0] * (1.0 - part) + there[0] * part, here[1] * (1.0 - part) + there[1] * part
    return complex(x, y), here[2] * (1.0 - part) + there[2] * part, here[3] * (1.0 - part) + there[3] * part


@jit
def direction(angle: float) -> complex:
    """e^(i angle)."""
    sin, cos = sine_cosine(angle)
    return complex(cos, sin)


@jit
def seen_from(place: complex, heading: float, point: complex) -> complex:
    """A point as seen from a place; heading 0 is along y."""
    return (point - place) * (direction(-heading) * -1j)


@jit
def locate(seen: Record, tables: Floats) -> Place:
    """Where a vehicle is: on the route on which the entry and the two points ahead are where they are seen."""
    # As seen from the lane beside the front; the point after is observed by way of the next one.
    nearer = seen.next_distance * direction(seen.heading_error - seen.next_angle)
    farther = (seen.after_distance - seen.next_distance) * direction(seen.heading_error - seen.after_angle)
    least, found = math.inf, Place(0, 0.0, 0j, 0.0)
    for route in range(len(tables)):
        along = LENGTHS[route] - seen.remaining_distance
        point, heading, _ = lane(tables, route, along)
        first = seen_from(point, heading, lane(tables, route, along + NEXT_POINT)[0]) - nearer
        second = seen_from(point, heading, lane(tables, route, along + POINT_AFTER)[0]) - farther
        # The front may be beside the lane, by the same distance at both points.
        off = abs(max(LINE - along, 0.0) - seen.entry_distance)
        off += abs(first.real) + abs(second.real) + abs(first.imag - second.imag)
        if off < least:
            front = point - first.imag * direction(heading)
            least, found = off, Place(route, along, front, heading + seen.heading_error)
    return found


@jit
def lane_curvature(place: Place, speed: float, tables: Floats) -> float:
    """The curvature (1/m) that leads a vehicle with a speed (m/s) along its lane."""
    ahead = PREVIEW * speed - HALF_LENGTH
    point, along, away = place.front + ahead * (direction(place.heading) * 1j), place.along, complex(ahead, 0.0)
    for _ in range(3):  # to where the lane is the nearest to the point
        along += away.real
        nearest, heading, curvature = lane(tables, place.route, along)
        away = seen_from(nearest, heading, point)
    wanted = curvature + HEADING_GAIN * (heading - place.heading) - OFFSET_GAIN * away.imag
    return min(max(wanted, -MAX_CURVATURE), MAX_CURVATURE)


@jit
def locate_other(near: Record, place: Place) -> tuple[complex, float, float]:
    """The centre of somebody near a vehicle, the heading (rad), and the speed (m/s)."""
    centre = place.front + complex(near.ahead - HALF_LENGTH, -near.right) * (direction(place.heading) * 1j)
    turned = angle_of(near.sin_heading, near.cos_heading)
    return centre, place.heading + turned, (complex(near.v_ahead, -near.v_right) * direction(-turned)).real


@jit
def room_before(centre: complex, heading: float, place: Place, line: NDArray[Any], tables: Floats) -> float:
    """The distance (m) along the lane, whose ``line`` is (STATIONS,) points, to somebody else; inf if beside it."""
    least = math.inf
    for end in range(-1, 2):  # the middle of the rear, the centre, and the middle of the front
        point = centre + end * HALF_LENGTH * (direction(heading) * 1j)
        nearest, square = 0, math.inf
        for k in range(STATIONS):
            away = point - line[k]
            if away.real**2 + away.imag**2 < square:
                nearest, square = k, away.real**2 + away.imag**2
        if square > ASIDE**2:
            return math.inf
        there, direct, _ = lane(tables, place.route, place.along + nearest * SPACING)
        beyond = nearest * SPACING + seen_from(there, direct, point)
        if abs(beyond.imag) < HALF_LANE and 0.0 < beyond.real < (STATIONS - 1) * SPACING:
            least = min(least, beyond.real - (REACH if end else HALF_LENGTH))
    return least


@jit
def look_around(seen: Record, place: Place, tables: Floats) -> tuple[float, float]:
    """The room (m) to the next one in the lane, and the time (s) to where the entry ends of who has right of way."""
    room, time = math.inf, math.inf
    line = np.array([lane(tables, place.route, place.along + k * SPACING)[0] for k in range(STATIONS)])
    for number in range(NEIGHBOURS):
        if seen.near[number].present > 0.5:
            centre, heading, speed = locate_other(seen.near[number], place)
            room = min(room, room_before(centre, heading, place, line, tables))
            if seen.near[number].right_of_way > 0.5:
                angle = angle_of((centre - CENTRE).imag, (centre - CENTRE).real)
                if (angle - heading + math.pi) % math.tau - math.pi < TURNS_OFF:
                    distance = RADIUS * ((ENTERED - angle) % math.tau) - HALF_LENGTH
                    time = min(time, max(distance, 0.0) / max(speed, STANDING))
    return max(room, 0.0), time


@separate_jit
def decide(seen: Records, rules: Records, blind: bool, tables: Floats) -> tuple[NDArray[Any], ...]:
    """Curvature, target, brakes and room (N,) of :meth:`Driver.control`, for observations (N,) and rules (N,)."""
    curvature, target, room = np.empty(len(seen)), np.empty(len(seen)), np.full(len(seen), math.inf)
    brakes = np.empty(len(seen), dtype=np.bool_)
    for i in range(len(seen)):
        own, rule, speed, line = seen[i], rules[i], seen[i].speed, seen[i].entry_distance - STOP
        place = locate(own, tables)
        outside, leaving = own.entry_distance > 0.0, own.remaining_distance < TO_EXIT
        target[i] = rule.approach_speed if outside else rule.exit_speed if leaving else rule.inside_speed
        if not blind:
            room[i], time = look_around(own, place, tables)
            room[i] -= STANDSTILL_GAP
            target[i] = min(target[i], max(room[i], 0.0) / rule.headway)
            if outside and time < rule.gap:
                target[i] = min(target[i], STOP_GAIN * line if line > 0.3 else 0.0)
                if line <= speed * BRAKING_TIME:
                    room[i] = min(room[i], line)
        slack = RELEASE if own.brake > 0.0 else min(BRAKE_SLACK, 0.1 + target[i])
        curvature[i], brakes[i] = lane_curvature(place, speed, tables), target[i] + slack < speed < BRAKE_LIMIT
    return curvature, target, brakes, room


class RoundaboutDriver(Driver):
    """Drives any vehicle through the roundabout by a rule; a blind one sees the lane alone, and nobody on it."""

    slack, calm = 0.25, 0.12

    def __init__(self, rule: RoundaboutRule, action_type: str = "discrete", *, blind: bool = False):
        super().__init__(action_type)
        self.rule, self._blind = rule, blind

    def __call__(self, observations: NDArray[Any], *_: Any) -> NDArray[Any]:
        """Actions (...) or (..., 3) for observations (..., size)."""
        seen = np.ascontiguousarray(observations, dtype=np.float64).reshape(-1, observations.shape[-1])
        rules = np.empty(len(seen), dtype=RULE)
        for name, value in vars(self.rule).items():
            rules[name] = value
        actions = self.control(seen, *decide(seen.view(SEEN)[:, 0], rules, self._blind, TABLES))
        return actions.reshape(*observations.shape[:-1], *actions.shape[1:])


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
