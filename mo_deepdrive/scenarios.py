"""The scenarios as data.

A scenario is one row of SCENARIOS. All random numbers of an episode are ``scenario.draws`` uniforms in [0, 1) that the
caller passes in: vehicle v starts ``draws[v] * start_span[v]`` m further along y; the first vehicle's last waypoint
moves by ``draws[k : k + 2] * destination_span`` with k = ``destination_draw``; ``draws[2 + 3 j : 5 + 3 j]`` place the
bicycle j; ``draws[k + 3 j : k + 3 + 3 j]`` with k = ``driver_draw`` are the desired speed, headway and yielding of the
oncoming car j. A scenario that does not use a draw has a span of zero. ``simulation/placing.py`` does all this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from mo_deepdrive.names import check_name, nearest
from mo_deepdrive.objectives import INDEX
from mo_deepdrive.plain_values import finite_numbers, with_plain_fields
from mo_deepdrive.simulation.map import HALF_LANE, MAP_CENTRE, MAP_ORIGIN, MAP_UNIT
from mo_deepdrive.simulation.state import LANE_WIDTH, MAX_VEHICLES, MAX_WAYPOINTS

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_CARS = 100  # oncoming cars; more than pass the crossing in a minute
FARTHEST = 250.0  # m; largest coordinate of a start or waypoint, so that observations stay in their space


def metres(p: float) -> float:
    """World coordinate (m) of the map coordinate ``p`` in [0, 1]."""
    return MAP_ORIGIN + MAP_UNIT * p


@dataclass(frozen=True)
class Route:
    """Where a vehicle starts, and where it drives.

    Attributes:
        start: x, y (m) and heading (rad).
        waypoints: (x, y) of one to three points (m), the last of which is the destination.
        start_span: range of the start along y (m).
    """

    start: tuple[float, float, float]
    waypoints: tuple[tuple[float, float], ...]
    start_span: float = 0.0


@dataclass(frozen=True)
class Scenario:
    """One scenario as data.

    Attributes:
        name: the name in ids and configurations.
        routes: one per vehicle: one or two.
        objectives: names of the objectives, in order.
        title: the name in titles and messages.
        destination_span: range of the first vehicle's destination along x and y (m).
        obstacles: how many bicycles are on the way of the vehicle; only where it is alone.
        lanes: whether the roads of the crossing are there, and with them lane distances.
        cars: how many oncoming cars come down the lane opposite to a left-turner; only where the vehicle is alone, and
            there are lanes.
        reference: coordinates of the reference point for hypervolumes by objective, maximised, for every discount
            factor; ``data/reference_points.yaml`` has those of the package's own scenarios.
    """

    name: str
    routes: tuple[Route, ...]
    objectives: tuple[str, ...]
    title: str
    destination_span: tuple[float, float] = (0.0, 0.0)
    obstacles: int = 0
    lanes: bool = False
    cars: int = 0
    reference: Mapping[str, float] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """The id of the environment as it was first published."""
        return next(iter(self.ids))

    @property
    def ids(self) -> dict[str, Mapping[str, Any]]:
        """The arguments that each id sets, the first version first."""
        name = self.name.replace("_", "-")
        versions = VERSIONS.get(self.name, {"v0": {}})
        return {f"mo-deepdrive-{name}-{version}": arguments for version, arguments in versions.items()}

    @property
    def vehicles(self) -> int:
        """How many vehicles there are."""
        return len(self.routes)

    @property
    def others(self) -> bool:
        """Whether there are other vehicles or oncoming cars."""
        return self.vehicles > 1 or self.cars > 0

    @property
    def _own_destination_draws(self) -> bool:
        """Whether both starts and the destination are random, so that they cannot share their draws."""
        return any(self.destination_span) and any(route.start_span for route in self.routes)

    @property
    def destination_draw(self) -> int:
        """The first of the two draws of the destination."""
        return 2 + 3 * max(1, self.obstacles) if self._own_destination_draws else 0

    @property
    def driver_draw(self) -> int:
        """The first of the draws of the oncoming cars, three of each."""
        return 2 + 3 * max(1, self.obstacles) + (2 if self._own_destination_draws else 0)

    @property
    def draws(self) -> int:
        """How many random numbers an episode takes."""
        return self.driver_draw + 3 * self.cars


_OPEN_ROUTE = Route(start=(metres(0.1), metres(0.5), -math.pi / 2), waypoints=((metres(0.2), metres(0.0)),))
_OPEN_SPAN = (0.5 * MAP_UNIT, MAP_UNIT)
_LEFT_TURN = Route(  # unprotected
    start=(27.0770290995851, 6.0, 0.0),
    start_span=12.0,
    waypoints=(
        (MAP_CENTRE + HALF_LANE, MAP_CENTRE - LANE_WIDTH),
        (MAP_CENTRE - LANE_WIDTH, MAP_CENTRE + HALF_LANE),
        (1.840549443086846, MAP_CENTRE + HALF_LANE),
    ),
)

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            name="one_waypoint",
            title="OneWaypoint",
            routes=(_OPEN_ROUTE,),
            destination_span=_OPEN_SPAN,
            objectives=("distance", "destination", "g_force", "jerk"),
        ),
        Scenario(
            name="static_obstacle",
            title="StaticObstacle",
            routes=(_OPEN_ROUTE,),
            destination_span=_OPEN_SPAN,
            objectives=("distance", "destination", "g_force", "collision", "jerk"),
            obstacles=1,
        ),
        Scenario(
            name="intersection",
            title="Intersection",
            routes=(
                _LEFT_TURN,
                Route(  # straight on
                    start=(MAP_CENTRE - HALF_LANE, 33.0, math.pi),
                    start_span=14.0,
                    waypoints=((MAP_CENTRE - HALF_LANE, 4.139197872452702),),
                ),
            ),
            objectives=("distance", "destination", "g_force", "collision", "jerk", "lane_violation"),
            lanes=True,
        ),
        Scenario(
            name="left_turn",
            title="LeftTurn",
            routes=(_LEFT_TURN,),
            objectives=("distance", "destination", "g_force", "collision", "jerk", "lane_violation", "time"),
            lanes=True,
            cars=5,
        ),
    )
}


# What the versions of the package's ids set, by scenario; arguments of make() override it.
VERSIONS: dict[str, dict[str, dict[str, Any]]] = {
    name: {
        "v0": {},
        # Time is an objective, and ending early saves none. At the left turn distance is what was driven: where it
        # turns negative as long as a car approaches, waiting is rewarded for its own sake.
        "v1": {
            "objectives": tuple(dict.fromkeys((*scenario.objectives, "time"))),
            "charge_remaining_time": True,
            **({"yield_to_oncoming": False} if scenario.cars else {}),
        },
    }
    for name, scenario in SCENARIOS.items()
}


def register_id(scenario: Scenario) -> None:
    """Register the environments of a scenario with Gymnasium, for ``make`` and ``make_vec``, in every version."""
    alone = scenario.vehicles == 1
    for env_id, arguments in scenario.ids.items():
        gymnasium.register(
            env_id,
            entry_point="mo_deepdrive.envs.single:DrivingEnv" if alone else "mo_deepdrive.envs.turn_based:TurnBasedEnv",
            vector_entry_point="mo_deepdrive.envs.vector:make_vector_env",
            kwargs={"scenario": scenario.name, **arguments},
        )


def register_scenario(scenario: Scenario) -> None:
    """Add a scenario, and register its id ``mo-deepdrive-<name>-v0`` with dashes in the name.

    Call it in the module that defines the scenario: ``make("module:id")``, and ``environment.id: "module:id"`` in
    YAML, import the module first, in worker processes too. Registering the same scenario again changes nothing.

    Args:
        scenario: the row.

    Raises:
        ValueError: for an invalid field, or another scenario of the same name.
    """
    scenario = with_plain_fields(scenario)
    check_name(scenario.name, "scenario")
    if problem := _problem(scenario):
        raise ValueError(f"scenario {scenario.name!r}: {problem}")
    scenario = _with_tuples(scenario)
    if scenario.name not in SCENARIOS:
        SCENARIOS[scenario.name] = scenario
        register_id(scenario)
    elif scenario != SCENARIOS[scenario.name]:
        raise ValueError(f"scenario {scenario.name!r} is registered already, with other fields; choose another name")


def _problem(scenario: Scenario) -> str:
    """What is wrong with a field of ``scenario``; "" if nothing is."""
    routes = scenario.routes
    if not isinstance(routes, (tuple, list)) or not all(isinstance(route, Route) for route in routes):
        return f"routes = {routes!r} must be a tuple of Route, one per vehicle"
    if not 1 <= len(routes) <= MAX_VEHICLES:
        return f"routes has {len(routes)} entries; it must have one per vehicle, at most {MAX_VEHICLES}"
    if _shape(scenario.destination_span) != (2,):
        return f"destination_span = {scenario.destination_span!r} must be (x, y): finite numbers in m"
    for v, route in enumerate(routes):
        if _shape(route.start) != (3,):
            return f"start = {route.start!r} of route {v} must be (x, y, heading): finite numbers in m and rad"
        shape = _shape(route.waypoints)
        if not shape or (shape[1:] != (2,) and shape != (0,)):
            return f"waypoints = {route.waypoints!r} of route {v} must be (x, y) pairs of finite numbers in m"
        if not 1 <= shape[0] <= MAX_WAYPOINTS:
            return f"waypoints of route {v} has {shape[0]} points; it must have 1 to {MAX_WAYPOINTS}"
        if _shape(route.start_span) != ():
            return f"start_span = {route.start_span!r} of route {v} must be a finite number in m"
        x, y, _ = route.start
        span = scenario.destination_span if v == 0 else (0.0, 0.0)
        points = (*route.waypoints, np.add(route.waypoints[-1], span))
        if np.abs(np.array([(x, y), (x, y + route.start_span), *points])).max() > FARTHEST:
            return f"route {v} with its spans leaves [-{FARTHEST:g}, {FARTHEST:g}] m"
    for name in (*scenario.objectives, *scenario.reference):
        if name not in INDEX:
            return f"objective {name!r} is unknown; {nearest(name, INDEX)}"
    if not scenario.objectives or len(set(scenario.objectives)) != len(scenario.objectives):
        return f"objectives = {list(scenario.objectives)} must be one or more distinct names"
    if isinstance(scenario.obstacles, bool) or not isinstance(scenario.obstacles, int) or scenario.obstacles < 0:
        return f"obstacles = {scenario.obstacles!r} must be a number of bicycles: 0, 1, 2, ..."
    if scenario.obstacles and scenario.vehicles > 1:
        return f"obstacles = {scenario.obstacles} must be 0 where there are two vehicles"
    if isinstance(scenario.cars, bool) or not isinstance(scenario.cars, int) or not 0 <= scenario.cars <= MAX_CARS:
        return f"cars = {scenario.cars!r} must be a number of oncoming cars: 0, 1, ... or {MAX_CARS}"
    if scenario.cars and (scenario.vehicles > 1 or not scenario.lanes):
        return f"cars = {scenario.cars} must be 0 where there are two vehicles or no lanes"
    if any(_shape(value) != () for value in scenario.reference.values()):
        return f"reference = {dict(scenario.reference)!r} must have a finite number per objective"
    return ""


def _with_tuples(scenario: Scenario) -> Scenario:
    """The same scenario with nested tuples, which can be compared, instead of arrays and lists."""
    routes = tuple(
        replace(
            route,
            start=_tuple(route.start),
            waypoints=tuple(_tuple(point) for point in route.waypoints),
            start_span=float(route.start_span),
        )
        for route in scenario.routes
    )
    objectives, span = tuple(scenario.objectives), _tuple(scenario.destination_span)
    return replace(scenario, routes=routes, objectives=objectives, destination_span=span)


def _tuple(numbers: Any) -> Any:
    return tuple(float(number) for number in numbers)


def _shape(value: Any) -> tuple[int, ...] | None:
    """The shape of finite numbers; None for anything else."""
    numbers = finite_numbers(value)
    return None if numbers is None else numbers.shape
