"""What all environments with a single world share."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray

from mo_deepdrive.envs.options import make_pins
from mo_deepdrive.envs.spaces import action_space, observation_scales, observation_space, reward_space
from mo_deepdrive.envs.streams import checked_seed
from mo_deepdrive.world.batch import Draws, WorldBatch

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mo_deepdrive.world.config import EnvConfig

RENDER_MODES = ["rgb_array", "human"]


class World:
    """One world of a scenario, a batch of one row, with a renderer and checks of actions: a base of environments.

    With the render mode "human" a window follows every reset and step.

    Attributes:
        objectives: names of the reward's d components, in order.
        reward_dim: d.
        observation_scales: (size,) nominal magnitudes of the observation of a vehicle, by which learners divide.

    Raises:
        ValueError: for an unknown ``render_mode``.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 10}

    def __init__(self, config: EnvConfig, render_mode: str | None):
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode = {render_mode!r} must be None or one of {RENDER_MODES}")
        self.config = config
        self.render_mode = render_mode
        self.metadata = {**copy.deepcopy(type(self).metadata), "render_fps": config.decision_frequency}
        self.batch = WorldBatch(config, 1)
        self.objectives = self.batch.objectives
        self.reward_dim = len(self.objectives)
        self.observation_scales = observation_scales(config)
        self._viewer: Any = None
        space = action_space(config)
        self._shape = space.shape or ()
        self._choices = int(space.n) if isinstance(space, spaces.Discrete) else 0
        self._kinds = "iu" if self._choices else "fiu"
        self._allowed = f"integers in [0, {self._choices})" if self._choices else "finite numbers"

    def place(self, generator: np.random.Generator, options: Mapping[str, Any] | None) -> None:
        """Start a new episode drawn from ``generator``, with the reset options ``options``.

        A ValueError for options without a valid scenario; the world and the generator are unchanged.
        """
        pins = make_pins(options, self.config)
        stream = generator.bit_generator.state
        try:
            self.batch.place(Draws(1, self.batch.scenario.draws, [generator]), pins=pins)
        except ValueError:
            generator.bit_generator.state = stream
            raise
        if self.render_mode == "human":
            self.render()

    def move(self, actions: NDArray[Any]) -> None:
        """Move every vehicle on the road by one decision; see :meth:`joint_action`."""
        self.batch.step(actions)
        if self.render_mode == "human":
            self.render()

    def joint_action(self) -> NDArray[Any]:
        """Zeros in the form that :meth:`move` takes: (1, vehicles) integers or (1, vehicles, 3) floats."""
        shape = (1, self.batch.scenario.vehicles, *self._shape)
        return np.zeros(shape, dtype=np.int64 if self._choices else np.float64)

    def on_road(self) -> list[int]:
        """The vehicles that have not ended."""
        ended = self.batch.terminated[0] | self.batch.truncated[0]
        return [v for v, gone in enumerate(ended.tolist()) if not gone]

    def checked(self, action: Any, agent: str) -> Any:
        """The action of one vehicle as an int or a list of floats.

        A ValueError, naming ``agent``, for another shape or type, or for what is not finite or out of range.
        """
        try:
            array = np.asarray(action)
        except ValueError:
            raise ValueError(f"action {action!r} of {agent} is not an array") from None
        if array.shape != self._shape:
            raise ValueError(f"action {action!r} of {agent} has shape {array.shape}; expected {self._shape}")
        if array.dtype.kind not in self._kinds:
            raise ValueError(f"action {action!r} of {agent} has dtype {array.dtype}; expected {self._allowed}")
        values = array.tolist()
        if not (0 <= values < self._choices if self._choices else all(map(math.isfinite, values))):
            raise ValueError(f"action {action!r} of {agent} is not allowed; expected {self._allowed}")
        return values

    def end_info(self, vehicle: int) -> dict[str, Any]:
        """The info of a vehicle that has ended: why it ended, and whether it arrived."""
        end = self.batch.end_names(0)[vehicle]
        return {"end": end, "success": end == "arrived"}

    def telemetry(self) -> tuple[dict[str, float], ...]:
        """A dict per vehicle: pose, motion, controls, comfort and progress, in SI units."""
        return self.batch.telemetry(0)

    def render(self) -> NDArray[np.uint8] | None:
        """An RGB frame (height, width, 3) for "rgb_array"; draws in a window for "human"."""
        if self.render_mode is None:
            return None
        if self._viewer is None:
            from mo_deepdrive.drawing.rendering import Viewer

            self._viewer = Viewer(self.config, self.render_mode)
        frame = self._viewer.draw(self.batch.state[0])
        return frame if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the renderer."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the window: a copy or pickle continues exactly from here."""
        return {**self.__dict__, "_viewer": None}


class KnownFront:
    """Environments whose best-known front may be known."""

    config: EnvConfig

    def pareto_front(self, gamma: float) -> list[NDArray[np.float64]]:
        """The best-known front of one world, by MO-Gymnasium's name; it is not proven to be optimal.

        It exists for environments that are the same in every episode (``fixed_destination=True``, and in StaticObstacle
        ``fixed_obstacle=True``), with all other arguments at their defaults and without reset options; for others a
        ValueError says what it would require. The returns (d,) of K non-dominated policies, discounted with ``gamma``
        in [0, 1], are in this environment's objectives and signs.
        """
        from mo_deepdrive.fronts.reference_fronts import pareto_front

        return pareto_front(self.config, gamma)


class WorldEnv(KnownFront, World, gymnasium.Env[NDArray[np.float32], Any]):
    """Base of the Gymnasium environments with a single world; a subclass implements ``reset`` and ``step``."""

    def __init__(self, config: EnvConfig, render_mode: str | None):
        super().__init__(config, render_mode)
        self.observation_space = observation_space(config)  # type: ignore[assignment]
        self.action_space = action_space(config)
        self.reward_space = reward_space(config)

    def _start(self, seed: int | None, options: Mapping[str, Any] | None) -> None:
        """Start a new episode. If ``seed`` or ``options`` are refused, the random stream is unchanged, too."""
        seed = checked_seed(seed)
        generator, used = (self.np_random, self._np_random_seed) if seed is None else seeding.np_random(seed)
        self.place(generator, options)
        self._np_random, self._np_random_seed = generator, used
