"""Drives as the simulator reports them: the pose, speed, g-force and jerk of every vehicle after every decision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.env_adapter import EnvAdapter, is_drivable, make_env
from mo_deepdrive.evaluation.episodes import as_policy
from mo_deepdrive.evaluation.policy import drive
from mo_deepdrive.simulation.state import ENDS, MAP_CENTRE, MAP_SIZE
from mo_deepdrive.world.action_sequences import idle

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import Policy, PolicyFunction
    from mo_deepdrive.world.routes import Route

READINGS = ("x", "y", "heading", "speed", "g_force", "jerk")  # fields of the state: m, m, rad, m/s, g, m/s^3
POSE = READINGS[:3]


class Playback:
    """A function as a policy that replays a sequence of actions in each of parallel environments, and idles after it.

    Args:
        sequences: of environment actions, of all vehicles, one per episode, in their order; or one for all.
        action_type: "discrete", "discrete-16" or "continuous".
    """

    def __init__(self, sequences: Sequence[NDArray[Any]], action_type: str):
        longest = max(map(len, sequences)) + 1  # at least one idle action
        nothing = idle(action_type)
        shape = sequences[0].shape[1:] or nothing.shape
        self._actions = np.broadcast_to(nothing, (longest, len(sequences), *shape)).copy()
        for row, sequence in enumerate(sequences):
            self._actions[: len(sequence), row] = sequence
        self._decisions = 0

    def __call__(self, observations: NDArray[Any], accrued: NDArray[Any], discounts: NDArray[Any]) -> NDArray[Any]:
        """Actions (N,) or (N, k), or (N, V, ...); an episode begins where nothing has been discounted yet."""
        self._decisions = 0 if (discounts == 1.0).all() and not accrued.any() else self._decisions + 1
        actions: NDArray[Any] = self._actions[min(self._decisions, len(self._actions) - 1)]
        if len(actions) == 1:
            return np.repeat(actions, len(observations), axis=0)
        return actions[np.minimum(np.arange(len(observations)), len(actions) - 1)]


@dataclass(frozen=True)
class Drive:
    """One episode of V vehicles, the longest of which takes T decisions."""

    #: (T + 1, V, 6) :data:`READINGS` at the start and after every decision; NaN once a vehicle has ended.
    readings: NDArray[np.float64]
    #: (T + 1, C, 3) :data:`POSE` of the cars with scripted drivers; NaN while a car is absent.
    cars: NDArray[np.float64]
    ends: tuple[str, ...]  #: V reasons, each one of :data:`mo_deepdrive.simulation.state.ENDS`


@dataclass(frozen=True)
class Road:
    """A lane of segments."""

    line: NDArray[np.float64]  #: (P, 2) points of its middle (m)
    width: float  #: of the lane (m)
    #: (2, 2) the ends (m) of the line before which those wait who have no right of way; (0, 2) if none.
    give_way: NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """What is drawn for the seed of a scenario, and K drives in it."""

    seed: int  #: of the scenario
    routes: tuple[NDArray[np.float64], ...]  #: V times (W, 2), the waypoints (m) of a vehicle, or the end of its road
    obstacles: NDArray[np.float64]  #: (B, 2, 2) the two ends (m) of every obstacle
    lanes: bool  #: whether two roads cross in the middle
    roads: tuple[Road, ...]  #: the lanes of a scenario whose roads are data
    decision_frequency: int  #: decisions per second
    drives: tuple[Drive, ...]  #: K drives

    def box(self, margin: float) -> tuple[float, float, float]:
        """The least x, the least y and the side (m) of a square that shows everything with ``margin`` m around it.

        Of oncoming cars it shows where they are on the map.
        """
        cars = self.lanes and any(drive.cars.shape[1] for drive in self.drives)
        driven = (drive.readings[..., :2].reshape(-1, 2) for drive in self.drives)
        parts = [*self.routes, self.obstacles.reshape(-1, 2), *(road.line for road in self.roads)]
        parts += [points[np.isfinite(points[:, 0])] for points in driven]
        if cars:
            parts.append(MAP_CENTRE + np.array([[-0.5, -0.5], [0.5, 0.5]]) * (MAP_SIZE - 2 * margin))
        points = np.concatenate(parts)
        low, high = points.min(axis=0), points.max(axis=0)
        side = float((high - low).max()) + 2 * margin
        left, bottom = ((low + high - side) / 2).tolist()
        return left, bottom, side


def record_scenes(
    policy: Policy | PolicyFunction, env_id: str, env_arguments: Mapping[str, Any], *, seeds: Sequence[int], drives: int
) -> list[Scene]:
    """Record one episode of each of K = ``drives`` drivers in each of the S scenarios of the ``seeds``.

    The policy acts in S K environments, those of the first scenario first. An environment that is not one of this
    package is a ValueError.
    """
    if not is_drivable(env_id):
        raise ValueError(f"drives in {env_id!r} cannot be recorded: it is not a driving scenario")
    count = len(seeds) * drives
    env: Any = make_env(env_id, count, dict(env_arguments), keep_ended=True)
    try:
        adapter, inner = EnvAdapter(env, keep_ended=True), env.unwrapped
        state, shape = inner.batch.state, (count, adapter.vehicles)
        last, ends = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
        actor = as_policy(policy, adapter)
        observations = adapter.reset([seed for seed in seeds for _ in range(drives)])
        places = state[::drives].copy()
        readings, cars = [_stacked(state, READINGS)], [_cars(state)]
        for decision in drive(actor, adapter, observations):
            readings.append(np.where((last == 0)[..., None], _stacked(state, READINGS), np.nan))
            cars.append(_cars(state))
            over = (last == 0) & ~decision.running
            last[over] = len(readings) - 1
            ends[over] = state["end"][over]
        scenario = inner.batch.scenario
        frequency = inner.config.decision_frequency
    finally:
        env.close()
    recorded = [
        Drive(
            np.stack([frame[row] for frame in readings[: longest + 1]]),
            np.stack([frame[row] for frame in cars[: longest + 1]]),
            tuple(ENDS[end] for end in ends[row]),
        )
        for row, longest in enumerate(last.max(axis=1))
    ]
    roads = tuple(map(road, scenario.routes)) if scenario.roads else ()
    return [
        Scene(
            seed=seed,
            routes=tuple(
                roads[vehicle["route"]].line[-1:] if roads else vehicle["waypoints"][: vehicle["n_waypoints"]].copy()
                for vehicle in place
            ),
            obstacles=place[0]["obstacle"].reshape(-1, 2, 2)[: scenario.obstacles].copy(),
            lanes=scenario.lanes,
            roads=roads,
            decision_frequency=frequency,
            drives=tuple(recorded[s * drives : (s + 1) * drives]),
        )
        for s, (seed, place) in enumerate(zip(seeds, places, strict=True))
    ]


def road(route: Route) -> Road:
    """The lane of a route of segments."""
    give_way = np.zeros((0, 2))
    if route.priority is not None and route.priority[0] > 0.0:
        x, y, heading = route.traced(route.priority[0], 0.1)[0]
        side = np.array([np.cos(heading), np.sin(heading)]) * route.lane_width / 2
        give_way = np.array([x, y]) + np.stack([-side, side])
    return Road(np.array(route.traced())[:, :2], route.lane_width, give_way)


def _stacked(records: NDArray[Any], names: Sequence[str]) -> NDArray[np.float64]:
    return np.stack([records[name] for name in names], axis=-1)


def _cars(state: NDArray[Any]) -> NDArray[np.float64]:
    cars = state[:, 0]["cars"]
    heading = np.arctan2(cars["sin_heading"], cars["cos_heading"])
    return np.where(cars["present"][..., None], np.stack([cars["x"], cars["y"], heading], axis=-1), np.nan)
