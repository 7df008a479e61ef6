"""Driving by hand: an environment whose actions are the keys that are held down, and the window to drive it in.

Gymnasium's play utility takes one step per frame and resets as soon as an episode ends. A :class:`HumanPlayEnv` shows
several frames per decision, so that a short press of a key is not lost, and holds the last frame for a moment at the
end of an episode.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mo_deepdrive.drawing.quiet_pygame import INVISIBLE_DRIVERS, pygame
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.simulation.actions import decode_discrete
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE, Record
from mo_deepdrive.world import actions as action_sets

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import torch

    from mo_deepdrive.envs.vector import DrivingVectorEnv
    from mo_deepdrive.evaluation.policy import Policy

FRAMES_PER_DECISION = 3
END_HOLD = 1.5  # s for which the last frame of an episode is shown
SEEDS = 2**31


class Keys(NamedTuple):
    """The keys that one person holds down."""

    accelerate: bool
    brake: bool
    left: bool
    right: bool


# Per person: the keys in the order of Keys.
KEYBOARD = {
    "arrow keys": (pygame.K_UP, pygame.K_DOWN, pygame.K_LEFT, pygame.K_RIGHT),
    "W A S D": (pygame.K_w, pygame.K_s, pygame.K_a, pygame.K_d),
}


def choose_action(keys: Keys, vehicle: Record, action_type: str) -> int:
    """:func:`mo_deepdrive.world.actions.action_of_keys` for a vehicle, whose record of VEHICLE is given."""
    table = action_sets.action_table(action_type)
    return action_sets.action_of_keys(table, vehicle.steer, vehicle.speed, vehicle.throttle, *keys)


@dataclass(frozen=True)
class EpisodeOutcome:
    """How an episode ended for each of its V vehicles."""

    episode: int  #: its number, starting at 1
    seed: int  #: seed of its scenario
    ends: tuple[str, ...]  #: (V,) why it ended (a name of ``mo_deepdrive.simulation.state.ENDS``)
    seconds: tuple[float, ...]  #: (V,) after what time it ended
    returns: NDArray[np.float64]  #: (V, d) undiscounted vector returns


def make_play_env(env_id: str, **arguments: Any) -> DrivingVectorEnv:
    """A single environment for :class:`HumanPlayEnv`: it returns RGB frames and is not reset automatically."""
    arguments = {**arguments, "render_mode": "rgb_array"}
    env = gymnasium.make_vec(env_id, num_envs=1, autoreset_mode=AutoresetMode.DISABLED, **arguments)
    return cast("DrivingVectorEnv", env.unwrapped)


class HumanPlayEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.int8]]):
    """An environment in which people drive some of the vehicles, or all of them.

    An action says which keys are down: the :class:`Keys` of every person, then whether to restart the episode. A step
    is one frame. Every FRAMES_PER_DECISION-th step is a decision, based on all keys that were down since the last one.
    ``info["outcome"]`` is an :class:`EpisodeOutcome` in the step in which the last vehicle ends; END_HOLD seconds later
    the episode terminates. The seed of the first episode is that of ``reset(seed=...)``, and it increases by one with
    every episode that has an outcome. An episode that is restarted before it ends keeps its seed.

    Args:
        env: a single environment, from :func:`make_play_env`.
        seats: the vehicles that people drive.
        policy: drives the other vehicles.
        generator: random numbers for its sampled actions; None for greedy ones.
        on_frame: called with the frame of every decision.

    Raises:
        ValueError: if nobody drives a vehicle.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"

    def __init__(
        self,
        env: DrivingVectorEnv,
        seats: Sequence[int],
        *,
        policy: Policy | None = None,
        generator: torch.Generator | None = None,
        on_frame: Callable[[NDArray[np.uint8]], None] | None = None,
    ):
        if policy is None and set(seats) != set(range(env.vehicles)):
            raise ValueError(f"seats = {list(seats)} leave some of the {env.vehicles} vehicles without a driver")
        self.vector_env = env
        self.seats = tuple(seats)
        self.metadata = {**type(self).metadata, "render_fps": FRAMES_PER_DECISION * env.config.decision_frequency}
        self.observation_space = env.observation_space
        self._keys = len(seats) * len(Keys._fields) + 1
        self.action_space = spaces.MultiBinary(self._keys)
        self._policy, self._generator = policy, generator
        self._on_frame = on_frame
        self._action_type = "discrete" if env.batch.continuous else env.config.action_type
        self._table = action_sets.action_table(self._action_type)
        self._first_seed: int | None = None
        self._finished = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start the next episode, with its own seed, which is random at first, or with ``seed``."""
        super().reset(seed=seed)
        if seed is not None or self._first_seed is None:
            self._first_seed = int(self.np_random.integers(SEEDS)) if seed is None else seed
            self._finished = 0
        self._seed = self._first_seed + self._finished
        self._observations, _ = self.vector_env.reset(seed=self._seed, options=options)
        self._returns = np.zeros((self.vector_env.vehicles, self.vector_env.reward_dim))
        self._accrued_reward = AccruedReward.begin(1, *self._returns.shape)
        self._pressed = np.zeros(self._keys, dtype=np.bool_)
        self._frames = 0
        self._over = False
        self._decisions_held = 0  # duration of the last frame, in decisions
        self._frame: NDArray[np.uint8] | None = None
        return self._observations, {}

    def step(
        self, action: NDArray[np.int8]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], bool, bool, dict[str, Any]]:
        """Show one more frame; the reward (V, d) is zero in steps that are not a decision."""
        self._pressed |= np.asarray(action, dtype=np.bool_)
        self._frames += 1
        rewards = np.zeros(self._returns.shape, dtype=np.float32)
        info: dict[str, Any] = {}
        *pressed, restart = self._pressed.tolist()
        if not restart and self._frames % FRAMES_PER_DECISION == 0:
            if self._on_frame is not None:
                self._on_frame(self.render())
            if self._over:
                self._decisions_held += 1
            else:
                width = len(Keys._fields)
                rewards = self._decide([Keys(*pressed[k : k + width]) for k in range(0, len(pressed), width)])
                if self._over:
                    info = {"outcome": self._outcome()}
                    self._finished += 1
            self._pressed[:] = False
        terminated = self._decisions_held >= END_HOLD * self.vector_env.config.decision_frequency
        return self._observations, rewards, terminated, restart, info

    def _decide(self, keys: list[Keys]) -> NDArray[np.float32]:
        """Step the environment once; its rewards (V, d)."""
        env = self.vector_env
        chosen = np.zeros((1, env.vehicles), dtype=np.int64)
        for v, held in zip(self.seats, keys, strict=True):
            chosen[0, v] = choose_action(held, env.batch.state[0, v], self._action_type)
        joint: NDArray[Any] = self._continuous(chosen) if env.batch.continuous else chosen
        if self._policy is not None:
            others = [v for v in range(env.vehicles) if v not in self.seats]
            observations = self._observations.reshape(1, env.vehicles, -1)
            actions = self._policy.act(observations, self._accrued_reward, self._generator)
            joint[:, others] = self._policy.env.environment_actions(actions)[:, others]
        self._observations, raw, terminated, truncated, _ = env.step(joint.reshape(env.action_space.shape))
        rewards = raw.reshape(self._returns.shape)
        self._returns += rewards
        if self._policy is not None:
            self._accrued_reward.add(rewards[None], self._policy.gamma)
        self._over = bool((terminated | truncated).all())
        self._frame = None
        return rewards

    def _continuous(self, chosen: NDArray[np.int64]) -> NDArray[np.float32]:
        """The continuous actions (1, V, 3) with the same target controls as the discrete ones ``chosen`` (1, V)."""
        controls = np.zeros((*chosen.shape, len(action_sets.CONTINUOUS_NAMES)))
        for v, action in enumerate(chosen[0]):
            decode_discrete(self.vector_env.batch.state, 0, v, action, self._table, controls)
        scaled = controls / (STEER_RANGE, MAX_ACCELERATION, MAX_ACCELERATION / 2) - (0.0, 0.0, 1.0)
        return scaled.astype(np.float32)

    def _outcome(self) -> EpisodeOutcome:
        batch = self.vector_env.batch
        seconds = batch.state["decisions"][0] / batch.config.decision_frequency
        ends, returns = batch.end_names(0), self._returns.copy()
        return EpisodeOutcome(self._finished + 1, self._seed, ends, tuple(seconds.tolist()), returns)

    def render(self) -> NDArray[np.uint8]:
        """The current frame: RGB (height, width, 3)."""
        if self._frame is None:
            frames = self.vector_env.render()
            assert frames is not None, "the environment has no frames: it needs render_mode='rgb_array'"
            self._frame = frames[0]
        return self._frame

    def close(self) -> None:
        """Close the environment."""
        self.vector_env.close()


def open_display(*, allow_invisible: bool) -> None:
    """Initialise the display for a window; a ValueError if there is none.

    With ``allow_invisible`` a video driver of SDL without a display will do, such as "dummy".
    """
    try:
        pygame.display.init()
        pygame.display.set_caption("MO-DeepDrive")
        driver = pygame.display.get_driver()
        # Without a display SDL may fall back on an invisible window.
        problem = f"SDL has only {driver!r}" if driver in INVISIBLE_DRIVERS and not allow_invisible else ""
    except pygame.error as error:
        problem = f"SDL says {str(error)!r}"
    if problem:
        raise ValueError(
            f"cannot open a window ({problem}): driving needs a display; on Linux set DISPLAY or WAYLAND_DISPLAY, "
            "and if SDL_VIDEODRIVER is set, it must name a driver that has one"
        )


def describe_controls(seats: Sequence[int]) -> str:
    """One line that says which keys drive which vehicle."""
    drivers = (f"vehicle {v}: {name}" for v, name in zip(seats, KEYBOARD, strict=False))
    return "; ".join((*drivers, "R restarts the episode, Escape quits"))


def play_in_window(env: HumanPlayEnv, fps: int, on_outcome: Callable[[EpisodeOutcome], None]) -> None:
    """Drive in a window, with ``fps`` decisions per second, until the user quits.

    The environment has at most as many seats as KEYBOARD has entries; every outcome is passed to ``on_outcome``.
    """
    from gymnasium.utils.play import play  # imported late: it selects a backend of matplotlib

    def callback(*transition: Any) -> None:
        info = transition[-1]
        if "outcome" in info:
            on_outcome(info["outcome"])

    keys = itertools.islice(KEYBOARD.values(), len(env.seats))
    codes = [*itertools.chain.from_iterable(keys), pygame.K_r]  # the last one restarts the episode
    noop, *pressed = (np.array(row, dtype=np.int8) for row in itertools.product((0, 1), repeat=len(codes)))
    actions = {tuple(itertools.compress(codes, row)): row for row in pressed}
    play(env, fps=fps * FRAMES_PER_DECISION, callback=callback, keys_to_action=actions, noop=noop)
