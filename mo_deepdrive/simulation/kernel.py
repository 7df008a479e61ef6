"""The kernel: move worlds by one decision, and write observations, rewards and flags.

Every buffer belongs to the caller and has the shape (worlds, vehicles, ...). The kernel allocates nothing, draws no
random numbers, reads no global state and never resets a world by itself; :mod:`.autoreset` does. A single world and a
row of a batch run through the same code, and so can the worlds of a CUDA kernel.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from mo_deepdrive.simulation import observation, progress, road_traffic, roads, traffic
from mo_deepdrive.simulation.actions import decode
from mo_deepdrive.simulation.collision import find_collisions
from mo_deepdrive.simulation.dynamics import drive
from mo_deepdrive.simulation.jit import jit, separate_jit
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
    LANES,
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

    Measures = tuple[Any, ...]

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
def judge(worlds: Records, i: int, params: Record, on_roads: bool) -> None:
    """Measure the objectives of the running vehicles of world ``i`` after they have moved, and end their episodes.

    Args:
        worlds: (worlds, vehicles) of VEHICLE, changed in place; vehicles that have ended stay as they are. Collisions
            have been found.
        i: which world. (Arrays are passed whole: a view costs an atomic reference count.)
        params: record of dtype PARAMS.
        on_roads: whether routes are of segments. A constant: where it is False, nothing here is a call, which would
            take the registers of everything around it.
    """
    vehicles = worlds.shape[1]
    for v in range(vehicles):
        for k in range(len(worlds[i, v].objectives)):
            if k != CRASH:
                worlds[i, v].objectives[k] = 0.0

    # Everything that depends on the positions of several vehicles is computed before any of them can end.
    for v in range(vehicles):
        vehicle = worlds[i, v]
        if vehicle.end == RUNNING:
            before = vehicle.route_distance
            arrived = roads.follow(vehicle, params) if on_roads else progress.follow(vehicle)
            vehicle.objectives[DISTANCE] = vehicle.route_distance - before
            vehicle.objectives[DESTINATION] = 1.0 if arrived else 0.0
            if on_roads:
                roads.find_lane(vehicle, params)
            elif params.has_lanes:
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
            if vehicle.decisions == 1:
                vehicle.objectives[G_FORCE] += vehicle.spent[0]
                vehicle.objectives[JERK] += vehicle.spent[1]
        ended = ended or vehicle.end != RUNNING
    if params.end_together and ended:
        for v in range(vehicles):
            if worlds[i, v].end == RUNNING:
                worlds[i, v].end = OTHER_VEHICLE


@separate_jit
def judge_on_roads(worlds: Records, i: int, params: Record) -> None:
    """As :func:`judge`, on roads of segments."""
    judge(worlds, i, params, True)


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
    if params.has_obstacle or worlds.shape[1] > 1 or len(worlds[first, 0].cars) > 0:
        for i in range(first, last):
            find_collisions(worlds, i, CRASH, params, path, i - first)
    if params.n_routes > 0:
        for i in range(first, last):
            judge_on_roads(worlds, i, params)
    else:
        for i in range(first, last):
            judge(worlds, i, params, False)


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
def write_nothing(
    worlds: Records, i: int, v: int, params: Records, acted: NDArray[np.bool_], k: int, rewards: NDArray[np.float32]
) -> None:
    """Measure no further objective."""


def _measuring(measures: Measures) -> Any:
    """What writes the rewards of vehicle ``v`` of world ``i`` from the ``k``-th objective of PARAMS on by ``measures``.

    A chain of functions, because compiled code cannot index functions.
    """
    if not measures:
        return write_nothing
    measure, write_rest = measures[0], _measuring(measures[1:])

    @jit
    def write_measured(
        worlds: Records, i: int, v: int, params: Records, acted: NDArray[np.bool_], k: int, rewards: NDArray[np.float32]
    ) -> None:
        sign = params[0].objective_sign[k]
        rewards[i, v, params[0].objective_column[k]] = (
            sign * measure(worlds, i, v, params[0]) + 0.0 if acted[i, v] else 0.0
        )
        write_rest(worlds, i, v, params, acted, k + 1, rewards)

    return write_measured


@functools.cache
def rewarding(measures: Measures) -> Any:
    """The function that writes the rewards of a world.

    Args:
        measures: of the objectives that have a measure of their own, in the order of the rewards: compiled functions of
            (worlds, i, v, params) that return the magnitude for vehicle ``v`` of world ``i``.

    Returns:
        ``write_rewards(worlds, i, params, acted, rewards)``, compiled; see :func:`deciding` for the arguments.
    """
    write_measured = _measuring(measures)

    @jit
    def write_rewards(
        worlds: Records, i: int, params: Records, acted: NDArray[np.bool_], rewards: NDArray[np.float32]
    ) -> None:
        for v in range(worlds.shape[1]):
            for k in range(params[0].n_objectives):
                # Adding zero turns a cost of -0.0 into 0.0.
                rewards[i, v, params[0].objective_column[k]] = (
                    params[0].objective_sign[k] * worlds[i, v].objectives[params[0].objective_index[k]] + 0.0
                )
            write_measured(worlds, i, v, params, acted, params[0].n_objectives, rewards)

    return write_rewards


@functools.cache
def deciding(measures: Measures) -> Any:
    """The function that moves worlds by one decision.

    A thread of a device calls it with one world, a CPU with a block of them. It is a closure over the measures because
    compiled code takes no functions as arguments.

    Args:
        measures: as of :func:`rewarding`.

    Returns:
        ``decide(worlds, first, last, actions, ..., truncated)``, compiled.
    """
    write_rewards = rewarding(measures)

    @jit
    def decide(
        worlds: Records,
        first: int,
        last: int,
        actions: NDArray[Any],
        table: NDArray[np.float64],
        params: Records,
        controls: NDArray[np.float64],
        motion: Records,
        cars: Records,
        path: Records,
        sight: Records,
        observations: NDArray[np.float32],
        rewards: NDArray[np.float32],
        acted: NDArray[np.bool_],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
    ) -> None:
        """Move the worlds ``first`` to ``last`` - 1, at most LANES, by one decision.

        Args:
            worlds: (worlds, vehicles) of VEHICLE, changed in place.
            first: the first world.
            last: the world after the last one.
            actions: as of :func:`mo_deepdrive.simulation.actions.decode`; so is table.
            table: (actions, 4).
            params: (1,) of PARAMS. (Records enter as arrays: unpacking a bare one costs several microseconds.)
            controls: (worlds, vehicles, 3), scratch.
            motion: (1,) of MOTION, scratch.
            cars: (cars,) of TRAFFIC, scratch.
            path: (vehicles + cars, physics_steps + 1) of POSE, scratch.
            sight: (1,) of SIGHT, scratch.
            observations: (worlds, vehicles, size) float32, written.
            rewards: (worlds, vehicles, objectives) float32, written; zero for vehicles that had ended before.
            acted: (worlds, vehicles) bool, written: whether the vehicle was on the road before.
            terminated: (worlds, vehicles) bool, written; stays True until the world is placed again.
            truncated: likewise.
        """
        for i in range(first, last):
            for v in range(worlds.shape[1]):
                acted[i, v] = worlds[i, v].end == RUNNING
                decode(worlds, i, v, actions, table, controls)
        step_worlds(worlds, first, last, controls, params[0], motion, cars, path)
        observe_worlds(worlds, first, last, params[0], sight, observations, terminated, truncated)
        for i in range(first, last):
            write_rewards(worlds, i, params, acted, rewards)

    return decide


@functools.cache
def batch_step(measures: Measures) -> Any:
    """The function ``step(worlds, actions, ..., truncated)`` that does what :func:`deciding` says for all worlds."""
    decide = deciding(measures)

    @jit
    def step(
        worlds: Records,
        actions: NDArray[Any],
        table: NDArray[np.float64],
        params: Records,
        controls: NDArray[np.float64],
        motion: Records,
        cars: Records,
        path: Records,
        sight: Records,
        observations: NDArray[np.float32],
        rewards: NDArray[np.float32],
        acted: NDArray[np.bool_],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
    ) -> None:
        for first in range(0, worlds.shape[0], LANES):
            decide(
                worlds, first, min(first + LANES, worlds.shape[0]), actions, table, params, controls, motion, cars,
                path, sight, observations, rewards, acted, terminated, truncated,
            )  # fmt: skip

    return step


@functools.cache
def batch_rewards(measures: Measures) -> Any:
    """The function ``write(worlds, params, acted, rewards)`` that does what :func:`rewarding` says for all worlds."""
    write_rewards = rewarding(measures)

    @jit
    def write(worlds: Records, params: Records, acted: NDArray[np.bool_], rewards: NDArray[np.float32]) -> None:
        for i in range(worlds.shape[0]):
            write_rewards(worlds, i, params, acted, rewards)

    return write
