"""People at the wheel: one world as an environment whose action is which keys are down.

Gymnasium's play utility takes one step per picture and resets the moment an episode ends. A :class:`HumanPlayEnv` takes
several pictures per decision, so that a short press of a key is not lost, and stands still for a moment at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from algorithms.agent import Agent
from algorithms.common.accrued_reward import AccruedReward
from mo_deepdrive import actions as action_sets
from mo_deepdrive.envs.vector import DrivingVectorEnv
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE

PICTURES = 3  # per decision
HOLD = 1.5  # s for which an episode's end stands
SEEDS = 2**31


class Keys(NamedTuple):
    """What one person holds down."""

    accelerate: bool
    brake: bool
    left: bool
    right: bool


def choose_action(keys: Keys, vehicle: Any, action_type: str) -> int:
    """The discrete action that comes closest to what the keys ask of a car.

    Left and right turn the wheel as far as any action does at this speed; otherwise it goes back to the middle.
    Without a key for the speed the car rolls, with none at all it is idle. Both keys of a pair: brake, and straight on.

    Args:
        keys: what is down.
        vehicle: record of dtype VEHICLE.
        action_type: a key of ``mo_deepdrive.actions.DISCRETE``.
    """
    names = action_sets.action_names(action_type)
    if not any(keys):
        return names.index("idle")

    def wheel(steer: action_sets.Steer) -> float:
        return steer.decay * vehicle.steer + steer.offset + steer.curl / max(vehicle.speed, 1.0) ** 2

    steers = action_sets.DISCRETE[action_type]
    if keys.left == keys.right:
        steer = min(steers, key=lambda each: abs(wheel(each)))
    else:
        outward = max if keys.left else min
        steer = outward((each for each in steers if not each.decay), key=wheel)
    if keys.brake:
        change = action_sets.DECREASE
    elif keys.accelerate:
        change = action_sets.INCREASE
    else:  # the first "decrease" only takes the foot off
        change = action_sets.DECREASE if vehicle.throttle > 0.0 else action_sets.MAINTAIN
    return names.index(f"{steer.name}, {action_sets.SPEED_CHANGES[change]}")


@dataclass(frozen=True)
class Outcome:
    """How an episode ended, per vehicle.

    Attributes:
        episode: its number, from 1 on.
        seed: of its scenario.
        ends: (V,) why, by name.
        seconds: (V,) when.
        returns: (V, d) undiscounted sums of the rewards.
    """

    episode: int
    seed: int
    ends: tuple[str, ...]
    seconds: tuple[float, ...]
    returns: NDArray[np.float64]


class HumanPlayEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.int8]]):
    """One world with people at the wheel of some of its vehicles.

    An action says which keys are down: the :class:`Keys` of every seat, then whether to start the episode again. A
    step is one picture; every PICTURES-th decides, on all keys seen since the last one. ``info["outcome"]`` is an
    :class:`Outcome` in the step in which the last vehicle ends; HOLD seconds later the episode is over. Episodes are
    seeded one after the other from ``reset(seed=...)`` on; one that was started again has the same seed.

    Args:
        env: one world of ours that can be drawn and is not reset by itself
            (`algorithms.reporting.videos.make_render_env`).
        seats: the vehicles that people drive.
        agent: drives the other ones.
        generator: of the agent's samples; None for greedy actions.
        film: called with one picture per decision.

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
        agent: Agent | None = None,
        generator: torch.Generator | None = None,
        film: Callable[[NDArray[np.uint8]], None] | None = None,
    ):
        if agent is None and set(seats) != set(range(env.vehicles)):
            raise ValueError(f"seats = {list(seats)} leave some of the {env.vehicles} vehicles to an agent: give one")
        self.world = env
        self.metadata = {**type(self).metadata, "render_fps": PICTURES * env.config.decision_frequency}
        self.observation_space = env.observation_space
        self._keys = len(seats) * len(Keys._fields) + 1
        self.action_space = spaces.MultiBinary(self._keys)
        self._seats = tuple(seats)
        self._agent = agent
        self._generator = generator
        self._film = film
        self._action_type = "discrete" if env.batch.continuous else env.config.action_type
        self._table = action_sets.action_table(self._action_type)
        self._first: int | None = None
        self._finished = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next episode; ``options`` as the world takes them."""
        super().reset(seed=seed)
        if seed is not None or self._first is None:
            self._first = int(self.np_random.integers(SEEDS)) if seed is None else seed
            self._finished = 0
        self._seed = self._first + self._finished
        self._observations, _ = self.world.reset(seed=self._seed, options=options)
        shape = (self.world.vehicles, self.world.reward_dim)
        self._returns = np.zeros(shape)
        self._accrued_reward = AccruedReward.begin(1, *shape)
        self._down = np.zeros(self._keys, dtype=np.bool_)
        self._pictures = 0
        self._over = False
        self._still = 0  # decisions' time since then
        self._picture: NDArray[np.uint8] | None = None
        return self._observations, {}

    def step(self, action: NDArray[np.int8]) -> tuple[NDArray[np.float32], Any, bool, bool, dict[str, Any]]:
        """Show one picture more; the reward (V, d) is zero where nothing is decided."""
        self._down |= np.asarray(action, dtype=np.bool_)
        self._pictures += 1
        rewards = np.zeros(self._returns.shape, dtype=np.float32)
        info: dict[str, Any] = {}
        *down, again = self._down.tolist()
        if not again and self._pictures % PICTURES == 0:
            if self._film is not None:
                self._film(self.render())
            if self._over:
                self._still += 1
            else:
                width = len(Keys._fields)
                rewards = self._decide([Keys(*down[k : k + width]) for k in range(0, len(down), width)])
                info = {"outcome": self._outcome()} if self._over else {}
            self._down[:] = False
        terminated = self._still >= HOLD * self.world.config.decision_frequency
        self._finished += terminated
        return self._observations, rewards, terminated, again, info

    def _decide(self, keys: list[Keys]) -> NDArray[np.float32]:
        """Move the world by one decision; its rewards (V, d)."""
        world, agent = self.world, self._agent
        chosen = np.zeros((1, world.vehicles), dtype=np.int64)
        for v, held in zip(self._seats, keys, strict=True):
            chosen[0, v] = choose_action(held, world.batch.state[0, v], self._action_type)
        joint = self._continuous(chosen) if world.batch.continuous else chosen
        if agent is not None:
            observations = self._observations.reshape(1, world.vehicles, -1)
            theirs = agent.act(observations, self._accrued_reward, self._generator)
            others = [v for v in range(world.vehicles) if v not in self._seats]
            joint[:, others] = agent.env.environment_actions(theirs)[:, others]
        self._observations, raw, terminated, truncated, _ = world.step(joint.reshape(world.action_space.shape))
        rewards = raw.reshape(self._returns.shape)
        self._returns += rewards
        self._accrued_reward.add(rewards[None], 1.0 if agent is None else agent.gamma)
        self._over = bool((terminated | truncated).all())
        self._picture = None
        return rewards

    def _continuous(self, chosen: NDArray[np.int64]) -> NDArray[np.float32]:
        """The continuous actions (1, V, 3) with the same target controls as the discrete ones ``chosen`` (1, V)."""
        controls = np.zeros((*chosen.shape, len(action_sets.CONTINUOUS_NAMES)))
        action_sets.decode_discrete(self.world.batch.state, chosen, self._table, controls)
        scaled = controls / (STEER_RANGE, MAX_ACCELERATION, MAX_ACCELERATION / 2) - (0.0, 0.0, 1.0)
        return scaled.astype(np.float32)

    def _outcome(self) -> Outcome:
        decisions = self.world.batch.state["decisions"][0]
        return Outcome(
            episode=self._finished + 1,
            seed=self._seed,
            ends=self.world.batch.end_names(0),
            seconds=tuple((decisions / self.world.config.decision_frequency).tolist()),
            returns=self._returns.copy(),
        )

    def render(self) -> NDArray[np.uint8]:
        """What the world looks like: RGB (height, width, 3)."""
        if self._picture is None:
            pictures = self.world.render()
            assert pictures is not None, "the world was made to be drawn"
            self._picture = pictures[0]
        return self._picture

    def close(self) -> None:
        """Close the world."""
        self.world.close()
