"""The PettingZoo environments, in which the vehicles act together (parallel) or in turns (AEC)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.wrappers import BaseWrapper

from mo_deepdrive.envs import spaces as env_spaces
from mo_deepdrive.envs.options import checked_options, option_names
from mo_deepdrive.envs.streams import checked_seed
from mo_deepdrive.envs.world import World
from mo_deepdrive.support.extras import needed_for
from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.config import parse_arguments
from mo_deepdrive.world.scenarios import VERSIONS

Array = NDArray[np.float32]


class DrivingParallelEnv(World, ParallelEnv[str, Array, Any]):  # type: ignore[misc]  # PettingZoo has no types
    """The vehicles as PettingZoo agents with vector rewards, by MOMAland's conventions.

    ## Description

    At the intersection ``vehicle_0`` turns left across the path of ``vehicle_1``, which drives straight on; the other
    scenarios have only ``vehicle_0``, but for Roundabout, which has 2 to 16. All vehicles move together, and none sees
    another's choice. Action, observation and reward spaces and starting states are those of the Gymnasium environments
    (see :class:`mo_deepdrive.envs.turn_based.TurnBasedEnv` and :class:`mo_deepdrive.envs.single.DrivingEnv`).

    ## Episode End

    When a vehicle ends, the step returns its last observation and reward, its ``terminated`` or ``truncated`` flag and
    ``infos[agent] = {"end": why, "success": whether it arrived}``, and removes it from ``agents``. The others
    continue. The episode is over when ``agents`` is empty.

    ## Version History

    As of the Gymnasium environments. The default is the newest version; the arguments of an earlier one are
    ``gymnasium.spec("mo-deepdrive-intersection-v0").kwargs``.

    Args:
        scenario: "intersection", or any other scenario.
        render_mode: None, "rgb_array" or "human".
        keep_finished: keep a vehicle that has ended in ``agents`` until the episode is over, for wrappers that need
            every agent in every step, such as MOMAland's RecordEpisodeStatistics and CentraliseAgent. Its observation
            is the last one, its reward is zero, its flags are False until the last step, and its actions, which are
            still required, are ignored. Its ``infos`` are those of its end in the step in which it ends.
        **options: fields of :class:`mo_deepdrive.world.config.EnvConfig`.

    Attributes:
        objectives: names of the reward's components, in order.
        reward_dim: their number, d.
        observation_spaces: per agent.
        observation_scales: (size,) nominal magnitudes of the observation of an agent, by which learners divide.
        action_spaces: per agent.
        reward_spaces: per agent.
        state_space: the space of :meth:`state`.

    Raises:
        TypeError: for unknown arguments.
        ValueError: for invalid values.
    """

    metadata: dict[str, Any] = {
        **World.metadata,
        "name": "mo_deepdrive_v1",
        "is_parallelizable": True,
        "central_observation": True,
    }

    def __init__(
        self,
        scenario: str = "intersection",
        render_mode: str | None = None,
        keep_finished: bool = False,
        **options: Any,
    ):
        if not isinstance(keep_finished, (bool, np.bool_)):
            raise ValueError(f"keep_finished = {keep_finished!r} must be True or False")
        version, newest = list(VERSIONS.get(str(scenario), {"v0": {}}).items())[-1]
        config = parse_arguments(scenario, {**newest, **options})
        super().__init__(config, render_mode)
        self.keep_finished = bool(keep_finished)
        self.metadata["name"] = f"mo_deepdrive_{scenario}_{version}"
        vehicles = self.batch.scenario.vehicles
        self.possible_agents = [f"vehicle_{v}" for v in range(vehicles)]
        self.agents: list[str] = []
        self._index = {agent: v for v, agent in enumerate(self.possible_agents)}
        self.observation_spaces = {agent: env_spaces.observation_space(config) for agent in self.possible_agents}
        self.action_spaces = {agent: env_spaces.action_space(config) for agent in self.possible_agents}
        self.reward_spaces = {agent: env_spaces.reward_space(config) for agent in self.possible_agents}
        seen = self.observation_spaces[self.possible_agents[0]]
        self.state_space = spaces.Box(np.tile(seen.low, vehicles), np.tile(seen.high, vehicles), dtype=np.float32)
        self._np_random: np.random.Generator | None = None
        # For each vehicle: whether it is on the road, and its last observation if it is not.
        self._driving = [True] * vehicles
        self._last = [np.zeros_like(row) for row in self.batch.observations[0]]
        self._joint = self.joint_action()

    def observation_space(self, agent: str) -> spaces.Box:
        """The observations of ``agent``: float32 in SI units."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete | spaces.Box:
        """The actions of ``agent``."""
        return self.action_spaces[agent]

    def reward_space(self, agent: str) -> spaces.Box:
        """The vector rewards of ``agent``: float32, shape (d,)."""
        return self.reward_spaces[agent]

    def get_central_observation_space(self) -> spaces.Box:
        """The space of :meth:`state`, by the name that MOMAland's CentraliseAgent uses."""
        return self.state_space

    def state(self) -> Array:
        """The concatenated last observations of all vehicles: float32, (vehicles * size,)."""
        return np.concatenate([self._observation(v) for v in self._index.values()])

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """Start a new episode: observations and (empty) infos per agent.

        The seed is that of the random stream, which None continues; the options are those of the Gymnasium environments
        (``{"starts": ...}`` at the intersection). Unknown names are ignored with a warning, because PettingZoo's own
        checks pass one. A ValueError for an invalid seed, or options without a valid scenario; nothing changes.
        """
        given, known = checked_options(options), option_names(self.batch.scenario)
        unknown = [name for name in given if name not in known]
        if unknown:
            warnings.warn(f"unknown reset option {unknown[0]!r} is ignored; {nearest(unknown[0], known)}", stacklevel=2)
        generator = self._np_random
        if seed is not None or generator is None:
            generator, _ = seeding.np_random(checked_seed(seed))
        self.place(generator, {name: value for name, value in given.items() if name in known})
        self._np_random = generator
        self.agents = list(self.possible_agents)
        self._driving = [True] * len(self.agents)
        observations = {agent: self._observation(v).copy() for agent, v in self._index.items()}
        return observations, {agent: {} for agent in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Array], dict[str, Array], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move all vehicles by one decision, with an action for every agent in ``agents``, and no others.

        Returns observations (size,), vector rewards (d,), terminated, truncated and infos of every agent that acted.
        ResetNeeded before the first reset and after the end of an episode; a ValueError for missing or other agents and
        for actions outside the action space, where nothing changes.
        """
        if not self.agents:
            raise ResetNeeded("step() before reset() or after the end of an episode")
        self._choose(actions)
        self.move(self._joint)
        batch = self.batch
        terminated, truncated = batch.terminated[0].tolist(), batch.truncated[0].tolist()
        observations, rewards, terminations, truncations = {}, {}, {}, {}
        infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        for agent in self.agents:
            v = self._index[agent]
            if self._driving[v] and (terminated[v] or truncated[v]):
                self._driving[v] = False
                self._last[v] = batch.observations[0, v].copy()
                infos[agent] = self.end_info(v)
            observations[agent] = self._observation(v).copy()
            rewards[agent] = batch.rewards[0, v].copy()
            terminations[agent], truncations[agent] = terminated[v], truncated[v]
        if self.keep_finished and any(self._driving):
            terminations, truncations = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, False)
        elif not all(self._driving):
            self.agents = [agent for agent in self.agents if self._driving[self._index[agent]]]
        return observations, rewards, terminations, truncations, infos

    def _observation(self, v: int) -> Array:
        """The current observation of a vehicle, or its last one."""
        observation: Array = self.batch.observations[0, v] if self._driving[v] else self._last[v]
        return observation

    def _choose(self, actions: Mapping[str, Any]) -> None:
        """Check the actions of all agents and write them into the joint action."""
        if not isinstance(actions, Mapping):
            raise ValueError(f"actions = {actions!r} must be a dict with an action for each of {self.agents}")
        if actions.keys() != set(self.agents):
            missing = [agent for agent in self.agents if agent not in actions]
            others = [agent for agent in actions if agent not in self.agents]
            wrong = [
                f"{what} {names}" for what, names in (("are missing for", missing), ("are given for", others)) if names
            ]
            raise ValueError(f"actions {' and '.join(wrong)}; expected one for each of {self.agents} and no more")
        for agent in self.agents:
            self._joint[0, self._index[agent]] = self.checked(actions[agent], agent)


class CheckedSteps(BaseWrapper[str, Array, Any]):  # type: ignore[misc]  # PettingZoo has no types
    """Refuses an invalid action at once; the conversion to AEC would do so only when the world moves.

    ResetNeeded before the first reset and after the end of an episode; a ValueError for an action outside the action
    space, or one other than None for a vehicle that has ended.
    """

    def step(self, action: Any) -> None:
        """Choose the action of ``agent_selection``; None for a vehicle that has ended."""
        if not getattr(self.env, "agents", None):
            raise ResetNeeded("step() before reset() or after the end of an episode")
        agent = self.agent_selection
        if not (self.terminations[agent] or self.truncations[agent]):
            self.unwrapped.checked(action, agent)
        elif action is not None:
            raise ValueError(f"action {action!r} of {agent}, which has ended, must be None")
        super().step(action)


def aec_env(parallel: DrivingParallelEnv) -> AECEnv[str, Array, Any]:
    """``parallel`` as an AEC environment, converted by MOMAland; an ImportError if that is not installed."""
    with needed_for("the AEC environment"):
        from momaland.utils.conversions import mo_parallel_to_aec
    return CheckedSteps(mo_parallel_to_aec(parallel))
