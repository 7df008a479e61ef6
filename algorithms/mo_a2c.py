"""MO-A2C: advantage actor-critic with a vector critic on the accrued-reward-augmented state, for a known utility.

The state is augmented by the accrued reward R_t and its current discount g^t. The critic v predicts one discounted
return per objective, and the utility u enters through the advantage (Ajridi et al. 2023, section 4.2; Hayes et al.
2022; Reymond et al. 2023). Within an episode, with v(S_{t+1}) = 0 after termination,

    R_t     = sum_{i<t} g^i r_i,    S_t = (s_t, R_t, g^t)                                              (1)
    delta_t = r_t + gamma v(S_{t+1}) - v(S_t)                                                          (2)
    D_t     = delta_t + gamma lambda D_{t+1},    y_t = D_t + v(S_t)    targets of the critic           (3)
    U_t     = u(R_t + g^t (r_t + gamma v(S_{t+1}))) - u(R_t + g^t v(S_t))                              (4)
    A_t     = U_t + (gamma / g) lambda A_{t+1}                                                         (5)
    L       = E[-A_t log pi(a_t | S_t)] + c_v E[|(y_t - v(S_t)) / scales|^2 / d] - c_e E[H(pi)]        (6)

The sums of eqs. 3 and 5 end with the episode or the rollout; the means of eq. 6 are over the samples in which the
vehicle acted, with A_t normalised to mean 0 and standard deviation 1 (``normalise_advantages``).

In the paper g = gamma. Equation 4 is then its eq. 4.2 with the factor gamma^{t+1} in the first term, which the printed
equation lacks (``advantage: as_printed`` drops it). With ``accrued_discount: 1`` the past counts in full, and a linear
utility gives the advantage of A2C at every step; with g = gamma it gives gamma^t times that.

Objective. With g = gamma, lambda = 1 and a whole episode in the rollout, eq. 5 telescopes to u(R_T) - u(R_t + g^t
v(S_t)), an advantage for the expected utility of the return (ESR). Beyond the rollout, or with lambda < 1, the critic's
mean takes the place of the return inside u, which is the utility of the expected return (SER) for that part.
``advantage: utility_gradient`` replaces eqs. 4 and 5 by A_t = grad u(E[R]) . D_t, the policy gradient of SER; E[R] is a
running mean of the returns, discounted with g, of finished episodes.

``advantage: expected_utility`` follows ESR at any lambda and length of the rollout. Its rewards are the increases of u
along the episode, and its critic has one output, v(S) = E[sum_k c^k (u(R_{t+k+1}) - u(R_{t+k})) | S_t = S] with c =
gamma / g <= 1. Equations 2 to 5 become

    U_t     = u(R_{t+1}) - u(R_t) + c v(S_{t+1}) - v(S_t)                                              (7)
    A_t     = U_t + c lambda A_{t+1},    y_t = A_t + v(S_t)    targets of the critic                   (8)

and ``utility_scale`` takes the place of the scales in eq. 6. With g = gamma the increases sum to u(R_T) - u(0). With
c < 1 they sum to E[u(R_tau)] - u(0), where the episode ends after every decision with probability 1 - c, or else at T:
the increase of decision t counts if the episode gets there, with probability c^t. That is still the expected utility
of a return, though of one that is cut short; it tends to u(R_T) as c tends to 1, and learns more easily (measured in
docs/lab/nonlinear_utilities.md). With the true v, E[U_t | S_t] under the policy is 0, so that every term beyond U_t
only adds noise: E[A_t | S_t, a_t] is the advantage at any lambda, as for a scalar reward (Schulman et al. 2016; the
reward is that of a Markov decision process over S_t, Hayes et al. 2022, section 4.3). What a truncated episode would
still have gained is v of its true final state. S_t must have R_t and, where g < 1, g^t.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from algorithms.actor_critic import ActorCritic
from algorithms.hyperparameters import AccruedSettings, ActorCriticSettings
from algorithms.learning.advantages import check_utility_gradient, generalised_advantages, utility_gradient
from algorithms.learning.losses import Loss, mean
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from algorithms.actor_critic import PolicyLearner
    from algorithms.learning.learner import Networks
    from algorithms.learning.storage import Rollout, Samples


class MOA2C(ActorCritic):
    """Multi-objective advantage actor-critic for a known utility, one independent policy per vehicle."""

    name = "mo_a2c"
    compares_policies = False

    class Config(AccruedSettings, ActorCriticSettings):
        """Hyperparameters of MO-A2C, described in AccruedSettings and ActorCriticSettings."""

    @property
    def accrued_discount(self) -> float:
        """Discount g of the accrued reward."""
        return float(self.config.g)

    @property
    def observes_accrued(self) -> bool:  # type: ignore[override]
        """Whether S_t of eq. 1 has R_t."""
        return bool(self.config.observe_accrued)

    @property
    def observes_discount(self) -> bool:  # type: ignore[override]
        """Whether S_t of eq. 1 has g^t."""
        return bool(self.config.observe_discount)

    @property
    def value_scales(self) -> Tensor:
        """(K,) units of what the critic predicts: returns, or with expected_utility their utility."""
        if self.config.advantage == "expected_utility":
            return torch.full((1,), self.config.utility_scale, device=self.device)
        return self.objective_scales

    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """A_t (T, N) and y_t (T, N, d or 1) of eqs. 2 to 5, or 7 and 8, from v(S_t) and v(S_{t+1}), as y_t."""
        config, u, ended = self.config, rollout.utility, rollout.ended
        gamma, c, decay = config.gamma, config.accrued_ratio, config.gae_lambda
        accrued, discounts = rollout.accrued[:-1], rollout.discounts[:-1].unsqueeze(-1)  # R_t and g^t
        if config.advantage == "expected_utility":
            increases = u(rollout.next_accrued) - u(accrued)
            gains = increases + c * next_values.squeeze(-1) - values.squeeze(-1)  # eq. 7
            advantages = generalised_advantages(gains, ended, c * decay)
            return advantages, advantages.unsqueeze(-1) + values  # eq. 8

        deltas = rollout.rewards + gamma * next_values - values  # eq. 2
        vector_advantages = generalised_advantages(deltas, ended.unsqueeze(-1), gamma * decay)
        targets = vector_advantages + values  # eq. 3
        if config.advantage == "utility_gradient":
            return vector_advantages @ utility_gradient(u, rollout.expected_return), targets

        rest = next_values if config.advantage == "as_printed" else discounts * gamma * next_values
        differences = u(rollout.next_accrued + rest) - u(accrued + discounts * values)  # eq. 4
        return generalised_advantages(differences, ended, c * decay), targets  # eq. 5

    def loss(self, networks: Networks, samples: Samples, entropy_coefficient: Tensor) -> Loss:
        """L of eq. 6."""
        log_prob, entropies = networks.actor(samples.inputs, samples.actions)
        errors = (samples.targets - networks.critic(samples.states)).square().mean(-1)
        policy_loss = -mean(samples.advantages * log_prob, samples.weights)
        value_loss = mean(errors, samples.weights)
        entropy = mean(entropies, samples.weights)
        total = policy_loss + self.config.value_coefficient * value_loss - entropy_coefficient * entropy
        return Loss(total, {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy})

    def diagnose(self, learner: PolicyLearner, seed: int) -> None:
        """Call the utility's gradient, too, where that is used."""
        super().diagnose(learner, seed)
        if self.config.advantage == "utility_gradient":
            check_utility_gradient(self.utilities[learner.vehicles[0]], learner.expected_return[seed])
