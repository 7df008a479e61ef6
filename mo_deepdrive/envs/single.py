"""The Gymnasium environment with one vehicle."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ResetNeeded

from mo_deepdrive.envs.world import WorldEnv
from mo_deepdrive.world.config import parse_arguments
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from numpy.typing import NDArray


class DrivingEnv(WorldEnv):
    """A car that drives to a destination: alone, around a bicycle, or to the left across oncoming traffic.

    ## Description

    A car drives to a destination in the plane (OneWaypoint), around a bicycle on its way (StaticObstacle), or turns
    left at a crossing while up to five cars come one after another down the opposite lane (LeftTurn). In Roundabout
    solo it passes a roundabout among seven cars with scripted drivers; what differs there is described in
    :class:`mo_deepdrive.envs.turn_based.TurnBasedEnv`. Based on DeepDrive Zero and its multi-objective extension
    (Ajridi et al., "Deconstructing Reinforcement Learning Benchmarks: Revealing the Objectives", ECAI 2023). The car is
    a kinematic bicycle with friction, simulated at 60 Hz; the agent decides at 10 Hz.

    In LeftTurn the oncoming cars follow one another by the Intelligent Driver Model, straight on in their lane. If the
    agent is in their way, some of their drivers let it pass, and some hardly brake. Who is who cannot be seen: desired
    speed, headway and how hard a driver brakes for a left-turner are drawn for every car and episode. So a gap can be
    accepted (fast, risky, uncomfortable) or the next one awaited (slow, safe), and outcomes are uncertain.

    ## Spaces and ends

    Actions are ``Discrete(22)``, ``Discrete(16)`` or ``Box(-1, 1, (3,))``, by ``action_type``. Observations are a
    ``Box`` of float32 in SI units: 15 numbers, 19 in StaticObstacle and LeftTurn, 63 in Roundabout solo. Rewards are a
    ``Box`` of float32 with a number per objective, every one to be maximised. ``docs/environments`` says what each
    number is, which reset options and arguments (fields of :class:`~mo_deepdrive.world.config.EnvConfig`) there are,
    and why episodes end: ``info["end"]`` says why this one did, and ``info["success"]`` whether the car arrived.

    ## Version History

    - v1: v0 with ``time`` as the last objective and ``charge_remaining_time=True``, so that ending early saves no time;
      LeftTurn with ``yield_to_oncoming=False``, so that distance is what was driven.
    - v0: initial release. ``docs/simulator.md`` lists the departures from the published code.

    The version is raised by every change of what an agent experiences: dynamics, rewards, observations, spaces and
    termination. Changes of speed, rendering and documentation keep it.
    """

    def __init__(self, scenario: str, render_mode: str | None = None, **options: Any):
        config = parse_arguments(scenario, options)
        if (vehicles := config.scenario_data.vehicles) > 1:
            raise ValueError(
                f"scenario = {scenario!r} has {vehicles} vehicles; use gymnasium.make({SCENARIOS[scenario].id!r}), "
                "where they take turns, its make_vec, or mo_deepdrive.parallel_env()"
            )
        super().__init__(config, render_mode)
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode; ``options`` set parts of the scenario."""
        self._start(seed, options)
        self._running = True
        return self.batch.observations[0, 0].copy(), {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], bool, bool, dict[str, Any]]:
        """Drive for one decision: observation (size,), vector reward (d,), terminated, truncated, info.

        ResetNeeded before the first reset and after the end of an episode; a ValueError for an action outside the
        action space, where the state is unchanged.
        """
        if not self._running:
            raise ResetNeeded("step() before reset() or after the end of an episode")
        array = np.asarray(action)
        if array.shape != self.action_space.shape:
            raise ValueError(f"action {action!r} has shape {array.shape}; expected {self.action_space.shape}")
        self.move(array[None, None])
        batch = self.batch
        terminated, truncated = bool(batch.terminated[0, 0]), bool(batch.truncated[0, 0])
        info: dict[str, Any] = {}
        if terminated or truncated:
            self._running = False
            info = self.end_info(0)
        return batch.observations[0, 0].copy(), batch.rewards[0, 0].copy(), terminated, truncated, info
