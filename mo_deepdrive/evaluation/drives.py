"""Drives as the simulator reports them: the pose, speed, g-force and jerk of a vehicle after every decision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from mo_deepdrive.envs.vector import DrivingVectorEnv
from mo_deepdrive.evaluation.accrued_reward import AccruedReward
from mo_deepdrive.evaluation.env_adapter import find_spec
from mo_deepdrive.scenarios import SCENARIOS
from mo_deepdrive.simulation.map import MAP_CENTRE, MAP_SIZE
from mo_deepdrive.simulation.state import ENDS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import Policy

READINGS = ("x", "y", "heading", "speed", "g_force", "jerk")  # fields of the state: m, m, rad, m/s, g, m/s^3


class BatchDriver(Protocol):
    """Acts for the vehicles of N environments, one in each."""

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Actions (N,) or (N, k), as the environment takes them, for observations (N, o)."""

    def observe(self, rewards: NDArray[np.float32]) -> None:
        """Receive the rewards (N, d) of a decision."""


class PoliciesDriver:
    """Greedy policies as a :class:`BatchDriver`.

    Args:
        policy: acts in N environments, perhaps as another policy in each.
        num_envs: N.
    """

    def __init__(self, policy: Policy, num_envs: int):
        self._policy = policy
        self._accrued_reward = AccruedReward.begin(num_envs, 1, len(policy.env.objectives))

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """As of :class:`BatchDriver`."""
        actions = self._policy.act(observations[:, None], self._accrued_reward, None)
        return self._policy.env.environment_actions(actions)

    def observe(self, rewards: NDArray[np.float32]) -> None:
        """As of :class:`BatchDriver`."""
        self._accrued_reward.add(rewards[:, None], self._policy.gamma)


class PlanDriver:
    """Sequences of actions as a :class:`BatchDriver`; after its last action a vehicle is idle.

    Args:
        plans: N sequences, as :func:`mo_deepdrive.action_sequences.decode` returns them.
        idle: the action that does nothing.
    """

    def __init__(self, plans: Sequence[NDArray[Any]], idle: NDArray[Any]):
        self._plans = plans
        self._idle = idle
        self._decision = 0

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """As of :class:`BatchDriver`."""
        del observations
        now = self._decision
        return np.stack([plan[now] if now < len(plan) else self._idle for plan in self._plans])

    def observe(self, rewards: NDArray[np.float32]) -> None:
        """As of :class:`BatchDriver`."""
        del rewards
        self._decision += 1


@dataclass(frozen=True)
class Drive:
    """One episode of one vehicle with T decisions.

    Attributes:
        readings: (T + 1, 6) :data:`READINGS` at the start and after every decision.
        cars: (T + 1, C, 2) centres (m) of the oncoming cars; NaN while a car is absent.
        end: why the episode ended, one of :data:`mo_deepdrive.simulation.state.ENDS`.
    """

    readings: NDArray[np.float64]
    cars: NDArray[np.float64]
    end: str


@dataclass(frozen=True)
class Scene:
    """What is drawn for the seed of a scenario, and K drives in it.

    Attributes:
        seed: of the scenario.
        route: (W, 2) waypoints (m).
        obstacles: (B, 2, 2) the two ends (m) of every obstacle.
        lanes: whether there are roads.
        decision_frequency: decisions per second.
        drives: K drives.
    """

    seed: int
    route: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    lanes: bool
    decision_frequency: int
    drives: tuple[Drive, ...]

    def box(self, margin: float) -> tuple[float, float, float]:
        """The least x, the least y and the side (m) of a square that shows everything with ``margin`` m around it.

        Of oncoming cars it shows where they are on the map.
        """
        cars = any(drive.cars.shape[1] for drive in self.drives)
        corners = MAP_CENTRE + np.array([[-0.5, -0.5], [0.5, 0.5]]) * (MAP_SIZE - 2 * margin)
        points = np.concatenate(
            [
                self.route,
                self.obstacles.reshape(-1, 2),
                *(drive.readings[:, :2] for drive in self.drives),
                corners if cars else np.zeros((0, 2)),
            ]
        )
        low, high = points.min(axis=0), points.max(axis=0)
        side = float((high - low).max()) + 2 * margin
        left, bottom = ((low + high - side) / 2).tolist()
        return left, bottom, side


def is_drivable(env_id: str) -> bool:
    """Whether an environment is one of this package with one vehicle and waypoints, whose drives can be recorded."""
    spec = find_spec(env_id)
    ours = str(spec.vector_entry_point).startswith("mo_deepdrive.")
    scenario = SCENARIOS[spec.kwargs["scenario"]] if ours else None
    return scenario is not None and scenario.vehicles == 1 and not scenario.roads


def record_scenes(
    driver: BatchDriver, env_id: str, env_arguments: Mapping[str, Any], *, seeds: Sequence[int], drives: int
) -> list[Scene]:
    """Record one episode of each of K drivers in each of S scenarios.

    Args:
        driver: acts in N = S K environments: those of the first scenario first.
        env_id: of an environment of this package with one vehicle.
        env_arguments: its keyword arguments.
        seeds: of the S scenarios.
        drives: K.

    Returns:
        S scenes.

    Raises:
        ValueError: if the environment is not one of this package with one vehicle.
    """
    count = len(seeds) * drives
    env: Any = gymnasium.make_vec(env_id, num_envs=count, autoreset_mode=AutoresetMode.NEXT_STEP, **env_arguments)
    try:
        inner = env.unwrapped
        if not isinstance(inner, DrivingVectorEnv) or inner.vehicles != 1:
            raise ValueError(f"drives in {env_id!r} cannot be recorded: it is not a driving scenario with one vehicle")
        observations, _ = env.reset(seed=[seed for seed in seeds for _ in range(drives)])
        state = inner.batch.state[:, 0]
        places = state[::drives].copy()
        readings, cars = [_readings(state)], [_cars(state)]
        last = np.zeros(count, dtype=np.int64)
        ends = np.zeros(count, dtype=np.int64)
        while (last == 0).any():  # a world whose episode is over begins another one, which is not kept
            observations, rewards, terminated, truncated, _ = env.step(driver.act(observations))
            driver.observe(rewards)
            readings.append(_readings(state))
            cars.append(_cars(state))
            over = (last == 0) & (terminated | truncated)
            last[over] = len(readings) - 1
            ends[over] = state["end"][over]
        scenario = inner.batch.scenario
        frequency = inner.config.decision_frequency
    finally:
        env.close()
    recorded = [
        Drive(
            np.stack([frame[row] for frame in readings[: last[row] + 1]]),
            np.stack([frame[row] for frame in cars[: last[row] + 1]]),
            ENDS[ends[row]],
        )
        for row in range(count)
    ]
    return [
        Scene(
            seed=seed,
            route=place["waypoints"][: place["n_waypoints"]].copy(),
            obstacles=place["obstacle"].reshape(-1, 2, 2)[: scenario.obstacles].copy(),
            lanes=scenario.lanes,
            decision_frequency=frequency,
            drives=tuple(recorded[s * drives : (s + 1) * drives]),
        )
        for s, (seed, place) in enumerate(zip(seeds, places, strict=True))
    ]


def _readings(state: NDArray[Any]) -> NDArray[np.float64]:
    return np.stack([state[name] for name in READINGS], axis=1)


def _cars(state: NDArray[Any]) -> NDArray[np.float64]:
    centres = np.stack([state["cars"]["x"], state["cars"]["y"]], axis=-1)
    return np.where(state["cars"]["present"][..., None], centres, np.nan)
