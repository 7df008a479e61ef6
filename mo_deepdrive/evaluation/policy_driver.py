"""A trained policy as the driver of the vehicles that no person drives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mo_deepdrive.evaluation.accrued_reward import AccruedReward

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import Policy


class PolicyDriver:
    """A policy behind the protocol :class:`mo_deepdrive.play.Driver`.

    Args:
        policy: acts for all V vehicles of one environment.
        generator: random numbers for sampled actions; None for greedy actions.
    """

    def __init__(self, policy: Policy, generator: torch.Generator | None = None):
        self._policy = policy
        self._generator = generator
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        adapter = self._policy.env
        self._accrued_reward = AccruedReward.begin(1, adapter.vehicles, len(adapter.objectives))

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Actions (1, V) or (1, V, k) of all vehicles, as the environment takes them, for observations (1, V, o)."""
        actions = self._policy.act(observations, self._accrued_reward, self._generator)
        return self._policy.env.environment_actions(actions)

    def observe(self, rewards: NDArray[np.float32]) -> None:
        """Add the rewards (1, V, d) of a decision to the accrued reward."""
        self._accrued_reward.add(rewards, self._policy.gamma)
