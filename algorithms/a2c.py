"""A2C: advantage actor-critic on scalarised rewards (Mnih et al. 2016), the baseline of Ajridi et al. 2023, section 5.

With the utility u, the reward of a time step is the scalar u(r_t), and the critic v predicts its discounted sum:

    delta_t = u(r_t) + gamma v(s_{t+1}) - v(s_t)                                      (1)
    A_t     = delta_t + gamma lambda A_{t+1}      within an episode                   (2)
    y_t     = A_t + v(s_t)                        target of the critic                (3)
    L       = E[-A_t log pi(a_t | s_t)] + c_v E[(y_t - v(s_t))^2] - c_e E[H(pi)]      (4)

Under a linear utility this maximises what MO-A2C maximises. Under a non-linear one it maximises the expected sum of
u(r_t), which is neither the utility of the expected return (SER) nor the expected utility of the return (ESR).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.actor_critic import ActorCritic
from algorithms.hyperparameters import ActorCriticSettings, Positive
from algorithms.learning.advantages import generalised_advantages
from algorithms.learning.losses import Loss, mean
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from torch import Tensor

    from algorithms.learning.learner import Networks
    from algorithms.learning.storage import Rollout, Samples


class A2C(ActorCritic):
    """Advantage actor-critic on scalarised rewards, one independent policy per vehicle."""

    name = "a2c"
    judged = "rewards"
    compares_policies = False

    class Config(ActorCriticSettings):
        """Hyperparameters of A2C; the others are described in ActorCriticSettings."""

        value_scale: Positive = 10.0
        """Nominal size of a scalar return, by which the critic's output is multiplied."""

    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """A_t (T, N) and y_t (T, N, 1) of eqs. 1 to 3, from v(s_t) and v(s_{t+1}) (T, N, 1)."""
        gamma, ended = self.config.gamma, rollout.ended.unsqueeze(-1)
        deltas = rollout.utility(rollout.rewards).unsqueeze(-1) + gamma * next_values - values  # eq. 1
        advantages = generalised_advantages(deltas, ended, gamma * self.config.gae_lambda)  # eq. 2
        return advantages.squeeze(-1), advantages + values  # eq. 3

    def loss(self, networks: Networks, samples: Samples, entropy_coefficient: Tensor) -> Loss:
        """L of eq. 4."""
        log_prob, entropies = networks.actor(samples.inputs, samples.actions)
        errors = (samples.targets - networks.critic(samples.states)).square().mean(-1)
        policy_loss = -mean(samples.advantages * log_prob, samples.weights)
        value_loss = mean(errors, samples.weights)
        entropy = mean(entropies, samples.weights)
        total = policy_loss + self.config.value_coefficient * value_loss - entropy_coefficient * entropy
        return Loss(total, {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy})
