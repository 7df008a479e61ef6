"""A common interface to all training environments.

`make_env` gives the native vector environment for our ids and MOSyncVectorEnv for any other MO-Gymnasium id;
`EnvAdapter` presents both in the shapes (environments, vehicles, ...) with true final observations and a mask of the
samples that count.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import mo_gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

import mo_deepdrive  # noqa: F401  (registers the ids)
from mo_deepdrive.simulation.state import ARRIVED
from mo_deepdrive.support.faults import EndlessEpisode, check_vehicles
from mo_deepdrive.world.config import is_ours
from mo_deepdrive.world.objectives import scales as objective_scales
from mo_deepdrive.world.objectives import signs as objective_signs

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from gymnasium.envs.registration import EnvSpec
    from numpy.typing import NDArray

    from mo_deepdrive.envs.vector import DrivingVectorEnv

LONGEST_EPISODE = 10_000  # decisions of other libraries' environments whose id has no max_episode_steps
FORBIDDEN = set(" \t\n/:=")  # in names of objectives, which are parts of metrics' names and of command lines


def find_spec(env_id: str) -> EnvSpec:
    """The specification of a registered id, or of ``module:id`` after importing the module that registers it."""
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    return gymnasium.spec(name)


def is_drivable(env_id: str) -> bool:
    """Whether an environment is one of this package, whose drives can be recorded."""
    return is_ours(find_spec(env_id))


def make_env(
    env_id: str, num_envs: int, arguments: dict[str, Any] | None = None, *, keep_ended: bool = False
) -> VectorEnv:
    """A vector environment with vector rewards (N, d) of ``num_envs`` copies of a MO-Gymnasium environment.

    Args:
        env_id: a registered id, or ``module:id`` to import the module that registers it first.
        num_envs: N.
        arguments: keyword arguments of the environment.
        keep_ended: leave worlds of this package as they are in the step in which an episode ends.

    Raises:
        ValueError: if worlds of this package cannot fit into memory.
    """
    arguments = arguments or {}
    if is_drivable(env_id):
        mode = AutoresetMode.NEXT_STEP if keep_ended else AutoresetMode.SAME_STEP
        return gymnasium.make_vec(env_id, num_envs=num_envs, autoreset_mode=mode, **arguments)
    return MOSyncVectorEnv(iter([lambda: mo_gymnasium.make(env_id, **arguments)] * num_envs))


class Step(NamedTuple):
    """One step of N environments: arrays, or a learner's tensors with an axis of seeds in front."""

    observations: Any  #: (N, V, o) for the next action; where an episode ended, the first of the next episode.
    rewards: Any  #: (N, V, d)
    terminated: Any  #: (N, V) whether the vehicle's episode ended in this step.
    truncated: Any
    #: (N, V) False where the sample does not count: the vehicle had finished already, or the environment was reset.
    acted: Any
    final: Any  #: (N, V, o) observations after the step; where an episode ended, the last of that episode.
    #: (N, V) whether an episode that ended in this step reached its goal; all False where the environment does not
    #: report it.
    succeeded: Any
    #: (N,) or (N, V) why episodes ended, from ``info["end"]``; None where that is not reported, and for learners.
    ends: Any = None


class EnvAdapter:
    """A vector environment in the trainers' shapes.

    Args:
        env: a vector environment with vector rewards: DrivingVectorEnv under SAME_STEP, or MOSyncVectorEnv.
        keep_ended: whether it is one of :func:`make_env` with ``keep_ended``, for one episode at a time.

    Attributes:
        name: the id of the environment, or its class where it has no id.
        num_envs, vehicles: N and V.
        objectives: names of the d components of the reward; "objective_0" and so on where they are not ``named``.
        repeats: whether every episode is the same but for what is done in it; None where that is not known.
        cost_sign: "maximise", or "paper" where our environment emits magnitudes.
        observation_scales: (o,) nominal magnitudes.
        objective_scales: (d,) nominal magnitudes of a return.
        costs: (d,) whether more of the objective is worse; of other libraries, whether no reward can be positive.
        actions: number of discrete actions, or of ``continuous`` axes.
        max_episode_steps: decisions after which an episode must have ended: the id's, or LONGEST_EPISODE.
        bare: our environment, if it is neither wrapped nor of a subclass, whose own ``step`` would have to be called.

    Raises:
        TypeError: for an environment that is no vector environment.
        ValueError: for spaces that the trainers do not handle, or an attribute ``objectives`` that does not give every
            component of the reward a name of its own.
    """

    def __init__(self, env: VectorEnv, *, keep_ended: bool = False):
        from mo_deepdrive.envs.vector import DrivingVectorEnv  # late, as the worlds are compiled

        if not isinstance(env, VectorEnv):
            raise TypeError(
                f"env = {env!r} must be a vector environment: mo_deepdrive.evaluation.env_adapter.make_env makes one"
            )
        self.vector_env = env
        self.num_envs = env.num_envs
        inner = env.unwrapped
        self.native = isinstance(inner, DrivingVectorEnv)
        single = inner if self.native else inner.envs[0]  # type: ignore[attr-defined]
        spec = env.spec if self.native else single.spec
        self.name = type(single.unwrapped).__name__ if spec is None else spec.id
        space = env.single_action_space
        if isinstance(inner, DrivingVectorEnv):
            if inner.autoreset_mode is not AutoresetMode.SAME_STEP and not keep_ended:
                raise ValueError(f"autoreset_mode = {inner.autoreset_mode} must be SAME_STEP for training")
            self.vehicles = inner.vehicles
            self.objectives: tuple[str, ...] = inner.objectives
            self.named = True
            self.cost_sign: str = inner.config.cost_sign
            scenario, config = inner.batch.scenario, inner.config
            still = config.fixed_obstacle or not scenario.obstacles
            self.repeats: bool | None = config.fixed_destination and still and not scenario.cars
            self.observation_scales = inner.observation_scales
            self.objective_scales = objective_scales(self.objectives).astype(np.float32)
            self.costs: NDArray[np.bool_] = objective_signs(self.objectives) < 0
            self.max_episode_steps = config.max_decisions
            if isinstance(space, spaces.MultiDiscrete):
                space = spaces.Discrete(int(space.nvec[0]))
        else:
            self.vehicles = 1
            rewards: spaces.Box = inner.reward_space  # type: ignore[attr-defined]
            d = int(rewards.shape[0])
            names = _objective_names(single, self.name, d)
            self.named = names is not None
            self.objectives = names or tuple(f"objective_{i}" for i in range(d))
            self.cost_sign = "maximise"
            self.repeats = None
            self.observation_scales = _scales_from_bounds(env.single_observation_space)
            self.objective_scales = np.ones(d, dtype=np.float32)
            self.costs = rewards.high <= 0.0
            self.max_episode_steps = (spec and spec.max_episode_steps) or LONGEST_EPISODE
        if isinstance(space, spaces.Discrete):
            self.continuous, self.actions = False, int(space.n)
            self._first_action = int(space.start)
        elif isinstance(space, spaces.Box):
            self.continuous, self.actions = True, int(space.shape[-1])
            if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
                raise ValueError(f"action space {space} must be bounded")
            self._centre = (space.high + space.low) / 2
            self._reach = (space.high - space.low) / 2
        else:
            raise ValueError(f"action space {space} is neither Discrete nor Box")
        self._action_shape = (self.num_envs, self.vehicles, *((self.actions,) if self.continuous else ()))
        self.observation_size = len(self.observation_scales)
        self._was_over = np.zeros((self.num_envs, 1), dtype=np.bool_)
        self.bare = env if type(env) is DrivingVectorEnv else None

    @property
    def joint_scales(self) -> NDArray[np.float32]:
        """(V d,) :attr:`objective_scales` for each vehicle in turn."""
        return np.tile(self.objective_scales, self.vehicles)

    def chosen_objective_scales(self, scales: Sequence[float] | None) -> NDArray[np.float32]:
        """``scales`` (d,), or the environment's own where they are None; a ValueError for another number of them."""
        if scales is None:
            return self.objective_scales
        if len(scales) != len(self.objectives):
            raise ValueError(
                f"objective_scales = {list(scales)} needs {len(self.objectives)} numbers: {self.objectives}"
            )
        return np.asarray(scales, dtype=np.float32)

    def reset(self, seed: int | list[int] | None = None) -> NDArray[np.float32]:
        """Reset every environment, the i-th with the seed ``seed + i`` or ``seed[i]``: observations (N, V, o)."""
        raw, _ = self.vector_env.reset(seed=seed)  # type: ignore[arg-type]  # a list is fine, says its documentation
        self._was_over[:] = False
        observations = self.policy_observations(raw)
        check_vehicles("observation", observations, self.name)
        return observations

    def decisions(self) -> Iterator[int]:
        """Count the decisions of episodes; every loop that drives episodes to their ends takes its turns from here.

        Raises:
            EndlessEpisode: after :attr:`max_episode_steps`.
        """
        yield from range(self.max_episode_steps)
        raise EndlessEpisode(
            f"an episode of {self.name} has not ended after {self.max_episode_steps:,} decisions; limit its length by "
            "max_episode_steps, where the id is registered or in environment.arguments (env_kwargs)"
        )

    def step(self, actions: NDArray[Any]) -> Step:
        """Act in every environment.

        The actions are (N, V) indices, or (N, V, k) with each axis in [-1, 1] (clipped and scaled to the box). Another
        shape is a ValueError; actions, rewards or observations that are not finite are NotFinite.
        """
        actions = np.asarray(actions)
        if actions.shape != self._action_shape:
            raise ValueError(f"actions of shape {actions.shape} must have shape {self._action_shape}")
        if self.continuous:
            check_vehicles("action", actions, self.name)
        step = self._step(actions)
        check_vehicles("reward", step.rewards, self.name, self.objectives)
        if self.bare is None:
            check_vehicles("observation", step.observations, self.name)
            check_vehicles("observation", step.final, self.name)
        return step

    def _step(self, actions: NDArray[Any]) -> Step:
        if self.bare is not None:
            return self._bare_step(self.bare, actions)
        actions = self.environment_actions(actions)
        if self.native:
            return self._native_step(actions)
        raw, rewards, terminated, truncated, infos = self.vector_env.step(actions)
        acted = ~self._was_over
        self._was_over = (terminated | truncated)[:, None]
        observations, vectors = self.policy_observations(raw), np.asarray(rewards, dtype=np.float32)[:, None]
        success = infos.get("success", np.zeros(self.num_envs, dtype=np.bool_)).astype(np.bool_)
        flags = terminated[:, None], truncated[:, None], acted
        return Step(observations, vectors, *flags, observations, success[:, None] & self._was_over, infos.get("end"))

    def _bare_step(self, env: DrivingVectorEnv, actions: NDArray[Any]) -> Step:
        taken = env.advance(actions)  # clips actions that are finite
        # The environment keeps a vehicle's flags until its reset; here they mark the step of the end.
        terminated, truncated = taken.terminated & taken.acted, taken.truncated & taken.acted
        flags, succeeded = (terminated, truncated, taken.acted), (terminated | truncated) & (taken.ends == ARRIVED)
        return Step(taken.observations, taken.rewards, *flags, taken.final, succeeded, env.end_names[taken.ends])

    def environment_actions(self, actions: NDArray[Any]) -> NDArray[Any]:
        """The policy's actions (n, V) or (n, V, k) as the environment takes them, without the axis of one vehicle."""
        if self.vehicles == 1:
            actions = actions[:, 0]
        if self.continuous:
            scaled = self._centre + self._reach * np.clip(actions, -1.0, 1.0)
            return np.asarray(scaled).astype(self.vector_env.single_action_space.dtype)
        return actions + self._first_action

    def policy_actions(self, actions: NDArray[Any]) -> NDArray[Any]:
        """The inverse of :meth:`environment_actions`."""
        centred = (actions - self._centre) / self._reach if self.continuous else actions - self._first_action
        return np.asarray(centred[:, None] if self.vehicles == 1 else centred)

    def _native_step(self, actions: NDArray[Any]) -> Step:
        observations, rewards, terminated, truncated, infos = self.vector_env.step(actions)
        final, last = infos.get("final_obs", observations), infos.get("final_info", {})
        if self.vehicles == 1:
            acted, success = np.ones(self.num_envs, dtype=np.bool_), last.get("success", np.zeros_like(terminated))
            columns = observations, rewards, terminated, truncated, acted, final, success
            arrays: Any = (*(column[:, None] for column in columns), last.get("end"))
            return Step(*arrays)
        acted = infos["acted"]
        # The environment keeps a vehicle's flags until its reset; here they mark the step of the end.
        terminated, truncated = terminated & acted, truncated & acted
        success = infos.get("arrived", np.zeros_like(acted))
        return Step(observations, rewards, terminated, truncated, acted, final, success, last.get("end"))

    def policy_observations(self, raw: Any) -> NDArray[np.float32]:
        """Observations (n, V, o) from the raw observations of n environments."""
        space = self.vector_env.single_observation_space
        if not self.native and isinstance(space, spaces.Discrete):
            one_hot: NDArray[np.float32] = np.eye(int(space.n), dtype=np.float32)[np.asarray(raw) - int(space.start)]
            return one_hot[:, None]
        array = np.asarray(raw, dtype=np.float32)
        if self.native:
            return array if self.vehicles > 1 else array[:, None]
        return array.reshape(len(array), 1, -1)

    def environment_observations(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """The inverse of :meth:`policy_observations`: observations of n environments as these return them."""
        space = self.vector_env.single_observation_space
        if self.native:
            return observations if self.vehicles > 1 else observations[:, 0]
        if isinstance(space, spaces.Discrete):
            return np.asarray(observations[:, 0].argmax(axis=-1) + space.start)
        return observations.reshape(len(observations), *(space.shape or ())).astype(space.dtype)

    def get_state(self) -> dict[str, NDArray[Any]]:
        """The exact state of the environments as arrays; empty where they cannot be saved."""
        inner: Any = self.vector_env.unwrapped
        state: dict[str, NDArray[Any]] = inner.get_state() if self.native else {}
        return state

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Resume from :meth:`get_state`."""
        inner: Any = self.vector_env.unwrapped
        if self.native:
            inner.set_state(state)


def _objective_names(env: Any, env_id: str, d: int) -> tuple[str, ...] | None:
    """The names that another library's or a user's environment, or a wrapper of it, gives the d rewards, if any."""
    names = env.get_wrapper_attr("objectives") if env.has_wrapper_attr("objectives") else None
    if not isinstance(names, (tuple, list)):  # another kind of attribute, such as the unordered set of mo-supermario
        return None
    valid = all(isinstance(name, str) and name and not set(name) & FORBIDDEN for name in names)
    if not valid or len(set(names)) != len(names) or len(names) != d:
        raise ValueError(
            f"environment {env_id!r} has objectives = {names!r}; they must be {d} distinct names, one per component of "
            "the reward, without spaces, '/', ':' and '='"
        )
    return tuple(names)


def _scales_from_bounds(space: spaces.Space[Any]) -> NDArray[np.float32]:
    """Nominal magnitudes of another library's observation: its bounds where they are finite and below 10^4, else 1."""
    if isinstance(space, spaces.Discrete):
        return np.ones(int(space.n), dtype=np.float32)
    if not isinstance(space, spaces.Box):
        raise ValueError(f"observation space {space} is neither Box nor Discrete")
    bound = np.maximum(np.abs(space.low), np.abs(space.high)).astype(np.float64).reshape(-1)
    known = np.isfinite(bound) & (bound > 0.0) & (bound < 1e4)
    return np.where(known, bound, 1.0).astype(np.float32)
