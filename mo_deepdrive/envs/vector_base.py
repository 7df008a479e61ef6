"""What the vector environments share: settings, spaces and seeds, and what is shown of their worlds."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mo_deepdrive.envs import spaces as env_spaces
from mo_deepdrive.envs.streams import checked_seed
from mo_deepdrive.envs.world import KnownFront
from mo_deepdrive.support.plain_values import whole_number
from mo_deepdrive.world.batch import read_telemetry
from mo_deepdrive.world.config import parse_arguments
from mo_deepdrive.world.params import chosen_objectives

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray


def positive(name: str, value: Any) -> int:
    """``value`` as an integer of at least one."""
    return whole_number(name, value, 1, allowed="a positive integer")


def _form(array: Any) -> str:
    if array is None:
        return "missing"
    return f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else repr(type(array).__name__)


def check_forms(state: Mapping[str, Any], needed: Mapping[str, NDArray[Any]]) -> None:
    """Refuse a state whose arrays have not the names, types and shapes of ``needed``.

    The ValueError names the first array that differs.
    """
    for name, array in needed.items():
        if _form(found := state.get(name)) != _form(array):
            raise ValueError(f"state {name!r} is {_form(found)}; this environment needs {_form(array)}")


def needs_reset(worlds: Any) -> ResetNeeded:
    """The error of a step of the worlds of these numbers, an array or a tensor, which have to be reset first."""
    first = worlds[:5].tolist()
    return ResetNeeded(
        f"step() on worlds whose episode is over or has not begun (the first ones: {first}); reset them first"
    )


class VectorBase(KnownFront, VectorEnv):
    """N independent worlds of one scenario; a subclass makes the worlds, and then the spaces.

    Attributes:
        objectives: names of the d components of a vehicle's reward, in order.
        observation_scales: (size,) nominal magnitudes of the observation of a vehicle, by which learners divide.
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int,
        scenario: str,
        autoreset_mode: AutoresetMode | str,
        render_mode: str | None,
        max_episode_steps: int | None,
        options: Mapping[str, Any],
    ):
        num_envs = positive("num_envs", num_envs)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode = {render_mode!r} must be None or 'rgb_array'")
        config = parse_arguments(scenario, options)
        if max_episode_steps is not None:
            most = positive("max_episode_steps", max_episode_steps)
            time_limit = min(config.time_limit, most / config.decision_frequency)
            config = parse_arguments(scenario, {**options, "time_limit": time_limit})
        self.num_envs = num_envs
        self.config = config
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            **copy.deepcopy(type(self).metadata),
            "render_fps": config.decision_frequency,
            "autoreset_mode": self.autoreset_mode,
        }
        self.objectives = chosen_objectives(config)
        self.reward_dim = len(self.objectives)
        self._viewers: list[Any] = []

    def _make_spaces(self, vehicles: int) -> None:
        """Those of all worlds take memory, so the worlds are made first, and refused if they are too many."""
        config, num_envs = self.config, self.num_envs
        self.vehicles = vehicles
        self.single_observation_space = self._per_vehicle(env_spaces.observation_space(config))
        self.observation_scales = env_spaces.observation_scales(config)
        self.single_action_space = self._per_vehicle(env_spaces.action_space(config))
        self.reward_space = self._per_vehicle(env_spaces.reward_space(config))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _per_vehicle(self, space: spaces.Space[Any]) -> Any:
        if self.vehicles == 1:
            return space
        if isinstance(space, spaces.Discrete):
            return spaces.MultiDiscrete([int(space.n)] * self.vehicles)
        assert isinstance(space, spaces.Box)
        tile = (self.vehicles, 1)
        return spaces.Box(np.tile(space.low, tile), np.tile(space.high, tile), dtype=np.float32)

    def _seeds(self, seed: int | list[int | None] | None) -> list[int | None]:
        if not isinstance(seed, (list, tuple, np.ndarray)):
            first = checked_seed(seed)
            return [None if first is None else first + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed has {len(seed)} entries; a list needs one for each of the {self.num_envs} worlds")
        return [checked_seed(each, f"seed[{i}]") for i, each in enumerate(seed)]

    def _shaped(self, array: Any) -> Any:
        """An array (N, vehicles, ...) without the vehicle axis if there is only one vehicle."""
        return array[:, 0] if self.vehicles == 1 else array

    def _states(self) -> NDArray[Any]:
        """The states (N, V) of VEHICLE, read only."""
        raise NotImplementedError

    def telemetry(self) -> tuple[tuple[dict[str, float], ...], ...]:
        """A dict per world and vehicle: pose, motion, controls, comfort and progress, in SI units."""
        return tuple(read_telemetry(vehicles, self.config) for vehicles in self._states())

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One RGB frame per world for ``render_mode="rgb_array"``, else None."""
        if self.render_mode is None:
            return None
        from mo_deepdrive.drawing.rendering import Viewer

        if not self._viewers:
            self._viewers = [Viewer(self.config, self.render_mode) for _ in range(self.num_envs)]
        states = self._states()
        return tuple(viewer.draw(states[row]) for row, viewer in enumerate(self._viewers))

    def close_extras(self, **_kwargs: Any) -> None:
        """Close the renderers."""
        for viewer in self._viewers:
            viewer.close()
        self._viewers = []
