"""A vector environment as Stable-Baselines3 takes it.

It needs Stable-Baselines3, which nothing else in the package imports: ``pip install --editable ".[sb3]"``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import DictInfoToList

from mo_deepdrive.support.extras import needed_for

with needed_for("mo_deepdrive.envs.sb3", extra="sb3"):
    from stable_baselines3.common.vec_env import VecEnv

if TYPE_CHECKING:
    from numpy.typing import NDArray


class SB3VecEnv(VecEnv):  # type: ignore[misc]  # not installed with the types that are checked
    """N environments that one call of compiled code moves, for the algorithms of Stable-Baselines3.

    They learn from a scalar, so a wrapper makes the rewards the utility first::

        envs = gymnasium.make_vec("mo-deepdrive-static-obstacle-v1", num_envs=64, autoreset_mode="SameStep")
        envs = SB3VecEnv(VectorScaledObservation(VectorUtilityReward(envs, "static_obstacle_linear")))

    Row i is what Stable-Baselines3's ``DummyVecEnv`` returns for environment i. The info of an episode's last step has
    ``"terminal_observation"``, and ``"TimeLimit.truncated"``, which is True where only the time was over.

    Args:
        envs: a vector environment with rewards (N,) that resets itself in the step in which an episode ends.

    Raises:
        ValueError: for another autoreset mode; from :meth:`step_wait`, for vector rewards.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]):
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"autoreset_mode = {mode} must be SAME_STEP: gymnasium.make_vec(autoreset_mode='SameStep')"
            )
        self.envs = envs
        self._listed = DictInfoToList(envs)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> NDArray[Any]:
        """Start new episodes, with the seeds and options that have been set since the last call."""
        options = self._options[0]
        if self._options != [options] * self.num_envs:
            raise ValueError(f"options = {self._options} must be the same for all environments")
        observations, self.reset_infos = self._listed.reset(seed=self._seeds, options=options or None)
        self._reset_seeds()
        self._reset_options()
        return np.asarray(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[Any], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Act for one decision: observations, rewards (N,), whether episodes ended, and an info per environment."""
        observations, rewards, terminated, truncated, infos = self._listed.step(self._actions)
        if rewards.shape != (self.num_envs,):
            expected = f"({self.num_envs},): VectorUtilityReward makes them scalar, for one vehicle"
            raise ValueError(f"rewards of shape {rewards.shape} must be {expected}")
        over = terminated | truncated
        for row in np.flatnonzero(over):
            info = infos[row]
            info.update(info.pop("final_info", {}))
            info["terminal_observation"] = info.pop("final_obs")
            info["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
        return observations, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_images(self) -> Any:
        """A frame per environment."""
        return self.envs.render()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, which is the same for all environments."""
        owner = self.envs if hasattr(self.envs, attr_name) else self.envs.unwrapped
        return [getattr(owner, attr_name) for _ in self._get_indices(indices)]

    def env_method(self, method_name: str, *_: Any, **__: Any) -> Any:
        """Single environments cannot be called, nor can their attributes be set."""
        raise AttributeError(f"{method_name!r} of single environments is out of reach in {self.envs}")

    set_attr = env_method

    def env_is_wrapped(self, _wrapper_class: type, indices: Any = None) -> list[bool]:
        """False for all: wrappers of single environments cannot wrap these."""
        return [False for _ in self._get_indices(indices)]
