"""MO-PPO that weighs objectives by the slope of the utility: an example of an own advantage."""

import torch

from mo_deepdrive.learners import MOPPO
from mo_deepdrive.learners.learning.advantages import generalised_advantages


class Slope(MOPPO):
    """A_t = grad u(R_t + g^t v(S_t)) . D_t, with the vector advantage D_t of MO-PPO's eq. 3.

    R_t + g^t v(S_t) is the return that is expected in S_t, so the prices of the objectives change within an episode.
    """

    def advantages(self, rollout, values, next_values):
        gamma, utility = self.config.gamma, rollout.utility
        deltas = rollout.rewards + gamma * next_values - values
        vector = generalised_advantages(deltas, rollout.ended.unsqueeze(-1), gamma * self.config.gae_lambda)
        expected = rollout.accrued[:-1] + rollout.discounts[:-1].unsqueeze(-1) * values
        prices = torch.func.grad(lambda returns: utility(returns).sum())(expected)
        return (prices * vector).sum(-1), vector + values
