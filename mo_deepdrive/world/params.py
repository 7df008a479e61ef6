"""The record that the kernel reads, from a configuration and its scenario."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation import roads
from mo_deepdrive.simulation.state import (
    BRAKE_FRICTION,
    KERNEL_NAMES,
    MAP_CENTRE,
    MAX_OBJECTIVES,
    PARAMS,
    SPEED_FRICTION,
    VEHICLE,
    with_room,
)
from mo_deepdrive.simulation.traffic import MEAN_HEADWAY
from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES, signs
from mo_deepdrive.world.routes import JOINT, Route, entries, entry_room
from mo_deepdrive.world.scenarios import SCENARIOS, Scenario

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig

ORIGINAL_FREQUENCY = 60  # Hz; the frictions are per physics step at this frequency


def chosen_objectives(config: EnvConfig) -> tuple[str, ...]:
    """The objectives of an environment, in order; a ValueError if the scenario does not have one of them."""
    scenario = config.scenario_data
    if config.objectives is None:
        return scenario.objectives
    known = {
        *scenario.objectives,
        *(
            objective.name
            for objective in OBJECTIVES
            if objective.measure is not None
            and (scenario.others or not objective.needs_others)
            and (scenario.roads or not objective.needs_roads)
        ),
    }
    for name in config.objectives:
        if name not in known:
            raise ValueError(f"objectives has {name!r}, which {scenario.title} does not have; {nearest(name, known)}")
    return config.objectives


def reward_signs(config: EnvConfig) -> NDArray[np.float64]:
    """By what the magnitudes of the chosen objectives are multiplied, shape (d,)."""
    names = chosen_objectives(config)
    return signs(names) if config.cost_sign == "maximise" else np.ones(len(names))


def _has_effect(scenario: Scenario) -> dict[str, bool]:
    """Whether a setting that not every scenario has makes a difference in this one."""
    return {
        "fixed_destination": any(scenario.destination_span),
        "fixed_obstacle": scenario.obstacles > 0,
        "lane_margin": scenario.lanes or scenario.roads,
        "end_on_lane_violation": scenario.lanes or scenario.roads,
        "yield_to_oncoming": scenario.lanes and scenario.others,
        "end_together": scenario.vehicles > 1,
        "traffic": scenario.cars > 0 and not scenario.roads,
        "observed_cars": scenario.cars > 0 and not scenario.roads,
        "vehicles": scenario.roads and SCENARIOS[scenario.name].number > 1,
        "cars": scenario.roads,
    }


def cars_in_traffic(config: EnvConfig) -> int:
    """How many oncoming cars an episode has, unless a reset option says otherwise."""
    return 0 if config.traffic == "none" else config.scenario_data.cars


def vehicle_record(config: EnvConfig) -> np.dtype[Any]:
    """The record VEHICLE with the room that a configuration needs."""
    scenario = config.scenario_data
    return with_room(VEHICLE, scenario.obstacles, scenario.cars, config.action_delay)


def make_params(config: EnvConfig) -> np.ndarray:
    """The parameters of a configuration, shape (1,) of dtype PARAMS.

    A ValueError if a setting has no effect in the scenario, or there are too many objectives.
    """
    scenario = config.scenario_data
    settings = _has_effect(scenario)
    for name, effect in settings.items():
        if not effect and getattr(config, name) != type(config).model_fields[name].default:
            raise ValueError(f"{name} = {getattr(config, name)!r} has no effect in {scenario.title}; omit it")
    names = chosen_objectives(config)
    params = np.zeros(1, dtype=PARAMS)
    row = params[0]
    row.dt = 1.0 / config.simulation_frequency
    row.physics_steps = config.physics_steps
    friction_steps = ORIGINAL_FREQUENCY / config.simulation_frequency
    row.yaw_friction = config.yaw_friction**friction_steps
    row.speed_friction = SPEED_FRICTION**friction_steps
    row.log_brake_friction = math.log(BRAKE_FRICTION) * friction_steps
    row.max_decisions = config.max_decisions
    row.harmful_g_force = math.inf if config.harmful_g_force is None else config.harmful_g_force
    row.harmful_jerk = math.inf if config.harmful_jerk is None else config.harmful_jerk
    copied = ("constrain_controls", "ignore_brake", "charge_remaining_time", *settings)
    for name in (name for name in copied if name not in ("traffic", "vehicles", "cars")):
        row[name] = getattr(config, name)
    row.has_obstacle = scenario.obstacles > 0
    row.has_lanes = scenario.lanes or scenario.roads
    row.vehicles = scenario.vehicles
    row.conflict_time = scenario.conflict_time
    if len(names) > MAX_OBJECTIVES:
        raise ValueError(f"objectives has {len(names)} names; at most {MAX_OBJECTIVES} are allowed")
    kernel = [column for column, name in enumerate(names) if name in KERNEL_NAMES]
    columns = [*kernel, *(column for column in range(len(names)) if column not in kernel)]
    row.n_objectives = len(kernel)
    row.objective_index[: len(kernel)] = [INDEX[names[column]] for column in kernel]
    row.objective_column[: len(columns)] = columns
    row.objective_sign[: len(columns)] = reward_signs(config)[columns]
    if scenario.roads:
        _fill_roads(row, scenario)
    for v, route in enumerate(() if scenario.roads else scenario.routes):
        row.n_waypoints[v] = len(route.waypoints)
        row.starts[v] = route.start
        row.lane_centre[v] = route.start[0]
        row.start_span[v] = route.start_span
        row.waypoints[v, : len(route.waypoints)] = route.waypoints
    row.destination_span[:] = scenario.destination_span
    row.destination_draw = scenario.destination_draw
    row.spent_span[:] = scenario.spent
    row.spent_draw = scenario.spent_draw if any(scenario.spent) else 0
    row.map_centre = MAP_CENTRE
    row.n_cars = cars_in_traffic(config)
    row.mean_headway = MEAN_HEADWAY.get(config.traffic, MEAN_HEADWAY["default"])
    row.driver_draw = scenario.driver_draw
    return params


def _fill_roads(row: Any, scenario: Scenario) -> None:
    """Write the routes of segments and their entries into the record PARAMS."""
    row.yield_to_oncoming = False
    row.n_waypoints[:] = 2  # the two points of its route that a vehicle observes
    row.n_routes = len(scenario.routes)
    row.entry[: len(scenario.routes)] = entries(scenario.routes)
    row.n_entries = row.entry.max() + 1
    for r, route in enumerate(scenario.routes):
        row.n_segments[r] = len(route.segments)
        row.route_length[r] = route.length
        row.half_lane[r] = route.lane_width / 2
        row.priority[r] = (0.0, math.inf) if route.priority is None else route.priority
        along = 0.0
        for k, (segment, (x, y, heading)) in enumerate(zip(route.segments, route.joints(), strict=False)):
            half = abs(segment.curvature) * segment.length / 2
            row.segments[r, k] = (
                *(x, y, heading, math.cos(heading), math.sin(heading)),
                *(segment.length, segment.curvature, along, math.cos(half), math.sin(half)),
            )
            along += segment.length
        entry = row.entry[r]
        if row.n_routes_there[entry] == 0:
            row.first_route[entry] = r
            row.entry_room[entry] = entry_room(route)
            row.entry_span[entry] = route.start_span
            row.entry_length[entry] = route.segments[0].length
        row.n_routes_there[entry] += 1
    for r, route in enumerate(scenario.routes):
        for other in range(len(scenario.routes)):
            row.joins[r, other] = _where_it_joins(row, r, route, other)


def _where_it_joins(row: Any, r: int, route: Route, other: int) -> float:
    """How far along another lane (m) a lane joins it, at its first joint with right of way; NaN if it does not."""
    for k, (x, y, heading) in enumerate(route.joints()):
        if row.segments[r, k].along >= row.priority[r, 0] and 0 < k < len(route.segments):
            for segment in row.segments[other, : row.n_segments[other]]:
                along = roads.projection(segment, x, y)
                if abs(roads.offset(segment, x, y)) < JOINT[0] and -JOINT[0] <= along <= segment.length + JOINT[0]:
                    cos, sin = roads.direction(segment, x, y)
                    if abs(math.sin(heading) * cos - math.cos(heading) * sin) < JOINT[1]:
                        return float(segment.along + along)
    return math.nan
