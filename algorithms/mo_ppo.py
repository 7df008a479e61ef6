"""MO-PPO: proximal policy optimisation with a vector critic on the accrued-reward-augmented state.

State, critic, targets y_t and advantages A_t are those of MO-A2C (:mod:`algorithms.mo_a2c`), for a known utility u.
Within an episode, with v(S_{t+1}) = 0 after termination,

    R_t     = sum_{i<t} g^i r_i,    S_t = (s_t, R_t, g^t)                                              (1)
    delta_t = r_t + gamma v(S_{t+1}) - v(S_t)                                                          (2)
    D_t     = delta_t + gamma lambda D_{t+1},    y_t = D_t + v(S_t)    targets of the critic           (3)
    U_t     = u(R_t + g^t (r_t + gamma v(S_{t+1}))) - u(R_t + g^t v(S_t))                              (4)
    A_t     = U_t + (gamma / g) lambda A_{t+1}                                                         (5)

and every rollout serves several epochs of minibatches of the clipped surrogate (Schulman et al. 2017, eq. 7):

    rho_t = pi(a_t | S_t) / pi_old(a_t | S_t)                                                          (6)
    L     = -E[min(rho_t A_t, clip(rho_t, 1 - epsilon, 1 + epsilon) A_t)]
            + c_v E[|(y_t - v(S_t)) / scales|^2 / d] - c_e E[H(pi)]                                    (7)

With ``advantage: expected_utility``, for ESR at any lambda, the critic predicts a scalar, the increases of u that are
to come, ``utility_scale`` takes the place of the scales in eq. 7, and eqs. 2 to 5 become, with c = gamma / g,

    U_t     = u(R_{t+1}) - u(R_t) + c v(S_{t+1}) - v(S_t)                                              (8)
    A_t     = U_t + c lambda A_{t+1},    y_t = A_t + v(S_t)    targets of the critic                   (9)

The means are over the samples in which the vehicle acted. :mod:`algorithms.mo_a2c` explains ``accrued_discount`` (g)
and the forms of ``advantage``.

Objective, as there: ``utility_difference``, the default, follows the expected utility of the return (ESR) within the
rollout, and the utility of the expected return (SER) for what lies beyond it or beyond 1 / (1 - lambda) decisions;
``utility_gradient`` follows SER; ``expected_utility`` ESR, with gamma < g that of episodes which are cut short.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from algorithms.hyperparameters import AccruedSettings, ProximalSettings
from algorithms.learning.advantages import generalised_advantages, utility_gradient
from algorithms.learning.losses import Loss, mean, policy_change
from algorithms.mo_a2c import MOA2C
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from algorithms.learning.learner import Networks
    from algorithms.learning.storage import Rollout, Samples


class MOPPO(MOA2C):
    """Multi-objective proximal policy optimisation for a known utility, one independent policy per vehicle."""

    name = "mo_ppo"
    compares_policies = True

    class Config(AccruedSettings, ProximalSettings):
        """Hyperparameters of MO-PPO, described in AccruedSettings, ProximalSettings and ActorCriticSettings."""

    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """A_t (T, N) and y_t (T, N, d or 1) of eqs. 2 to 5, or 8 and 9, from v(S_t) and v(S_{t+1}), as y_t."""
        config, u, ended = self.config, rollout.utility, rollout.ended
        gamma, c, decay = config.gamma, config.accrued_ratio, config.gae_lambda
        accrued, discounts = rollout.accrued[:-1], rollout.discounts[:-1].unsqueeze(-1)  # R_t and g^t
        if config.advantage == "expected_utility":
            increases = u(rollout.next_accrued) - u(accrued)
            gains = increases + c * next_values.squeeze(-1) - values.squeeze(-1)  # eq. 8
            advantages = generalised_advantages(gains, ended, c * decay)
            return advantages, advantages.unsqueeze(-1) + values  # eq. 9

        deltas = rollout.rewards + gamma * next_values - values  # eq. 2
        vector_advantages = generalised_advantages(deltas, ended.unsqueeze(-1), gamma * decay)
        targets = vector_advantages + values  # eq. 3
        if config.advantage == "utility_gradient":
            return vector_advantages @ utility_gradient(u, rollout.expected_return), targets

        rest = next_values if config.advantage == "as_printed" else discounts * gamma * next_values
        differences = u(rollout.next_accrued + rest) - u(accrued + discounts * values)  # eq. 4
        return generalised_advantages(differences, ended, c * decay), targets  # eq. 5

    def loss(self, networks: Networks, samples: Samples, entropy_coefficient: Tensor) -> Loss:
        """L of eq. 7."""
        config, weights = self.config, samples.weights
        log_prob, entropies = networks.actor(samples.inputs, samples.actions)
        log_ratio = log_prob - samples.log_prob
        ratio = log_ratio.exp()  # eq. 6
        clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
        policy_loss = -mean(torch.minimum(ratio * samples.advantages, clipped * samples.advantages), weights)
        value_loss = mean((samples.targets - networks.critic(samples.states)).square().mean(-1), weights)
        entropy = mean(entropies, weights)
        total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
        parts = {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy}
        return Loss(total, {**parts, **policy_change(log_ratio, config.clip, weights)})
