"""The RLlib environment (new API stack): the parallel environment with scalar rewards, by a utility.

It needs Ray, which nothing else in the package imports: ``pip install --editable ".[rllib]"``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mo_deepdrive.envs.options import make_pins
from mo_deepdrive.envs.parallel import DrivingParallelEnv
from mo_deepdrive.support.extras import needed_for
from mo_deepdrive.support.names import nearest
from mo_deepdrive.utilities import Utility, make_utility
from mo_deepdrive.world.config import EnvConfig, UtilityChoice, parse
from mo_deepdrive.wrappers import ParallelUtilityReward, check_agents

with needed_for("mo_deepdrive.envs.rllib", extra="rllib"):
    from ray.rllib.env.multi_agent_env import MultiAgentEnv

Array = NDArray[np.float32]
KEYS = (*EnvConfig.model_fields, "utility", "render_mode")


class DrivingMultiAgentEnv(MultiAgentEnv):  # type: ignore[misc]  # Ray's types are not followed
    """The vehicles as RLlib agents with scalar rewards.

    RLlib needs scalar rewards. The reward of a vehicle is the utility of the vector reward of one decision, so the sum
    of utilities over time is maximised; for a non-linear utility it differs from the utility of the summed rewards. The
    vector is ``infos[agent]["vector_reward"]``, float32 of shape (d,).

    Agents, spaces, episodes and versions are those of :class:`mo_deepdrive.envs.parallel.DrivingParallelEnv`: when a
    vehicle ends, it has ``infos[agent]["end"]`` and ``["success"]`` with its last observation and leaves ``agents``.

    Args:
        config: a dict, as in ``AlgorithmConfig.environment(env_config=...)``, with the keys

            - ``"scenario"``: "intersection" (default), or any other scenario;
            - ``"utility"``: a name, or ``{"name": ..., "arguments": {...}}``, or a dict with one of these for every
              vehicle; by default the paper's linear utility of the scenario;
            - ``"render_mode"``: None, "rgb_array" or "human";
            - any other field of :class:`mo_deepdrive.world.config.EnvConfig`.

    Attributes are those of the parallel environment, and ``utilities`` per vehicle.

    Raises:
        ValueError: for unknown keys, vehicles or utilities, and for a utility that does not fit the objectives.
    """

    metadata: dict[str, Any] = DrivingParallelEnv.metadata

    def __init__(self, config: Mapping[str, Any] | None = None):
        super().__init__()
        options = dict(config or {})
        for key in options:
            if key not in KEYS:
                raise ValueError(f"unknown key {key!r} in the env config; {nearest(key, KEYS)}")
        utility = options.pop("utility", None)
        env = DrivingParallelEnv(**options)
        self.config = env.config
        self.metadata = env.metadata
        self.render_mode = env.render_mode
        self.objectives = env.objectives
        self.reward_dim = env.reward_dim
        self.possible_agents = list(env.possible_agents)
        self.agents: list[str] = []
        self.observation_spaces = env.observation_spaces
        self.observation_scales = env.observation_scales
        self.action_spaces = env.action_spaces
        self.reward_spaces = env.reward_spaces
        self.parallel = ParallelUtilityReward(env, _utilities(utility, env))
        self.utilities = self.parallel.utilities

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """Start a new episode; ``seed`` and ``options`` as in the Gymnasium environments.

        A ValueError for unknown options and for options without a valid scenario; nothing changes.
        """
        # The parallel environment would ignore unknown ones.
        make_pins(options, self.config)
        observations, infos = self.parallel.reset(seed=seed, options=options)
        self.agents = list(self.parallel.agents)
        return observations, infos

    def step(
        self, action_dict: Mapping[str, Any]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move all vehicles by one decision; actions and errors are those of the parallel environment.

        Returns observations, utilities, terminated, truncated and infos. ``terminated`` has every vehicle that acted.
        ``truncated`` has "__all__" alone: the time limit ends the episode for all vehicles on the road, and with a flag
        per vehicle RLlib would treat a truncated vehicle as terminated and not bootstrap. At the end of an episode
        exactly one of the two "__all__" flags is True.
        """
        observations, rewards, terminations, truncations, infos = self.parallel.step(action_dict)
        self.agents = list(self.parallel.agents)
        truncated = any(truncations.values())
        flags = {**terminations, "__all__": not self.agents and not truncated}, {"__all__": truncated}
        return observations, rewards, *flags, infos

    def render(self) -> NDArray[np.uint8] | None:
        """An RGB frame (height, width, 3) for "rgb_array"; draws in a window for "human"."""
        frame: NDArray[np.uint8] | None = self.parallel.render()
        return frame

    def close(self) -> None:
        """Close the renderer."""
        self.parallel.close()


def _utilities(choice: Any, env: DrivingParallelEnv) -> dict[str, Utility]:
    """The utility of every vehicle, from the "utility" of an env config."""
    if choice is None:
        choice = f"{env.config.scenario}_linear"
    if isinstance(choice, str) or (isinstance(choice, Mapping) and "name" in choice):
        choice = dict.fromkeys(env.possible_agents, choice)
    if not isinstance(choice, Mapping):
        raise ValueError(f"utility = {choice!r} must be a name, a dict with 'name' and 'arguments', or one per vehicle")
    check_agents("utility", choice, env.possible_agents)
    return {agent: _utility(each, agent, env) for agent, each in choice.items()}


def _utility(choice: Any, agent: str, env: DrivingParallelEnv) -> Utility:
    if isinstance(choice, str):
        choice = {"name": choice}
    if not isinstance(choice, Mapping):
        raise ValueError(f"utility of {agent} = {choice!r} must be a name or a dict with 'name' and 'arguments'")
    settings = parse(UtilityChoice, choice, f"utility of {agent}")
    utility = make_utility(settings.name, env.objectives, env.config.cost_sign, **settings.arguments)
    shape = np.shape(utility(np.zeros(env.reward_dim, dtype=np.float32)))
    if shape:
        raise ValueError(f"utility {settings.name!r} of {agent} gives shape {shape} for one reward; expected a number")
    return utility
