"""MO-PPO that is averse to risk: what disappoints counts for more than what surprises (Mihatsch and Neuneier 2002)."""

from typing import Literal

from algorithms import MOPPO
from algorithms.hyperparameters import Fraction
from algorithms.learning.advantages import generalised_advantages


class RiskSensitive(MOPPO):
    """Equations 8 and 9 of MO-PPO, where U_t becomes U_t - k |U_t|."""

    class Config(MOPPO.Config):
        """What differs from MO-PPO."""

        advantage: Literal["expected_utility"] = "expected_utility"
        """The critic predicts the utility."""
        aversion: Fraction = 0.5
        """k; 0 for none."""

    def advantages(self, rollout, values, next_values):
        u, c = rollout.utility, self.config.gamma / self.config.accrued_discount
        increases = u(rollout.next_accrued) - u(rollout.accrued[:-1])
        gains = increases.unsqueeze(-1) + c * next_values - values
        gains = gains - self.config.aversion * gains.abs()
        advantages = generalised_advantages(gains, rollout.ended.unsqueeze(-1), c * self.config.gae_lambda)
        return advantages.squeeze(-1), advantages + values
