"""The scenarios as data.

A scenario is one row of SCENARIOS. All random numbers of an episode are ``scenario.draws`` uniforms in [0, 1) that the
caller passes in: vehicle v starts ``draws[v] * start_span[v]`` m further along y; the first vehicle's last waypoint
moves by ``draws[k : k + 2] * destination_span`` with k = ``destination_draw``; ``draws[2 + 3 j : 5 + 3 j]`` place the
bicycle j; ``draws[k + 3 j : k + 3 + 3 j]`` with k = ``driver_draw`` are the desired speed, headway and yielding of the
oncoming car j. A scenario that does not use a draw has a span of zero. On roads of segments, ``draws[0]`` is who queues
first, ``draws[1 + 3 b : 4 + 3 b]`` are entry, route and place of the vehicle or car b, and of the driver of the car j
``draws[k + 3 j : k + 3 + 3 j]`` with k = ``driver_draw`` are the desired speed, the time gap and the accepted gap.
Where something may have been spent before, the last three draws are g-force, jerk and time.
``simulation/placing.py`` does all this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import gymnasium

from mo_deepdrive.simulation.state import (
    CONFLICT_TIME,
    HALF_LANE,
    LANE_WIDTH,
    MAP_CENTRE,
    MAP_ORIGIN,
    MAP_UNIT,
    MAX_VEHICLES,
    SPENT_NAMES,
)
from mo_deepdrive.support.names import check_name, nearest
from mo_deepdrive.support.plain_values import is_finite, with_plain_fields
from mo_deepdrive.world.objectives import INDEX
from mo_deepdrive.world.roundabout import roundabout_routes
from mo_deepdrive.world.routes import (
    Route,
    as_tuples,
    capacity,
    lane_problem,
    lanes_problem,
    shape_of,
    start_problem,
    waypoints_problem,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_CARS = 100  # oncoming cars; more than pass the crossing in a minute
ON_WAYPOINTS = 2  # vehicles; more drive on roads of segments
COMFORTABLE_TIME = 0.95  # s, the least time to collision of nuPlan (H. Caesar et al., arXiv:2106.11810, in its metrics)


def metres(p: float) -> float:
    """World coordinate (m) of the map coordinate ``p`` in [0, 1]."""
    return MAP_ORIGIN + MAP_UNIT * p


@dataclass(frozen=True)
class Scenario:
    """One scenario as data.

    Attributes:
        name: the name in ids and configurations.
        routes: of waypoints, one per vehicle: one or two. Of segments, those from which one is drawn for every vehicle
            and episode: first an entry, then one of the routes that start there.
        objectives: names of the objectives, in order.
        title: the name in titles and messages.
        destination_span: range of the first vehicle's destination along x and y (m).
        obstacles: how many bicycles are on the way of the vehicle; only where it is alone.
        lanes: whether the roads of the crossing are there, and with them lane distances.
        cars: how many cars have scripted drivers: on roads of segments they drive along drawn routes; otherwise, where
            the vehicle is alone and there are lanes, they come down the lane opposite to a left-turner.
        number: how many vehicles there are on roads of segments; the argument ``vehicles`` changes it if it is above 1.
        spent: the most g-force (g), jerk (m/s^3) and time (s) that may have been spent before an episode begins; the
            argument ``spent`` changes it.
        conflict_time: the time to collision below which a decision is a near miss (s).
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
    number: int = 1
    spent: tuple[float, float, float] = (0.0, 0.0, 0.0)
    conflict_time: float = CONFLICT_TIME
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
        return self.number if self.roads else len(self.routes)

    @property
    def roads(self) -> bool:
        """Whether the routes are of segments."""
        return any(bool(route.segments) for route in self.routes)

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
        """The first of the draws of the cars' drivers, three of each."""
        if self.roads:
            return 1 + 3 * (self.vehicles + self.cars)
        return 2 + 3 * max(1, self.obstacles) + (2 if self._own_destination_draws else 0)

    @property
    def spent_draw(self) -> int:
        """The first of the draws of what has been spent before."""
        return self.driver_draw + 3 * self.cars

    @property
    def draws(self) -> int:
        """How many random numbers an episode takes."""
        return self.spent_draw + (len(SPENT_NAMES) if any(self.spent) else 0)


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
_ROUNDABOUT: Any = {
    "routes": roundabout_routes(),
    "conflict_time": COMFORTABLE_TIME,
    "objectives": (
        *("distance", "destination", "time", "g_force", "jerk"),
        *("lane_violation", "collision", "near_miss", "right_of_way", "energy"),
    ),
}

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
        Scenario(name="roundabout", title="Roundabout", number=4, **_ROUNDABOUT),
        Scenario(name="roundabout_solo", title="Roundabout solo", cars=7, **_ROUNDABOUT),
    )
}


# Defaults of EnvConfig by name, so that they hold where others are the default.
_V0: dict[str, Any] = {"objectives": None, "charge_remaining_time": False}
# What the versions of the package's ids set, by scenario; arguments of make() override it.
VERSIONS: dict[str, dict[str, dict[str, Any]]] = {
    name: {
        "v0": {**_V0, **({"yield_to_oncoming": True} if scenario.cars else {})},
        # Time is an objective, and ending early saves none. At the left turn distance is what was driven: where it
        # turns negative as long as a car approaches, waiting is rewarded for its own sake.
        "v1": {
            "objectives": tuple(dict.fromkeys((*scenario.objectives, "time"))),
            "charge_remaining_time": True,
            **({"yield_to_oncoming": False} if scenario.cars else {}),
        },
    }
    for name, scenario in SCENARIOS.items()
    if not scenario.roads
} | {name: {"v0": {"charge_remaining_time": True}} for name in ("roundabout", "roundabout_solo")}


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
    roads = scenario.roads
    if not routes or (not roads and len(routes) > ON_WAYPOINTS):
        return f"routes has {len(routes)} entries; it must have one per vehicle, at most {ON_WAYPOINTS}"
    if shape_of(scenario.destination_span) != (2,):
        return f"destination_span = {scenario.destination_span!r} must be (x, y): finite numbers in m"
    for v, route in enumerate(routes):
        span = scenario.destination_span if v == 0 else (0.0, 0.0)
        problem = start_problem(v, route)
        problem = problem or (lane_problem(v, route) if roads else waypoints_problem(v, route, span))
        if problem:
            return problem
    if not is_finite(scenario.conflict_time) or scenario.conflict_time <= 0.0:
        return f"conflict_time = {scenario.conflict_time!r} must be a finite number of seconds above 0"
    for name in (*scenario.objectives, *scenario.reference):
        if name not in INDEX:
            return f"objective {name!r} is unknown; {nearest(name, INDEX)}"
    if not scenario.objectives or len(set(scenario.objectives)) != len(scenario.objectives):
        return f"objectives = {list(scenario.objectives)} must be one or more distinct names"
    if shape_of(scenario.spent) != (len(SPENT_NAMES),) or min(scenario.spent) < 0.0:
        return f"spent = {scenario.spent!r} must be g-force (g), jerk (m/s^3) and time (s): finite and at least 0"
    if not isinstance(scenario.lanes, bool):
        return f"lanes = {scenario.lanes!r} must be True or False"
    if not _is_count(scenario.obstacles):
        return f"obstacles = {scenario.obstacles!r} must be a number of bicycles: 0, 1, 2, ..."
    if scenario.obstacles and (scenario.vehicles > 1 or roads):
        return f"obstacles = {scenario.obstacles} must be 0 where there are two vehicles or roads of segments"
    if not _is_count(scenario.cars) or scenario.cars > MAX_CARS:
        return f"cars = {scenario.cars!r} must be a number of cars: 0, 1, ... or {MAX_CARS}"
    if roads:
        return _roads_problem(scenario)
    if scenario.number != 1:
        return f"number = {scenario.number!r} has no effect without roads of segments; omit it"
    if scenario.cars and (scenario.vehicles > 1 or not scenario.lanes):
        return f"cars = {scenario.cars} must be 0 where there are two vehicles or no lanes"
    return _reference_problem(scenario)


def _roads_problem(scenario: Scenario) -> str:
    """What is wrong with a scenario on roads of segments; "" if nothing is."""
    if scenario.lanes or any(scenario.destination_span):
        return "lanes and destination_span have no effect on roads of segments; omit them"
    if not _is_count(scenario.number) or scenario.number < 1:
        return f"number = {scenario.number!r} must be a number of vehicles: 1, 2, ..."
    return lanes_problem(scenario.routes) or fit_problem(scenario) or _reference_problem(scenario)


def fit_problem(scenario: Scenario) -> str:
    """Why there is no room for the vehicles and cars of a scenario on roads of segments; "" if there is."""
    room = min(capacity(scenario.routes), MAX_VEHICLES)
    if scenario.vehicles + scenario.cars > room:
        cars = f" and cars = {scenario.cars}" if scenario.cars else ""
        return f"vehicles = {scenario.vehicles}{cars} are more than {scenario.title} holds: {room} together"
    return ""


def _reference_problem(scenario: Scenario) -> str:
    if any(shape_of(value) != () for value in scenario.reference.values()):
        return f"reference = {dict(scenario.reference)!r} must have a finite number per objective"
    return ""


def _is_count(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, int) and value >= 0


def _with_tuples(scenario: Scenario) -> Scenario:
    """The same scenario with nested tuples, which can be compared, instead of arrays and lists."""
    objectives, routes = tuple(scenario.objectives), tuple(map(as_tuples, scenario.routes))
    (x, y), (g_force, jerk, time) = (map(float, numbers) for numbers in (scenario.destination_span, scenario.spent))
    return replace(scenario, routes=routes, objectives=objectives, destination_span=(x, y), spent=(g_force, jerk, time))
