"""PPO: proximal policy optimisation (Schulman et al. 2017) on scalarised rewards, as A2C is scalarised.

The advantages A_t and the critic's targets y_t are those of A2C (:mod:`algorithms.a2c`):

    delta_t = u(r_t) + gamma v(s_{t+1}) - v(s_t)                                            (1)
    A_t     = delta_t + gamma lambda A_{t+1},    y_t = A_t + v(s_t)                         (2)

but instead of one gradient step, every rollout serves several epochs of minibatches of the clipped surrogate (Schulman
et al. 2017, eq. 7), so that the policy can learn from a rollout more than once without moving far from the policy
pi_old that collected it:

    rho_t = pi(a_t | s_t) / pi_old(a_t | s_t)                                               (3)
    L     = -E[min(rho_t A_t, clip(rho_t, 1 - epsilon, 1 + epsilon) A_t)]
            + c_v E[(y_t - v(s_t))^2] - c_e E[H(pi)]                                        (4)

Objective: the expected discounted sum of u(r_t), as A2C's. For a non-linear u that is neither the expected utility of
the return (ESR) nor the utility of the expected return (SER; Hayes et al. 2022).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from algorithms.a2c import A2C
from algorithms.hyperparameters import Positive, ProximalSettings
from algorithms.learning.advantages import generalised_advantages
from algorithms.learning.losses import Loss, mean, policy_change
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from algorithms.learning.learner import Networks
    from algorithms.learning.storage import Rollout, Samples


class PPO(A2C):
    """Proximal policy optimisation on scalarised rewards, one independent policy per vehicle."""

    name = "ppo"
    compares_policies = True

    class Config(ProximalSettings):
        """Hyperparameters of PPO; the others are described in ProximalSettings and ActorCriticSettings."""

        value_scale: Positive = 10.0
        """Nominal size of a scalar return, by which the critic's output is multiplied."""

    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """A_t (T, N) and y_t (T, N, 1) of eqs. 1 and 2, from v(s_t) and v(s_{t+1}) (T, N, 1)."""
        gamma, ended = self.config.gamma, rollout.ended.unsqueeze(-1)
        deltas = rollout.utility(rollout.rewards).unsqueeze(-1) + gamma * next_values - values  # eq. 1
        advantages = generalised_advantages(deltas, ended, gamma * self.config.gae_lambda)
        return advantages.squeeze(-1), advantages + values  # eq. 2

    def loss(self, networks: Networks, samples: Samples, entropy_coefficient: Tensor) -> Loss:
        """L of eq. 4."""
        config, weights = self.config, samples.weights
        log_prob, entropies = networks.actor(samples.inputs, samples.actions)
        log_ratio = log_prob - samples.log_prob
        ratio = log_ratio.exp()  # eq. 3
        clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
        policy_loss = -mean(torch.minimum(ratio * samples.advantages, clipped * samples.advantages), weights)
        value_loss = mean((samples.targets - networks.critic(samples.states)).square().mean(-1), weights)
        entropy = mean(entropies, weights)
        total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
        parts = {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy}
        return Loss(total, {**parts, **policy_change(log_ratio, config.clip, weights)})
