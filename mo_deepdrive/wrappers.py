"""Wrappers: a scalar reward instead of a vector reward, for libraries that need one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, get_args

import gymnasium
import numpy as np

from mo_deepdrive.utilities import Utility, make_utility

if TYPE_CHECKING:
    from numpy.typing import NDArray

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

    Raises:
        ValueError: if the environment has no vector rewards, or the utility is unknown or does not fit them.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], utility: str | Utility, of: Measure = "reward", **arguments: Any):
        gymnasium.utils.RecordConstructorArgs.__init__(self, utility=utility, of=of, **arguments)
        gymnasium.Wrapper.__init__(self, env)
        inner: Any = env.unwrapped
        space = getattr(inner, "reward_space", None)
        if space is None or len(space.shape) != 1:
            raise ValueError(f"UtilityReward needs vector rewards; {inner} has no reward_space of shape (d,)")
        if of not in get_args(Measure):
            raise ValueError(f"of = {of!r} must be one of {list(get_args(Measure))}")
        objectives = getattr(inner, "objectives", tuple(f"objective_{i}" for i in range(space.shape[0])))
        if isinstance(utility, str):
            config = getattr(inner, "config", None)
            utility = make_utility(utility, objectives, getattr(config, "cost_sign", "maximise"), **arguments)
        elif arguments:
            raise ValueError(f"arguments {sorted(arguments)} are for a utility given by name")
        if len(utility.objectives) != len(objectives):
            raise ValueError(f"utility {utility.name!r} takes {utility.objectives}; the environment has {objectives}")
        self.utility = utility
        self._of = of
        self._accrued: dict[int, NDArray[np.float64]] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode."""
        self._accrued = {}
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act for one decision.

        Returns:
            observation, utility, terminated, truncated, and info with the vector reward (d,).
        """
        observation, vector, terminated, truncated, info = self.env.step(action)
        rewards = np.asarray(vector)
        if self._of == "reward":
            value = self.utility(rewards)
        else:
            # If vehicles take turns, each has its own return.
            vehicle = info.get("vehicle", 0)
            before = self._accrued.get(vehicle, np.zeros(rewards.shape))
            after = before + rewards
            self._accrued[vehicle] = after
            value = self.utility(after) - self.utility(before)
        return observation, float(value), terminated, truncated, {**info, "vector_reward": vector}
