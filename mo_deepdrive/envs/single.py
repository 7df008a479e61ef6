"""The single-vehicle environment: the kernel at N = 1."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from mo_deepdrive.config import EnvConfig, parse
from mo_deepdrive.envs import spaces as env_spaces
from mo_deepdrive.envs.options import make_pins
from mo_deepdrive.scenarios import DRAWS
from mo_deepdrive.simulator import Simulator

_WORLD = np.zeros(1, dtype=np.int64)


class DrivingEnv(gymnasium.Env[NDArray[np.float32], Any]):
    """## Description

    A car drives to a destination in the plane (OneWaypoint), around a bicycle in its way (StaticObstacle). After
    DeepDrive Zero and its multi-objective extension (Ajridi et al., "Deconstructing Reinforcement Learning
    Benchmarks: Revealing the Objectives", ECAI 2023). The car is a kinematic bicycle with friction, simulated at
    60 Hz; the agent decides at 10 Hz.

    ## Action Space

    - ``action_type="discrete"`` (default): ``Discrete(22)``. 0 is idle; action 1 + 3 g + c steers by group g (decay,
      small left, small right, micro left, micro right, large left, large right) and changes speed by c (maintain,
      decrease, increase). ``mo_deepdrive.actions.action_names`` lists them.
    - ``"discrete-16"``: ``Discrete(16)``, the older set without the micro groups.
    - ``"continuous"``: ``Box(-1, 1, (3,))``: steer (times 30 degrees, positive to the left), acceleration (times
      3.625 m/s^2) and brake (-1 none, 1 full). Values beyond are clipped.

    ## Observation Space

    ``Box`` of float32 in SI units, 15 numbers (StaticObstacle 19).

    | index | observation | unit |
    |---|---|---|
    | 0, 1 | angle from the heading to the next waypoint and the one after, positive to the right | rad |
    | 2, 3 | distance from the front to the next waypoint; along it to the one after | m |
    | 4, 5 | velocity x, y | m/s |
    | 6, 7 | acceleration x, y | m/s^2 |
    | 8, 9, 10 | held steer, throttle, brake | rad, m/s^2, 1 |
    | 11 | speed | m/s |
    | 12, 13 | distance to the left and right lane line (1.524 where there is none) | m |
    | 14 | inside the crossing | 0 or 1 |
    | 15, 16 | distances to the bicycle's two ends (StaticObstacle) | m |
    | 17, 18 | angles to the bicycle's two ends (StaticObstacle) | rad |

    ## Reward Space

    ``Box`` of float32, every component to be maximised (``cost_sign="paper"`` gives magnitudes instead).

    | objective | reward per decision | in |
    |---|---|---|
    | distance | route distance gained (m) | both |
    | destination | 1 on the decision that arrives | both |
    | g_force | minus the g-force at the end of the decision (g) | both |
    | collision | -1 on the decision that collides | StaticObstacle |
    | jerk | minus the jerk at the end of the decision (m/s^3) | both |

    ## Starting State

    The car rests at the left edge of the map, facing +x. The destination is uniform over the right part of the map;
    the bicycle stands somewhere along the way. ``reset(options={"start": (x, y, heading), "destination": (x, y),
    "obstacle": ((x, y), (x, y))})`` pins what it names, for that episode.

    ## Episode End

    ``info["end"]`` says why, ``info["success"]`` whether the car arrived. Terminated: ``arrived`` (front within 1 m
    of the destination), ``collision``, ``harmful_g_force`` (above 1 g), ``harmful_jerk`` (off by default),
    ``circling`` (turned by more than 400 degrees), ``backwards`` (more than 2 m behind its best route distance).
    Truncated: ``time_limit`` (60 s). In Intersection also ``off_lane`` and ``skipped_waypoint``.

    ## Arguments

    ``scenario`` is set by the id. Every other field of :class:`mo_deepdrive.config.EnvConfig` is a keyword argument:
    ``action_type``, ``fixed_destination``, ``time_limit``, ``objectives``, ``cost_sign``, ``simulation_frequency``,
    ``decision_frequency``, ``constrain_controls``, ``ignore_brake``, ``harmful_g_force``, ``harmful_jerk``.
    ``render_mode`` is None, "rgb_array" or "human". Unknown arguments raise ValueError.

    ## Version History

    - v0: initial release; the departures from the published code are listed in ``docs/simulator.md``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 10}

    def __init__(self, scenario: str, render_mode: str | None = None, **options: Any):
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode = {render_mode!r} must be None or one of {self.metadata['render_modes']}")
        config = parse(EnvConfig, {"scenario": scenario, **options}, "environment arguments")
        self.config = config
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": config.decision_frequency}
        self.simulator = Simulator(config, 1)
        if self.simulator.scenario.vehicles != 1:
            raise ValueError(f"scenario = {scenario!r} has more than one vehicle; use gymnasium.make_vec")
        self.objectives = self.simulator.objectives
        self.observation_space = env_spaces.observation_space(config)  # type: ignore[assignment]
        self.action_space = env_spaces.action_space(config)
        self.reward_space = env_spaces.reward_space(config)
        self.reward_dim = len(self.objectives)
        self._running = False
        self._viewer: Any = None

    def _draw(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        return self.np_random.random((1, DRAWS))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode; ``options`` pin the scenario (see the class)."""
        pins = make_pins(options, self.simulator.scenario)
        before = self._np_random, self._np_random_seed
        super().reset(seed=seed)
        stream = self.np_random.bit_generator.state
        try:
            self.simulator.place(_WORLD, self._draw, pins)
        except ValueError:
            # Refused: the random stream stands where it stood.
            self.np_random.bit_generator.state = stream
            if seed is not None:
                self._np_random, self._np_random_seed = before
            raise
        self._running = True
        if self.render_mode == "human":
            self.render()
        return self.simulator.observations[0, 0].copy(), {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], bool, bool, dict[str, Any]]:
        """Drive for one decision.

        Returns:
            observation (size,), vector reward (d,), terminated, truncated, info.

        Raises:
            ResetNeeded: before the first reset and after the end of an episode.
            ValueError: for an action outside the action space; the state has not changed.
        """
        if not self._running:
            raise ResetNeeded("step() before reset() or after the end of an episode")
        sim = self.simulator
        array = np.asarray(action)
        if array.shape != self.action_space.shape:
            raise ValueError(f"action {action!r} has shape {array.shape}; expected {self.action_space.shape}")
        sim.step(array[None, None])
        terminated = bool(sim.terminated[0, 0])
        truncated = bool(sim.truncated[0, 0])
        info: dict[str, Any] = {}
        if terminated or truncated:
            self._running = False
            (end,) = sim.end_names(0)
            info = {"end": end, "success": end == "arrived"}
        if self.render_mode == "human":
            self.render()
        return sim.observations[0, 0].copy(), sim.rewards[0, 0].copy(), terminated, truncated, info

    def telemetry(self) -> tuple[dict[str, float], ...]:
        """Per vehicle a dict of named SI floats: pose, motion, controls, comfort and progress."""
        return self.simulator.telemetry(0)

    def render(self) -> NDArray[np.uint8] | None:
        """An RGB frame (height, width, 3) under "rgb_array"; draws in a window under "human"."""
        if self.render_mode is None:
            return None
        if self._viewer is None:
            from mo_deepdrive.rendering import Viewer

            self._viewer = Viewer(self.config, self.render_mode)
        frame = self._viewer.draw(self.simulator.state[0])
        return frame if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Release what rendering holds."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def __getstate__(self) -> dict[str, Any]:
        """A copy or pickle goes on exactly where this environment stands; windows stay behind."""
        return {**self.__dict__, "_viewer": None}
