"""The kernel: place worlds, and move a batch of worlds by one decision.

Every buffer belongs to the caller and has the shape (worlds, vehicles, ...). The kernel allocates nothing, draws no
random numbers, reads no global state and never resets a world by itself. A single world and a row of a batch run
through the same code.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mo_deepdrive.simulation import observation, progress, road_traffic, traffic
from mo_deepdrive.simulation.collision import find_collisions
from mo_deepdrive.simulation.dynamics import drive
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.lanes import LANES
from mo_deepdrive.simulation.placing import draw_spawn, place, spawn_is_fair
from mo_deepdrive.simulation.state import (
    ARRIVED,
    BACKWARDS,
    BACKWARDS_LIMIT,
    CIRCLING,
    CIRCLING_LIMIT,
    COLLISION,
    HARMFUL_G_FORCE,
    HARMFUL_JERK,
    KERNEL_NAMES,
    LANE_TOLERANCE,
    OFF_LANE,
    OTHER_VEHICLE,
    RUNNING,
    SKIPPED_WAYPOINT,
    TIME_LIMIT,
    Record,
    Records,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Indices of the objectives within vehicle.objectives.
DISTANCE, DESTINATION, G_FORCE, CRASH, JERK, LANE_VIOLATION = range(len(KERNEL_NAMES))


@jit
def lane_excess(vehicle: Record, params: Record) -> float:
    """Metres outside the lane: max(0, margin - left) + max(0, margin - right)."""
    margin = params.lane_margin
    excess: float = max(0.0, margin - vehicle.left_lane_distance) + max(0.0, margin - vehicle.right_lane_distance)
    return excess


@jit
def ending(vehicle: Record, collided: bool, arrived: bool, params: Record) -> int:
    """Why the vehicle's episode ends after this decision (RUNNING if it does not), by precedence."""
    if collided:
        return COLLISION
    if vehicle.g_force > params.harmful_g_force:
        return HARMFUL_G_FORCE
    if vehicle.jerk > params.harmful_jerk:
        return HARMFUL_JERK
    if params.end_on_lane_violation and min(vehicle.left_lane_distance, vehicle.right_lane_distance) < -LANE_TOLERANCE:
        return OFF_LANE
    if params.n_routes > 0 and abs(vehicle.lane_offset) > 2 * params.half_lane[vehicle.route]:
        return OFF_LANE
    if abs(vehicle.heading - vehicle.start_heading) > CIRCLING_LIMIT:
        return CIRCLING
    if params.n_routes == 0 and vehicle.n_waypoints > 1 and progress.skipped(vehicle):
        return SKIPPED_WAYPOINT
    if vehicle.route_distance < vehicle.furthest - BACKWARDS_LIMIT:
        return BACKWARDS
    if arrived:
        return ARRIVED
    if vehicle.decisions >= params.max_decisions:
        return TIME_LIMIT
    return RUNNING


@jit
def judge(worlds: Records, i: int, params: Record, path: Records, lane: int) -> None:
    """Measure the objectives of the running vehicles of world ``i`` after they have moved, and end their episodes.

    Args:
        worlds: (worlds, vehicles) of VEHICLE, changed in place; vehicles that have ended stay as they are.
        i: which world. (Arrays are passed whole: a view costs an atomic reference count.)
        params: record of dtype PARAMS.
        path: (vehicles + cars, physics_steps + 1) of POSE, from ``drive`` and ``traffic.drive``.
        lane: of the world in ``path``.
    """
    vehicles = worlds.shape[1]
    for v in range(vehicles):
        for k in range(len(worlds[i, v].objectives)):
            worlds[i, v].objectives[k] = 0.0
    find_collisions(worlds, i, CRASH, params, path, lane)

    # Everything that depends on the positions of several vehicles is computed before any of them can end.
    for v in range(vehicles):
        vehicle = worlds[i, v]
        if vehicle.end == RUNNING:
            before = vehicle.route_distance
            arrived = progress.follow(vehicle, params)
            vehicle.objectives[DISTANCE] = vehicle.route_distance - before
            vehicle.objectives[DESTINATION] = 1.0 if arrived else 0.0
            if params.has_lanes:
                progress.find_lane(vehicle, params)
        else:
            vehicle.approaching = False
    meets = vehicles > 1 and worlds[i, 1].approaching
    if params.yield_to_oncoming and worlds[i, 0].crossing and (meets or traffic.approaching(worlds[i, 0])):
        worlds[i, 0].objectives[DISTANCE] = -abs(worlds[i, 0].objectives[DISTANCE])

    ended = False
    for v in range(vehicles):
        vehicle = worlds[i, v]
        if vehicle.end == RUNNING:
            vehicle.decisions += 1
            vehicle.objectives[G_FORCE] = vehicle.g_force
            vehicle.objectives[JERK] = vehicle.jerk
            if params.has_lanes:
                vehicle.objectives[LANE_VIOLATION] = lane_excess(vehicle, params)
            collided = vehicle.objectives[CRASH] == 1.0
            arrived = vehicle.objectives[DESTINATION] == 1.0
            vehicle.end = ending(vehicle, collided, arrived, params)
            if vehicle.end != ARRIVED:
                vehicle.objectives[DESTINATION] = 0.0
            vehicle.furthest = max(vehicle.furthest, vehicle.route_distance)
        ended = ended or vehicle.end != RUNNING
    if params.end_together and ended:
        for v in range(vehicles):
            if worlds[i, v].end == RUNNING:
                worlds[i, v].end = OTHER_VEHICLE


@jit
def step_worlds(
    worlds: Records,
    first: int,
    last: int,
    controls: NDArray[np.float64],
    params: Record,
    motion: Records,
    cars: Records,
    path: Records,
) -> None:
    """Move the running vehicles of the worlds ``first`` to ``last`` - 1 by one decision and measure their objectives.

    Args:
        worlds: (worlds, vehicles) of VEHICLE, changed in place; vehicles that have ended stay as they are.
        first: the first world.
        last: the world after the last one, at most ``first`` + LANES.
        controls: (worlds, vehicles, 3) target steer (rad), throttle (m/s^2) and brake.
        params: record of dtype PARAMS.
        motion: (1,) of MOTION, scratch.
        cars: (cars,) of TRAFFIC, scratch.
        path: (vehicles + cars, physics_steps + 1) of POSE, scratch.
    """
    if params.n_routes > 0:
        for i in range(first, last):
            road_traffic.drive(worlds, i, i - first, params, path)
    for v in range(worlds.shape[1]):
        drive(worlds, first, last, v, controls, params, motion, path)
    if len(worlds[first, 0].cars) > 0 and params.n_routes == 0:
        traffic.drive(worlds, first, last, params, cars, path)
    for i in range(first, last):
        judge(worlds, i, params, path, i - first)


@jit
def observe_worlds(
    worlds: Records, first: int, last: int, params: Record, sight: Records,
    observations: NDArray[np.float32], terminated: NDArray[np.bool_], truncated: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Write what the vehicles of the worlds ``first`` to ``last`` - 1 observe and whether they have ended."""
    for v in range(worlds.shape[1]):
        observation.write(worlds, first, last, v, params, sight, observations)
        for i in range(first, last):
            end = worlds[i, v].end
            terminated[i, v] = end != RUNNING and end != TIME_LIMIT
            truncated[i, v] = end == TIME_LIMIT


@jit
def observe_batch(
    worlds: Records,
    params: Records,
    sight: Records,
    observations: NDArray[np.float32],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
) -> None:
    """Write what all vehicles of all worlds observe, from the state alone."""
    for first in range(0, worlds.shape[0], LANES):
        last = min(first + LANES, worlds.shape[0])
        observe_worlds(worlds, first, last, params[0], sight, observations, terminated, truncated)


@jit
def step_batch(
    worlds: Records,
    controls: NDArray[np.float64],
    params: Records,
    motion: Records,
    cars: Records,
    path: Records,
    sight: Records,
    observations: NDArray[np.float32],
    rewards: NDArray[np.float32],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
) -> None:
    """Move a batch of worlds by one decision.

    Args:
        worlds: (worlds, vehicles) of VEHICLE, changed in place.
        controls: (worlds, vehicles, 3) target controls, from actions.decode_*.
        params: (1,) of PARAMS. (Records enter as arrays: unpacking a bare one costs several microseconds.)
        motion: (1,) of MOTION, scratch.
        cars: (cars,) of TRAFFIC, scratch.
        path: (vehicles + cars, physics_steps + 1) of POSE, scratch.
        sight: (1,) of SIGHT, scratch.
        observations: (worlds, vehicles, size) float32, written.
        rewards: (worlds, vehicles, objectives) float32, written but for the columns of objectives that the kernel
            does not measure; zero for vehicles that had ended before.
        terminated: (worlds, vehicles) bool, written; stays True until the world is placed again.
        truncated: likewise.
    """
    for first in range(0, worlds.shape[0], LANES):
        last = min(first + LANES, worlds.shape[0])
        step_worlds(worlds, first, last, controls, params[0], motion, cars, path)
        observe_worlds(worlds, first, last, params[0], sight, observations, terminated, truncated)
        for i in range(first, last):
            for v in range(worlds.shape[1]):
                for k in range(params[0].n_objectives):
                    # Adding zero turns a cost of -0.0 into 0.0.
                    rewards[i, v, params[0].objective_column[k]] = (
                        params[0].objective_sign[k] * worlds[i, v].objectives[params[0].objective_index[k]] + 0.0
                    )


@jit
def reset_batch(
    worlds: Records,
    rows: NDArray[np.int64],
    draws: NDArray[np.float64],
    pins: Records,
    params: Records,
    spawn: Records,
    fair: NDArray[np.bool_],
    sight: Records,
    observations: NDArray[np.float32],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
) -> None:
    """Start new episodes in the worlds ``rows``.

    Args:
        worlds: (worlds, vehicles) of VEHICLE.
        rows: (k,) indices of the worlds to place.
        draws: (k, draws) uniforms in [0, 1).
        pins: (1,) of SPAWN; entries that are not NaN replace what would be drawn.
        params: (1,) of PARAMS.
        spawn: (1,) of SPAWN, scratch.
        fair: (k,) bool, written; False where the draw is not a valid scenario. Such a world is unchanged and must be
            drawn again.
        sight: (1,) of SIGHT, scratch.
        observations: as in step_batch, written for the worlds placed.
        terminated: likewise.
        truncated: likewise.
    """
    for j in range(len(rows)):
        i = rows[j]
        draw_spawn(draws, j, params[0], pins[0], spawn[0])
        fair[j] = spawn_is_fair(spawn[0], params[0])
        if fair[j]:
            place(worlds, i, spawn[0], params[0])
            observe_worlds(worlds, i, i + 1, params[0], sight, observations, terminated, truncated)
