"""Wrappers: scalar rewards for libraries that need them, observations of like magnitude, and records of episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from pettingzoo.utils import BaseParallelWrapper

from mo_deepdrive.support.names import nearest
from mo_deepdrive.support.plain_values import finite_numbers
from mo_deepdrive.utilities import Utility, fitting_utility

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pettingzoo import ParallelEnv

Measure = Literal["reward", "return"]


class UtilityReward(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Makes the reward the utility of the vector reward; the vector is ``info["vector_reward"]``.

    Everything else is unchanged. It wraps any Gymnasium environment with vector rewards, of this package or of
    MO-Gymnasium (:class:`VectorUtilityReward` wraps vector environments)::

        env = UtilityReward(mo_gymnasium.make("mo-deepdrive-one-waypoint-v1"), "one_waypoint_linear")

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
        if isinstance(env, VectorEnv):
            raise ValueError(f"{env} is a vector environment: VectorUtilityReward wraps it")
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


class VectorUtilityReward(VectorWrapper):  # not generic in Gymnasium 1.2
    """:class:`UtilityReward` for vector environments: row i is bit for bit what it gives for environment i alone.

    The vectors are ``infos["vector_reward"]``; everything else is unchanged. It wraps any vector environment with
    vector rewards, of this package or of MO-Gymnasium::

        envs = VectorUtilityReward(gymnasium.make_vec("mo-deepdrive-left-turn-v1", num_envs=16), "left_turn_linear")

    With two vehicles rewards are (N, 2), each by the vehicle's own rewards. A vehicle that has ended, and an
    environment that is only reset (NEXT_STEP), have the reward 0. The accrued reward starts anew with every episode,
    in every autoreset mode.

    Arguments, attributes and errors are those of :class:`UtilityReward`, but for the shapes: rewards are (N, d) or
    (N, V, d), a utility is one of returns (..., d), and ``reward_space``, of one environment, is () or (V,).
    """

    reward_dim = 1

    def __init__(self, env: VectorEnv[Any, Any, Any], utility: str | Utility, of: Measure = "reward", **arguments: Any):
        super().__init__(env)
        inner: Any = env.unwrapped
        space = None if _is_scalar(env) else getattr(inner, "reward_space", None)
        self._vehicles = () if space is None else space.shape[:-1]
        single = inner.envs[0] if getattr(inner, "envs", None) else None
        names = getattr(inner, "objectives", None)
        if names is None and single is not None and single.has_wrapper_attr("objectives"):
            names = single.get_wrapper_attr("objectives")
        d = None if space is None or not space.shape else spaces.Box(-np.inf, np.inf, space.shape[-1:])
        self.utility = _fitting_utility(utility, env, d, names, arguments)
        self._measure = _checked_measure(of)
        self.reward_space = _scalar_space(self._vehicles)
        self._restart(np.ones(env.num_envs, dtype=np.bool_))

    def _restart(self, rows: NDArray[np.bool_]) -> None:
        """Start new episodes in ``rows`` (N,)."""
        if rows.all():
            shape = (self.num_envs, *self._vehicles)
            self._accrued = np.zeros((*shape, len(self.utility.objectives)))
            self._ended = np.zeros(shape, dtype=np.bool_)
        self._accrued[rows] = 0.0
        self._ended[rows] = False

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; where ``options`` have a ``"reset_mask"`` (N,), in its environments alone."""
        started = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]  # a list is fine, too
        if "vehicle" in started[1]:
            raise ValueError(
                f"vehicles take turns in {self.env}: gymnasium.make_vec makes one in which they act together"
            )
        mask = (options or {}).get("reset_mask")
        self._restart(np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask)
        return started

    def step(self, actions: Any) -> tuple[Any, NDArray[np.float64], Any, Any, dict[str, Any]]:
        """Act for one decision in every environment.

        Returns:
            observations, utilities (N,) or (N, V), terminated, truncated, and infos with the vector rewards.
        """
        observations, vectors, terminated, truncated, infos = self.env.step(actions)
        if self._measure == "reward":
            values = self.utility(vectors)
        else:
            after = self._accrued + vectors
            values = self.utility(after) - self.utility(self._accrued)
            self._accrued = after
        rewards = np.where(self._ended, 0.0, np.asarray(values, dtype=np.float64))
        self._ended = np.array(terminated | truncated)
        over = self._ended.reshape(self.num_envs, -1).all(axis=1)
        self._accrued[over] = 0.0
        if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
            self._ended[over] = False
        infos = {**infos, "vector_reward": vectors, "_vector_reward": np.ones(self.num_envs, dtype=np.bool_)}
        return observations, rewards, terminated, truncated, infos


class VectorEpisodeStatistics(VectorWrapper):  # not generic in Gymnasium 1.2
    """Records the returns and lengths of episodes with vector rewards, in every autoreset mode.

    In a step in which an episode ends, ``infos["episode"]`` has, in the rows where ``infos["_episode"]``, the return
    "r" and the discounted return "dr", float64 in the shape of the rewards, and the number of decisions "l" (N,).

    Args:
        env: a vector environment with rewards (N, ...), of this package or of MO-Gymnasium.
        gamma: the discount factor of "dr".

    Raises:
        ValueError: if gamma is not between 0 and 1.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], gamma: float = 1.0):
        super().__init__(env)
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"gamma = {gamma!r} must be between 0 and 1")
        self._gamma = gamma
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._only_reset = np.zeros(env.num_envs, dtype=np.bool_)  # what the next step does with an environment
        self._returns = self._discounted = np.zeros(())

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; where ``options`` have a ``"reset_mask"`` (N,), in its environments alone."""
        started = self.env.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask")
        self._restart(np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask)
        self._only_reset[:] = False
        return started

    def _restart(self, rows: NDArray[np.bool_]) -> None:
        self._lengths[rows] = 0
        if self._returns.shape:
            self._returns[rows] = self._discounted[rows] = 0.0

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Act for one decision in every environment."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        discounts = (self._gamma**self._lengths).reshape(-1, *[1] * (rewards.ndim - 1))
        self._returns = self._returns + rewards  # zeros where an environment is only reset
        self._discounted = self._discounted + discounts * rewards
        self._lengths += ~self._only_reset
        over: Any = (terminated | truncated).reshape(self.num_envs, -1).all(axis=1)
        if over.any():
            statistics = {"r": self._returns.copy(), "dr": self._discounted.copy(), "l": self._lengths.copy()}
            infos = {**infos, "episode": statistics, "_episode": over}
            self._restart(over)
        self._only_reset = over & (self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP)
        return observations, rewards, terminated, truncated, infos


class ParallelUtilityReward(BaseParallelWrapper[str, Any, Any]):  # type: ignore[misc]  # PettingZoo has no types
    """:class:`UtilityReward` for PettingZoo's parallel environments: an agent's reward is the utility of its vector.

    The vector is ``infos[agent]["vector_reward"]``; everything else is unchanged. It wraps any parallel environment
    with vector rewards, of this package or of MOMAland::

        env = ParallelUtilityReward(mo_deepdrive.parallel_env(), "intersection_linear")

    The ``utility`` may also be a dict with a name or a utility for each agent, and ``utilities`` and ``reward_spaces``
    are per agent; other arguments, attributes and errors are those of :class:`UtilityReward`.
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
        check_agents("utility", given, agents)
        space_of = getattr(env, "reward_space", lambda _agent: None)
        # Not every wrapper passes attributes on.
        names = getattr(env, "objectives", getattr(env.unwrapped, "objectives", None))
        self.utilities: dict[str, Utility] = {}
        for agent in agents:
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


def check_agents(name: str, given: Mapping[str, Any], agents: Sequence[str]) -> None:
    """Refuse what is not ``given`` for all agents, or for others.

    The ValueError has the ``name`` of what is given, and the first agent that is unknown or missing.
    """
    for agent in given:
        if agent not in agents:
            raise ValueError(f"{name} is given for {agent!r}, which is unknown; {nearest(agent, agents)}")
    for agent in agents:
        if agent not in given:
            raise ValueError(f"{name} is missing for {agent!r}; expected one for each of {agents}")


class _ScalarRewards:
    """Scalar rewards by a utility of the vector reward, or by its increase at the accrued reward of the episode.

    Attributes:
        deciding: the agents whose vector reward is that of a decision; the reward of the others is 0, not u(0).
    """

    def __init__(self, measure: Measure):
        self._measure = _checked_measure(measure)
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


def _checked_measure(measure: Measure) -> Measure:
    if measure not in get_args(Measure):
        raise ValueError(f"of = {measure!r} must be one of {list(get_args(Measure))}")
    return measure


def _scalar_space(vehicles: tuple[int, ...] = ()) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, vehicles, dtype=np.float32)


def _is_scalar(env: Any) -> bool:
    """Whether a wrapper of the vector environment ``env`` has made its rewards scalar."""
    return isinstance(env, VectorWrapper) and (isinstance(env, VectorUtilityReward) or _is_scalar(env.env))


def _fitting_utility(
    utility: str | Utility, env: Any, space: Any, names: Sequence[str] | None, arguments: dict[str, Any]
) -> Utility:
    """The utility, if it fits vector rewards of ``env`` in ``space``, with components ``names`` (None if unknown)."""
    if space is None or len(space.shape) != 1:
        raise ValueError(f"a utility needs vector rewards; {env} has no reward_space of shape (d,)")
    objectives = tuple(f"objective_{i}" for i in range(space.shape[0])) if names is None else tuple(names)
    cost_sign = getattr(getattr(env.unwrapped, "config", None), "cost_sign", "maximise")
    return fitting_utility(utility, objectives, cost_sign, named=names is not None, **arguments)


class ScaledObservation(gymnasium.ObservationWrapper[Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Divides observations by nominal magnitudes: those in SI units differ a hundredfold, which networks learn badly.

    It is what the package's own algorithms do. A policy that is trained with it divides its observations, too, where it
    is evaluated: ``observations / env.unwrapped.observation_scales``.

    Args:
        env: an environment with observations in a Box.
        scales: positive, in the shape of an observation; by default ``env.unwrapped.observation_scales``.

    Attributes:
        scales: float32.

    Raises:
        ValueError: if there are no such scales, or observations are in no Box.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], scales: Any = None):
        gymnasium.utils.RecordConstructorArgs.__init__(self, scales=scales)
        gymnasium.ObservationWrapper.__init__(self, env)
        self.scales = _checked_scales(scales, env, env.observation_space)
        self.observation_space = _divided(env.observation_space, self.scales)

    def observation(self, observation: Any) -> Any:
        """The scaled observation."""
        return _scaled(observation, self.scales)


class VectorScaledObservation(VectorWrapper):  # not generic in Gymnasium 1.2
    """:class:`ScaledObservation` for vector environments, in every autoreset mode: ``final_obs`` is scaled, too.

    Arguments, attributes and errors are those of :class:`ScaledObservation`; the scales may have the last axes of an
    observation alone.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], scales: Any = None):
        super().__init__(env)
        self.scales = _checked_scales(scales, env, env.single_observation_space)
        self.single_observation_space = _divided(env.single_observation_space, self.scales)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new episodes."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return _scaled(observations, self.scales), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Act for one decision in every environment."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        if "final_obs" in infos:
            infos = {**infos, "final_obs": _scaled(infos["final_obs"], self.scales)}
        return _scaled(observations, self.scales), rewards, terminated, truncated, infos


def _scaled(observations: Any, scales: NDArray[np.float32]) -> Any:
    """Observations divided by ``scales``; Gymnasium has an array of objects with None where there is no last one."""
    if isinstance(observations, np.ndarray) and observations.dtype.kind == "O":
        scaled = np.empty(len(observations), dtype=object)
        scaled[:] = [None if row is None else _scaled(row, scales) for row in observations]
        return scaled
    return np.asarray(observations / scales, dtype=np.float32)


def _checked_scales(scales: Any, env: Any, space: spaces.Space[Any]) -> NDArray[np.float32]:
    """The scales of observations in ``space``, by default those of ``env``."""
    if not isinstance(space, spaces.Box):
        raise ValueError(f"observation space {space} of {env} must be a Box")
    given = getattr(env.unwrapped, "observation_scales", None) if scales is None else scales
    if given is None:
        raise ValueError(f"{env} has no observation_scales; give scales in the shape of an observation: {space.shape}")
    numbers = finite_numbers(given)
    if numbers is None or not (numbers > 0).all() or numbers.shape != space.shape[len(space.shape) - numbers.ndim :]:
        raise ValueError(f"scales = {given!r} must be positive numbers in the shape of an observation: {space.shape}")
    return numbers.astype(np.float32)


def _divided(space: Any, scales: NDArray[np.float32]) -> spaces.Box:
    return spaces.Box((space.low / scales).astype(np.float32), (space.high / scales).astype(np.float32))
