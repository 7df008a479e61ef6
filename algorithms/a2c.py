"""A2C on time-step scalarised rewards: the baseline.

The reward of a decision is u(r_t), the critic is scalar and nothing is accrued (Mnih et al. 2016; paper, section 5).
Under a linear utility this optimises what MO-A2C optimises.
"""

from __future__ import annotations

import torch
from pydantic import Field

from algorithms.actor_critic import ActorCritic
from algorithms.common.advantages import discounted_sum
from algorithms.common.env_adapter import EnvAdapter
from algorithms.common.rollout import VehicleRollout
from algorithms.learner import ActorCriticConfig, Learner


class A2CConfig(ActorCriticConfig):
    """Hyperparameters of A2C.

    Attributes:
        value_scale: nominal size of a scalar return, by which the critic's output is multiplied.
    """

    value_scale: float = Field(default=10.0, gt=0.0)


class A2CLearner(Learner):
    """Scalar critic on u(r_t)."""

    config: A2CConfig

    def input_size(self, worlds: EnvAdapter) -> int:
        return worlds.observation_size

    def value_size(self, worlds: EnvAdapter) -> int:
        return 1

    def inputs(self, observations: torch.Tensor, accrued: torch.Tensor, discounts: torch.Tensor) -> torch.Tensor:
        return observations / self.observation_scales

    def values(self, critic_inputs: torch.Tensor) -> torch.Tensor:
        return self.config.value_scale * self.critic(critic_inputs)

    def estimates(
        self, rollout: VehicleRollout, values: torch.Tensor, following: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        gamma = self.config.gamma
        going_on = (~(rollout.terminated | rollout.truncated)).to(values.dtype)
        deltas = self.utility(rollout.rewards) + gamma * following.squeeze(-1) - values.squeeze(-1)
        advantages = discounted_sum(deltas, going_on, gamma * self.config.gae_lambda)
        return advantages, advantages.unsqueeze(-1) + values

    def value_losses(self, values: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        return ((targets - values) / self.config.value_scale).square().squeeze(-1)


class A2C(ActorCritic):
    """Advantage actor-critic on time-step scalarised rewards."""

    name = "a2c"
    Config = A2CConfig
    learner = A2CLearner
