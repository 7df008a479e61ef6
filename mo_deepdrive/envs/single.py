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

    ## Action Space

    - ``action_type="discrete"`` (default): ``Discrete(22)``. 0 is idle; action 1 + 3 g + c steers by group g (decay,
      small left, small right, micro left, micro right, large left, large right) and changes the speed by c (maintain,
      decrease, increase). ``mo_deepdrive.world.actions.action_names`` lists them.
    - ``"discrete-16"``: ``Discrete(16)``, the older set without the micro groups.
    - ``"continuous"``: ``Box(-1, 1, (3,))``: steer (times 30 degrees, positive to the left), acceleration (times
      3.625 m/s^2) and brake (-1 none, 1 full). Values out of range are clipped.

    ## Observation Space

    ``Box`` of float32 in SI units, 15 numbers (StaticObstacle and LeftTurn 19).

    | index | observation | unit |
    |---|---|---|
    | 0, 1 | angle from the heading to the next waypoint and the one after, positive to the right | rad |
    | 2, 3 | distance from the front to the next waypoint; that, plus the distance from the front to the one after | m |
    | 4, 5 | velocity x, y | m/s |
    | 6, 7 | acceleration x, y | m/s^2 |
    | 8, 9, 10 | held steer, throttle, brake | rad, m/s^2, 1 |
    | 11 | speed | m/s |
    | 12, 13 | distance to the left and right lane line (1.524 where there are no lanes) | m |
    | 14 | inside the crossing (0 where there is none) | 0 or 1 |
    | 15, 16 | distances to the bicycle's two ends (StaticObstacle) | m |
    | 17, 18 | angles to the bicycle's two ends (StaticObstacle) | rad |
    | 15, 16 | nearest oncoming car: from its front to the crossing, along its lane; speed (LeftTurn) | m, m/s |
    | 17, 18 | the same of the second nearest one (LeftTurn) | m, m/s |

    The nearest oncoming cars are the first ones whose rear has not left the crossing. The distance is negative inside
    the crossing; a car is seen from 100 m on, and where there is none, the distance is 100 and the speed 0.

    ## Reward Space

    ``Box`` of float32, every component to be maximised (magnitudes with ``cost_sign="paper"``).

    | objective | reward per decision | scenario |
    |---|---|---|
    | distance | route distance gained (m); in LeftTurn-v0 negative in the crossing while a car approaches | all |
    | destination | 1 on the decision that arrives | all |
    | g_force | minus the g-force at the end of the decision (g) | all |
    | collision | -1 on the decision that collides | StaticObstacle, LeftTurn |
    | jerk | minus the jerk at the end of the decision (m/s^3) | all |
    | lane_violation | minus the distance outside the lane at the end of the decision (m) | LeftTurn |
    | time | minus the duration of the decision (s), in v1 with what an early end leaves | v1; in v0 LeftTurn |
    | near_miss | -1 on a decision after which the time to collision is below 1.5 s | by ``objectives`` LeftTurn |

    ## Starting State

    The car is at rest at the left edge of the map, facing +x. The destination is drawn uniformly from the right part
    of the map, the bicycle from places along the way. ``reset(options={"start": (x, y, heading), "destination":
    (x, y), "obstacle": ((x, y), (x, y))})`` sets each of them for that episode.

    In LeftTurn the car is at rest in its lane, at a random distance from the crossing, and the oncoming cars drive.
    Options are ``start``, ``destination``, ``cars`` (how many come, 0 to 5), and with a number per car, the first one
    first, ``headways`` (s, to the car ahead or, of the first one, to the crossing), ``desired_speeds`` (m/s) and
    ``yielding`` (m/s^2, how hard it brakes for a left-turner at most). Of fewer numbers than cars the rest are drawn.

    ## Episode End

    ``info["end"]`` says why, ``info["success"]`` whether the car arrived. Terminated: ``arrived`` (front within 1 m
    of the destination), ``collision``, ``harmful_g_force`` (above 1 g), ``harmful_jerk`` (off by default),
    ``circling`` (turned by more than 400 degrees), ``backwards`` (more than 2 m behind its best route distance), in
    LeftTurn ``skipped_waypoint`` and ``off_lane`` (off by default).
    Truncated: ``time_limit`` (60 s).

    ## Arguments

    ``scenario`` is set by the id. Every other field of :class:`~mo_deepdrive.world.config.EnvConfig` is an argument:
    ``action_type``, ``fixed_destination``, ``fixed_obstacle`` (StaticObstacle), ``time_limit``, ``objectives``,
    ``cost_sign``, ``simulation_frequency``, ``decision_frequency``, ``constrain_controls``, ``ignore_brake``,
    ``harmful_g_force``, ``harmful_jerk``, ``charge_remaining_time``; for LeftTurn ``traffic`` ("none", "light",
    "default" or "dense"), ``yield_to_oncoming``, ``lane_margin`` and ``end_on_lane_violation``. ``yaw_friction``,
    ``action_delay`` and, in LeftTurn, ``observed_cars`` change the world that a policy was trained in, to test how it
    generalises. ``render_mode`` is None, "rgb_array" or "human". Unknown arguments raise TypeError, invalid values
    ValueError.

    ## Version History

    - v1: v0 with ``time`` as the last objective and ``charge_remaining_time=True``, so that ending early saves no time;
      LeftTurn with ``yield_to_oncoming=False``, so that distance is what was driven.
    - v0: initial release. ``docs/simulator.md`` lists the departures from the published code.

    The version is raised by every change of what an agent experiences: dynamics, rewards, observations, spaces and
    termination. Changes of speed, rendering and documentation keep it.
    """

    def __init__(self, scenario: str, render_mode: str | None = None, **options: Any):
        config = parse_arguments(scenario, options)
        if (vehicles := config.row.vehicles) > 1:
            raise ValueError(
                f"scenario = {scenario!r} has {vehicles} vehicles; use gymnasium.make({SCENARIOS[scenario].id!r}), "
                "where they take turns, its make_vec, or mo_deepdrive.parallel_env()"
            )
        super().__init__(config, render_mode)
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode; ``options`` set parts of the scenario (see the class)."""
        self._place(seed, options)
        self._running = True
        return self.batch.observations[0, 0].copy(), {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], bool, bool, dict[str, Any]]:
        """Drive for one decision.

        Returns:
            observation (size,), vector reward (d,), terminated, truncated, info.

        Raises:
            ResetNeeded: before the first reset and after the end of an episode.
            ValueError: for an action outside the action space; the state is unchanged.
        """
        if not self._running:
            raise ResetNeeded("step() before reset() or after the end of an episode")
        array = np.asarray(action)
        if array.shape != self.action_space.shape:
            raise ValueError(f"action {action!r} has shape {array.shape}; expected {self.action_space.shape}")
        self.world.step(array[None, None])
        batch = self.batch
        terminated = bool(batch.terminated[0, 0])
        truncated = bool(batch.truncated[0, 0])
        info: dict[str, Any] = {}
        if terminated or truncated:
            self._running = False
            info = self.world.end_info(0)
        return batch.observations[0, 0].copy(), batch.rewards[0, 0].copy(), terminated, truncated, info
