"""A batch of worlds: the buffers around the kernel that every face of the environments shares."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mo_deepdrive import actions as action_sets
from mo_deepdrive import observation
from mo_deepdrive.config import EnvConfig
from mo_deepdrive.scenarios import DRAWS, SCENARIOS, pin_nothing
from mo_deepdrive.simulation.kernel import reset_batch, step_batch
from mo_deepdrive.simulation.params import chosen_objectives, make_params
from mo_deepdrive.simulation.state import ENDS, SPAWN, VEHICLE

Draw = Callable[[NDArray[np.int64]], NDArray[np.float64]]
MAX_REDRAWS = 1000

# Telemetry name -> field of the state.
TELEMETRY = {
    name: name
    for name in (
        "x",
        "y",
        "heading",
        "speed",
        "steer",
        "throttle",
        "brake",
        "g_force",
        "jerk",
        "route_distance",
        "travelled",
        "left_lane_distance",
        "right_lane_distance",
        "vx",
        "vy",
        "ax",
        "ay",
    )
}


class Simulator:
    """``worlds`` independent copies of one scenario, moved together.

    The buffers ``observations`` (worlds, vehicles, size), ``rewards`` (worlds, vehicles, d), ``terminated`` and
    ``truncated`` (worlds, vehicles) are overwritten by every call; ``state`` (worlds, vehicles) is all there is to
    save. Randomness is handed in by the caller.
    """

    def __init__(self, config: EnvConfig, worlds: int):
        self.config = config
        self.scenario = SCENARIOS[config.scenario]
        self.objectives = chosen_objectives(config)
        self.params = make_params(config)
        vehicles = self.scenario.vehicles
        size = len(observation.layout(self.scenario))
        self.state = np.zeros((worlds, vehicles), dtype=VEHICLE)
        self.state["end"] = ENDS.index("time_limit")
        self.observations = np.zeros((worlds, vehicles, size), dtype=np.float32)
        self.rewards = np.zeros((worlds, vehicles, len(self.objectives)), dtype=np.float32)
        self.terminated = np.zeros((worlds, vehicles), dtype=np.bool_)
        self.truncated = np.zeros((worlds, vehicles), dtype=np.bool_)
        self._controls = np.zeros((worlds, vehicles, 3))
        self._path = np.zeros((vehicles, config.physics_steps + 1, 4))
        self._spawn = np.zeros(1, dtype=SPAWN)[0]
        self._no_pins = np.zeros(1, dtype=SPAWN)
        pin_nothing(self._no_pins)
        self.continuous = config.action_type == action_sets.CONTINUOUS
        self._table = None if self.continuous else action_sets.action_table(config.action_type)

    def place(self, rows: NDArray[np.int64], draw: Draw, pins: np.record | None = None) -> None:
        """Start new episodes in the worlds ``rows``; ``draw(rows)`` gives (len(rows), DRAWS) uniforms in [0, 1).

        Raises:
            ValueError: if no fair scenario is found: the pins leave none.
        """
        for _ in range(MAX_REDRAWS):
            fair = np.zeros(len(rows), dtype=np.bool_)
            reset_batch(
                self.state,
                rows,
                draw(rows),
                self._no_pins[0] if pins is None else pins,
                self.params,
                self._spawn,
                fair,
                self.observations,
                self.terminated,
                self.truncated,
            )
            rows = rows[~fair]
            if not len(rows):
                return
        raise ValueError(
            f"reset options leave no possible scenario in {MAX_REDRAWS} draws: the bicycle touches the vehicle at "
            "its start or lies within 1 m of the destination"
        )

    def step(self, actions: NDArray[Any]) -> None:
        """Move every running vehicle by one decision.

        Args:
            actions: checked (worlds, vehicles) int64, or (worlds, vehicles, 3) floats.
        """
        if self.continuous:
            action_sets.decode_continuous(actions, self._controls)
        else:
            action_sets.decode_discrete(self.state, actions, self._table, self._controls)
        step_batch(
            self.state,
            self._controls,
            self.params,
            self._path,
            self.observations,
            self.rewards,
            self.terminated,
            self.truncated,
        )

    def end_names(self, row: int) -> tuple[str, ...]:
        """Why each vehicle of world ``row`` has ended ("" while it runs)."""
        return tuple(ENDS[end] for end in self.state["end"][row])

    def telemetry(self, row: int) -> tuple[dict[str, float], ...]:
        """Named SI floats of every vehicle of world ``row``; yaw_rate in rad/s."""
        readings = []
        for vehicle in self.state[row]:
            reading = {name: float(vehicle[field]) for name, field in TELEMETRY.items()}
            reading["yaw_rate"] = float(vehicle.yaw_step) * self.config.simulation_frequency
            readings.append(reading)
        return tuple(readings)
