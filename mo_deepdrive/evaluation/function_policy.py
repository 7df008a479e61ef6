"""A plain function as a policy, so that agents of any library can be evaluated, recorded and filmed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import torch
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.accrued_reward import AccruedReward
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility

    PolicyFunction = Callable[[NDArray[Any], NDArray[np.float32], NDArray[np.float32]], Any]


class FunctionPolicy:
    """A function behind the interface of agents (:class:`mo_deepdrive.evaluation.policy.Policy`).

    Args:
        function: called as ``function(observations, accrued, discounts)`` with the observations of N episodes as the
            environment returns them, their accrued reward R_t = sum_{i<t} gamma^i r_i (N, d) and gamma^t (N,). With V
            vehicles in an environment the shapes are (N, V, o), (N, V, d) and (N, V). It returns actions as the
            environment takes them: (N,) integers or (N, k) numbers, or (N, V) or (N, V, k).
        env: the environment in the shapes of agents.
        utilities: one per vehicle; empty if no utility is known.
        gamma: discount factor of the accrued reward.
    """

    def __init__(
        self, function: PolicyFunction, env: EnvAdapter, utilities: Sequence[Utility] = (), gamma: float = 0.99
    ):
        self.env = env
        self.utilities = utilities
        self.gamma = gamma
        self._function = function

    @property
    def device(self) -> torch.device:
        """The CPU; the function draws its own random numbers, if any."""
        import torch

        return torch.device("cpu")

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, _generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions of the function, in the shapes of agents.

        Raises:
            ValueError: for actions of the wrong shape.
        """
        accrued, discounts = accrued_reward.value.copy(), accrued_reward.discounts.copy()
        if self.env.vehicles == 1:
            accrued, discounts = accrued[:, 0], discounts[:, 0]
        actions = np.asarray(self._function(self.env.environment_observations(observations), accrued, discounts))
        expected = (len(observations), *(self.env.vector_env.action_space.shape or ())[1:])
        if actions.shape != expected:
            raise ValueError(f"the policy returned actions of shape {actions.shape}; expected {expected}")
        return self.env.policy_actions(actions)
