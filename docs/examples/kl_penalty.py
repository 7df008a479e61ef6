"""MO-PPO with a penalty in place of the clip: an example of an own loss."""

from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS
from mo_deepdrive.learners import MOPPO
from mo_deepdrive.learners.hyperparameters import NonNegative
from mo_deepdrive.learners.learning.losses import Loss, mean


class KLPenalty(MOPPO):
    """L = E[-rho_t A_t + beta KL(pi_old || pi)] + c_v E[...] - c_e E[H(pi)] (Schulman et al. 2017, eq. 8)."""

    class Config(MOPPO.Config):
        """What MO-PPO does not have."""

        beta: NonNegative = 3.0
        """Weight of the penalty."""

    def loss(self, networks, samples, entropy_coefficient):
        log_prob, entropies = networks.actor(samples.inputs, samples.actions)
        log_ratio = log_prob - samples.log_prob
        ratio = log_ratio.exp()
        divergence = ratio - 1.0 - log_ratio  # whose expectation under pi_old is KL(pi_old || pi)
        policy_loss = mean(self.config.beta * divergence - ratio * samples.advantages, samples.weights)
        value_loss = mean((samples.targets - networks.critic(samples.states)).square().mean(-1), samples.weights)
        entropy = mean(entropies, samples.weights)
        total = policy_loss + self.config.value_coefficient * value_loss - entropy_coefficient * entropy
        return Loss(total, {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy})
