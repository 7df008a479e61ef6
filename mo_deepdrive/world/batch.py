"""A batch of worlds: the buffers around the kernel, which all environments share."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode

from mo_deepdrive.simulation import observation, traffic
from mo_deepdrive.simulation.actions import find_infinite, find_unknown
from mo_deepdrive.simulation.autoreset import (
    DISABLED,
    DONE,
    MAX_REDRAWS,
    NEEDS_DRAWS,
    NEXT_STEP,
    SAME_STEP,
    reset_batch,
)
from mo_deepdrive.simulation.dynamics import make_scratch
from mo_deepdrive.simulation.kernel import batch_step, observe_batch
from mo_deepdrive.simulation.placing import pin_nothing
from mo_deepdrive.simulation.state import ENDS, PARAMS, SPAWN, with_room
from mo_deepdrive.support.machine import check_memory
from mo_deepdrive.world import actions as action_sets
from mo_deepdrive.world.limits import check_state
from mo_deepdrive.world.measures import make_measures
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.params import chosen_objectives, make_params, vehicle_record

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig


class Draws:
    """Random numbers for new episodes, drawn when they are needed, a ``block`` of episodes at a time.

    An episode takes ``draws`` uniforms of the generator of its world; without generators all numbers are zero.

    Attributes:
        blocks: (worlds, block, draws) uniforms in [0, 1), a row for every scenario that is drawn.
        cursors: (worlds,) how many rows of its block each world has used.
    """

    def __init__(
        self, worlds: int, draws: int, generators: Sequence[np.random.Generator] | None = None, block: int = 1
    ):
        self._generators = generators
        self.blocks = np.zeros((worlds, block, draws))
        self.cursors = np.full(worlds, block, dtype=np.int64)

    def refill(self, rows: NDArray[np.int64]) -> None:
        """Draw a new block for each world in ``rows`` whose block is used up."""
        empty = rows[self.cursors[rows] == self.blocks.shape[1]]
        if self._generators is not None:
            for i in empty:
                self._generators[i].random(out=self.blocks[i])
        self.cursors[empty] = 0


# Of Gymnasium, as the compiled reset takes them.
MODES = {AutoresetMode.NEXT_STEP: NEXT_STEP, AutoresetMode.SAME_STEP: SAME_STEP, AutoresetMode.DISABLED: DISABLED}

# The fields of the state that telemetry reports.
TELEMETRY = (
    *("x", "y", "heading", "speed", "steer", "throttle", "brake", "g_force", "jerk", "route_distance", "travelled"),
    *("left_lane_distance", "right_lane_distance", "vx", "vy", "ax", "ay"),
)
# Of every oncoming car.
CAR_TELEMETRY = ("x", "y", "speed", "acceleration", "present")


class Transition(NamedTuple):
    """One decision of N worlds with V vehicles each: arrays of NumPy, or tensors."""

    observations: Any  #: (N, V, size) float32 for the next decision
    #: (N, V, size) after this one: others where an episode was over and the next one has begun in the same step;
    #: ``observations`` themselves in other autoreset modes.
    final: Any
    rewards: Any  #: (N, V, d) float32; zero for vehicles that had ended before
    acted: Any  #: (N, V) bool, which vehicles were on the road before the decision
    terminated: Any  #: (N, V) bool, after it, before a reset in the same step
    truncated: Any  #: (N, V) bool, likewise
    over: Any  #: (N,) bool, where no vehicle was on the road after it
    ends: Any  #: (N, V) why vehicles have ended: positions in :data:`mo_deepdrive.simulation.state.ENDS`


@dataclass(frozen=True)
class Part:
    """Consecutive worlds that one thread moves: views of the buffers, and scratch of its own."""

    rows: slice
    worlds: NDArray[Any]
    controls: NDArray[np.float64]
    motion: NDArray[Any]
    cars: NDArray[Any]
    path: NDArray[Any]
    sight: NDArray[Any]
    spawn: NDArray[Any]
    observations: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    acted: NDArray[np.bool_]


class ThreadPool:
    """Threads that are started when they are needed; a copy of the pool, or a forked process, starts its own."""

    def __init__(self) -> None:
        self._executor: ThreadPoolExecutor | None = None
        self._process = 0

    def __reduce__(self) -> tuple[type[ThreadPool], tuple[()]]:
        return ThreadPool, ()

    def run(self, function: Callable[[Part], None], parts: Sequence[Part]) -> None:
        """Call ``function`` for every part at the same time, the first in this thread."""
        first, *rest = parts
        if rest and (self._executor is None or self._process != os.getpid()):
            # A forked child inherits the executor without its threads, and would wait for them for ever.
            self._executor, self._process = ThreadPoolExecutor(len(rest)), os.getpid()
        others = [self._executor.submit(function, part) for part in rest] if self._executor is not None else []
        try:
            function(first)
        finally:
            wait(others)  # nobody writes to the parts any more, even after an error
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads; another call would start new ones."""
        if self._executor is not None and self._process == os.getpid():
            self._executor.shutdown()
        self._executor = None


class WorldBatch:
    """``worlds`` independent copies of one scenario, moved together.

    Random numbers come from the caller. A checkpoint is a copy of ``state``. Every call overwrites the other arrays.

    Attributes:
        state: (worlds, vehicles) of VEHICLE, with the room of :func:`mo_deepdrive.world.params.vehicle_record`.
        observations: (worlds, vehicles, size).
        rewards: (worlds, vehicles, d).
        acted: (worlds, vehicles) whether a vehicle was on the road before the step.
        terminated, truncated: (worlds, vehicles).
        table: (actions, 4) of the discrete actions, none if they are continuous.
        measures: what measures the objectives that the kernel does not measure.
        no_pins: (1,) of SPAWN that pins nothing.
    """

    def __init__(self, config: EnvConfig, worlds: int, threads: int = 1):
        self.config = config
        self.scenario = config.scenario_data
        self.objectives = chosen_objectives(config)
        self.params = make_params(config)
        vehicles, obstacles, cars = self.scenario.vehicles, self.scenario.obstacles, self.scenario.cars
        size = len(layout(self.scenario))
        dtype = vehicle_record(config)
        numbers = size + len(self.objectives) + 2 * 3  # of observations, rewards and controls
        check_memory(f"num_envs = {worlds}", worlds * vehicles * (dtype.itemsize + 4 * numbers))
        self.state = np.zeros((worlds, vehicles), dtype=dtype)
        self.state["end"] = ENDS.index("time_limit")
        self.observations = np.zeros((worlds, vehicles, size), dtype=np.float32)
        self.rewards = np.zeros((worlds, vehicles, len(self.objectives)), dtype=np.float32)
        self.terminated = np.zeros((worlds, vehicles), dtype=np.bool_)
        self.truncated = np.ones((worlds, vehicles), dtype=np.bool_)  # as the state says
        self._controls = np.zeros((worlds, vehicles, 3))
        self.acted = np.zeros((worlds, vehicles), dtype=np.bool_)
        self.measures = make_measures(config)
        self._attempts = np.zeros(worlds, dtype=np.int64)
        self._spawn = np.zeros(1, dtype=with_room(SPAWN, obstacles, cars, 0))
        self._sight = np.zeros(1, dtype=observation.SIGHT)
        self.no_pins = np.zeros_like(self._spawn)
        pin_nothing(self.no_pins)
        self.continuous = config.action_type == action_sets.CONTINUOUS
        self.table = np.zeros((0, 4)) if self.continuous else action_sets.action_table(config.action_type)
        self.step_function = batch_step(self.measures)
        self._drawn = np.zeros((1, self.scenario.draws))
        self._threads = ThreadPool()
        self._parts = self.parts(min(threads, worlds))

    def __getstate__(self) -> dict[str, Any]:
        """Without the parts, which are views of the buffers, and compiled functions: a copy makes new ones."""
        state = {**self.__dict__, "_parts": len(self._parts)}
        del state["measures"], state["step_function"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        spawn = with_room(SPAWN, self.scenario.obstacles, self.scenario.cars, 0)
        for name, dtype in (
            ("state", vehicle_record(self.config)),
            ("params", PARAMS),
            ("_spawn", spawn),
            ("no_pins", spawn),
            ("_sight", observation.SIGHT),
        ):
            # The dtype of unpickled records only equals this one; Numba would compare their fields at every call.
            setattr(self, name, getattr(self, name).view(dtype))
        self.measures = make_measures(self.config)
        self.step_function = batch_step(self.measures)
        self._parts = self.parts(state["_parts"])

    def parts(self, count: int) -> list[Part]:
        """The worlds divided into ``count`` parts of nearly equal size, for as many threads."""
        return [self._part(rows) for rows in np.array_split(np.arange(len(self.state)), count)]

    def _part(self, rows: NDArray[np.int64]) -> Part:
        part = slice(int(rows[0]), int(rows[-1]) + 1)
        cars = self.scenario.cars
        motion, path = make_scratch(self.scenario.vehicles + cars, self.config.physics_steps)
        return Part(
            rows=part,
            worlds=self.state[part],
            controls=self._controls[part],
            motion=motion,
            cars=traffic.make_scratch(cars),
            path=path,
            sight=np.zeros(1, dtype=observation.SIGHT),
            spawn=np.zeros_like(self._spawn),
            observations=self.observations[part],
            rewards=self.rewards[part],
            terminated=self.terminated[part],
            truncated=self.truncated[part],
            acted=self.acted[part],
        )

    def place(self, draws: Draws | None = None, rows: NDArray[np.bool_] | None = None, pins: Any = None) -> None:
        """Start new episodes in ``rows`` (worlds,), or in all worlds; all random numbers are zero without ``draws``.

        Entries of ``pins`` (1,) of SPAWN that are not NaN are used instead of drawn ones. A ValueError if no valid
        scenario is found, because the pins or the scenario's routes allow none.
        """
        count = len(self.state)
        waiting = np.ones(count, dtype=np.bool_) if rows is None else rows.copy()
        self.reset(NEXT_STEP, waiting, draws or Draws(count, self.scenario.draws), pins)

    def reset(self, mode: int, waiting: NDArray[np.bool_], draws: Draws, pins: NDArray[Any] | None = None) -> None:
        """Start new episodes where the autoreset mode says so, one of :mod:`mo_deepdrive.simulation.autoreset`.

        Written: ``waiting`` (worlds,), whether the episode is over and its world has not been reset. Pins and errors
        are those of :meth:`place`.
        """
        worlds = (
            self.state, mode, waiting, draws.blocks, draws.cursors, self._attempts, self._drawn,
            self.no_pins if pins is None else pins, self.params, self._spawn, self._sight,
            self.observations, self.terminated, self.truncated,
        )  # fmt: skip
        row, problem = reset_batch(0, *worlds)
        while problem == NEEDS_DRAWS:
            draws.refill(np.arange(row, len(self.state))[waiting[row:] if mode == NEXT_STEP else self.over()[row:]])
            row, problem = reset_batch(row, *worlds)
        if problem != DONE:
            raise self.no_scenario()

    def no_scenario(self) -> ValueError:
        """The error of a reset that finds no valid scenario."""
        problems = {
            "a bicycle touches the vehicle at its start or is within 1 m of the destination": self.scenario.obstacles,
            "an oncoming car touches the vehicle at its start": self.scenario.cars and not self.scenario.roads,
            "vehicles or cars touch, or are not on their first segment": self.scenario.roads,
        }
        problem = ", or ".join(text for text, number in problems.items() if number)
        return ValueError(f"no valid scenario in {MAX_REDRAWS} draws with these reset options: {problem}")

    def step(self, actions: NDArray[Any]) -> None:
        """Move every running vehicle by one decision.

        The actions are (worlds, vehicles) integers, or (worlds, vehicles, 3) real numbers in [-1, 1] (clipped). A
        ValueError for some that are out of range, not finite or of the wrong type; no state has changed.
        """
        actions = self._checked(actions)
        self._threads.run(lambda part: self._run(part, actions), self._parts)

    def close(self) -> None:
        """End the threads; another step would start new ones."""
        self._threads.close()

    def _checked(self, actions: NDArray[Any]) -> NDArray[Any]:
        kinds, dtype = ("fiu", np.float64) if self.continuous else ("iu", np.int64)
        allowed = "finite numbers" if self.continuous else f"integers in [0, {len(self.table)})"
        given = actions
        if given.dtype.kind not in kinds:
            first = given.reshape(-1)[0]
            raise ValueError(f"actions such as {first!r} have dtype {given.dtype}; expected {allowed}")
        # Numbers too large for the type become others that are refused, too.
        with np.errstate(over="ignore"):
            actions = np.ascontiguousarray(given, dtype=dtype)
        row = find_infinite(actions) if self.continuous else find_unknown(actions, len(self.table))
        if row >= 0:
            raise ValueError(f"action {given[row].tolist()} of world {row} is not allowed; expected {allowed}")
        return actions

    def _run(self, part: Part, actions: NDArray[Any]) -> None:
        """Move the worlds of one part."""
        self.step_function(
            part.worlds, actions[part.rows], self.table, self.params, part.controls, part.motion, part.cars, part.path,
            part.sight, part.observations, part.rewards, part.acted, part.terminated, part.truncated,
        )  # fmt: skip

    def over(self) -> NDArray[np.bool_]:
        """The worlds without a vehicle on the road, shape (worlds,)."""
        ended: NDArray[np.bool_] = self.terminated | self.truncated
        over = ended[:, 0]
        # Column by column: a reduction over an axis of length two takes ten times as long.
        for v in range(1, ended.shape[1]):
            over = over & ended[:, v]
        return over

    def restore(self, state: NDArray[Any]) -> None:
        """Overwrite the state (worlds, vehicles), and compute the observations and flags from it.

        Raises:
            ValueError: for values that the dynamics cannot reach; nothing changes.
        """
        check_state(state, self.config, self.params["n_waypoints"][0, : state.shape[1]])
        self.state[:] = state
        observe_batch(self.state, self.params, self._sight, self.observations, self.terminated, self.truncated)

    def end_names(self, row: int) -> tuple[str, ...]:
        """Why each vehicle of world ``row`` has ended; "" if it has not."""
        return tuple(ENDS[end] for end in self.state["end"][row])

    def telemetry(self, row: int) -> tuple[dict[str, float], ...]:
        """What :func:`read_telemetry` says of world ``row``."""
        return read_telemetry(self.state[row], self.config)


def read_telemetry(vehicles: NDArray[Any], config: EnvConfig) -> tuple[dict[str, float], ...]:
    """TELEMETRY and ``yaw_rate`` (rad/s) of the vehicles (V,) of a world, in SI units.

    CAR_TELEMETRY of the oncoming cars follows as ``car_1_x`` and so on, with ``present`` as 0 or 1.
    """
    readings = []
    for vehicle in vehicles:
        reading = {name: float(vehicle[name]) for name in TELEMETRY}
        reading["yaw_rate"] = float(vehicle.yaw_step) * config.simulation_frequency
        for number, car in enumerate(vehicle.cars, 1):
            reading |= {f"car_{number}_{name}": float(car[name]) for name in CAR_TELEMETRY}
        readings.append(reading)
    return tuple(readings)
