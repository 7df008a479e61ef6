"""Wrappers: a scalar reward instead of a vector reward, for libraries that need one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from mo_deepdrive.names import nearest
from mo_deepdrive.utilities import Utility, make_utility

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pettingzoo import ParallelEnv

Measure = Literal["reward", "return"]


class UtilityReward(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Makes the reward the utility of the vector reward; the vector is ``info["vector_reward"]``.

    Everything else is unchanged. It wraps any Gymnasium environment with vector rewards, of this package or of
    MO-Gymnasium::

        env = UtilityReward(mo_gymnasium.make("mo-deepdrive-one-waypoint-v0"), "one_waypoint_linear")

    With a linear utility the sum of the utilities is the utility of the sum, so both values of ``of`` give the same
    problem. With any other utility they differ:

    - ``of="reward"``: the reward of a decision is u(r_t), as in the paper's A2C;
    - ``of="return"``: it is u(R_{t+1}) - u(R_t), the increase of the utility of the accrued reward R_t = sum over i < t
      of r_i. The rewards of an episode sum to u(return) - u(0), so an agent that maximises their undiscounted sum
      maximises the expected utility (ESR). The best action may then depend on R_t, which is not observed.

    Args:
        env: an environment with vector rewards (d,) and ``reward_space``.
        utility: a name, as :func:`mo_deepdrive.utilities.make_utility` takes it, or a utility.
        of: "reward" or "return".
        **arguments: arguments of a utility given by name, for example ``weights``.

    Attributes:
        utility: the utility.
        reward_space: unbounded, float32, shape (); that of the vector is ``unwrapped.reward_space``.
        reward_dim: 1.

    Raises:
        ValueError: if the environment has no vector rewards, or the utility is unknown or does not fit them.
    """

    reward_dim = 1

    def __init__(self, env: gymnasium.Env[Any, Any], utility: str | Utility, of: Measure = "reward", **arguments: Any):
        gymnasium.utils.RecordConstructorArgs.__init__(self, utility=utility, of=of, **arguments)
        gymnasium.Wrapper.__init__(self, env)
        space = env.get_wrapper_attr("reward_space") if env.has_wrapper_attr("reward_space") else None
        names = env.get_wrapper_attr("objectives") if env.has_wrapper_attr("objectives") else None
        self.utility = _fitting_utility(utility, env, space, names, arguments)
        self.reward_space = _scalar_space()
        self._scalar_rewards = _ScalarRewards(of)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._scalar_rewards.reset([info.get("vehicle", 0)])
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act for one decision.

        Returns:
            observation, utility, terminated, truncated, and info with the vector reward (d,).
        """
        observation, vector, terminated, truncated, info = self.env.step(action)
        # If vehicles take turns, each has its own return, and before its first turn it has made no decision.
        vehicle = info.get("vehicle", 0)
        value = self._scalar_rewards.of(self.utility, vector, vehicle)
        self._scalar_rewards.deciding.add(vehicle)
        return observation, value, terminated, truncated, {**info, "vector_reward": vector}


class ParallelUtilityReward(BaseParallelWrapper[str, Any, Any]):  # type: ignore[misc]  # PettingZoo has no types
    """:class:`UtilityReward` for PettingZoo's parallel environments: an agent's reward is the utility of its vector.

    The vector is ``infos[agent]["vector_reward"]``; everything else is unchanged. It wraps any parallel environment
    with vector rewards, of this package or of MOMAland::

        env = ParallelUtilityReward(mo_deepdrive.parallel_env(), "intersection_linear")

    Args:
        env: a parallel environment with vector rewards (d,) and ``reward_space(agent)``.
        utility: a name or a utility for all agents, or a dict with one of these for each.
        of: "reward" or "return", as for :class:`UtilityReward`.
        **arguments: arguments of utilities given by name, for example ``weights``.

    Attributes:
        utilities: per agent.
        reward_spaces: per agent, unbounded, float32, shape ().
        reward_dim: 1.

    Raises:
        ValueError: if the environment has no vector rewards, a utility is unknown or does not fit them, or the agents
            of ``utility`` are not those of the environment.
    """

    reward_dim = 1

    def __init__(
        self,
        env: ParallelEnv[str, Any, Any],
        utility: str | Utility | Mapping[str, str | Utility],
        of: Measure = "reward",
        **arguments: Any,
    ):
        super().__init__(env)
        agents = list(env.possible_agents)
        given = dict(utility) if isinstance(utility, Mapping) else dict.fromkeys(agents, utility)
        for agent in given:
            if agent not in agents:
                raise ValueError(f"utility is given for {agent!r}, which is unknown; {nearest(agent, agents)}")
        space_of = getattr(env, "reward_space", lambda _agent: None)
        # Not every wrapper passes attributes on.
        names = getattr(env, "objectives", getattr(env.unwrapped, "objectives", None))
        self.utilities: dict[str, Utility] = {}
        for agent in agents:
            if agent not in given:
                raise ValueError(f"utility is missing for {agent!r}; expected one for each of {agents}")
            self.utilities[agent] = _fitting_utility(given[agent], env, space_of(agent), names, arguments)
        self.reward_spaces = {agent: _scalar_space() for agent in agents}
        self._scalar_rewards = _ScalarRewards(of)

    def reward_space(self, agent: str) -> spaces.Box:
        """The rewards of ``agent``: float32, shape ()."""
        return self.reward_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Start a new episode."""
        started: tuple[dict[str, Any], dict[str, dict[str, Any]]] = self.env.reset(seed=seed, options=options)
        self._scalar_rewards.reset(self.env.possible_agents)
        return started

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move all agents by one decision.

        Returns:
            observations, utilities, terminated, truncated, and infos with the vector rewards (d,).
        """
        observations, vectors, terminated, truncated, infos = self.env.step(actions)
        rewards = {
            agent: self._scalar_rewards.of(self.utilities[agent], vector, agent) for agent, vector in vectors.items()
        }
        # An agent may stay after its end (keep_finished), without decisions.
        self._scalar_rewards.deciding.difference_update(agent for agent, info in infos.items() if "end" in info)
        infos = {agent: {**infos.get(agent, {}), "vector_reward": vector} for agent, vector in vectors.items()}
        return observations, rewards, terminated, truncated, infos


class _ScalarRewards:
    """Scalar rewards by a utility of the vector reward, or by its increase at the accrued reward of the episode.

    Attributes:
        deciding: the agents whose vector reward is that of a decision; the reward of the others is 0, not u(0).
    """

    def __init__(self, measure: Measure):
        if measure not in get_args(Measure):
            raise ValueError(f"of = {measure!r} must be one of {list(get_args(Measure))}")
        self._measure = measure
        self._accrued: dict[Any, NDArray[np.float64]] = {}
        self.deciding: set[Any] = set()

    def reset(self, deciding: Iterable[Any]) -> None:
        """Start a new episode."""
        self._accrued = {}
        self.deciding = set(deciding)

    def of(self, utility: Utility, vector: Any, agent: Any) -> float:
        """The reward of an agent for its vector reward (d,)."""
        if agent not in self.deciding:
            return 0.0
        rewards = np.asarray(vector)
        if self._measure == "reward":
            return float(utility(rewards))
        before = self._accrued.get(agent, np.zeros(rewards.shape))
        after = before + rewards
        self._accrued[agent] = after
        return float(utility(after) - utility(before))


def _scalar_space() -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (), dtype=np.float32)


def _fitting_utility(
    utility: str | Utility, env: Any, space: Any, names: Sequence[str] | None, arguments: dict[str, Any]
) -> Utility:
    """The utility, if it fits vector rewards of ``env`` in ``space``, with components ``names`` (None if unknown)."""
    if space is None or len(space.shape) != 1:
        raise ValueError(f"a utility needs vector rewards; {env} has no reward_space of shape (d,)")
    objectives = tuple(f"objective_{i}" for i in range(space.shape[0])) if names is None else tuple(names)
    if isinstance(utility, str):
        cost_sign = getattr(getattr(env.unwrapped, "config", None), "cost_sign", "maximise")
        return make_utility(utility, objectives, cost_sign, **arguments)
    if arguments:
        raise ValueError(f"arguments {sorted(arguments)} are for a utility given by name")
    fits = len(utility.objectives) == len(objectives) if names is None else utility.objectives == objectives
    if not fits:
        raise ValueError(f"utility {utility.name!r} takes {utility.objectives}; the environment has {objectives}")
    return utility
