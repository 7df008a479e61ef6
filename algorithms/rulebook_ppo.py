"""Rulebook PPO: MO-PPO under limits that are ordered by importance, and a utility that counts once they are kept.

A rulebook (Censi et al. 2019) has the rules E[C_1] <= l_1, ..., E[C_m] <= l_m, the most important first. C_i is the
undiscounted magnitude of a cost per episode. Lexicographic: the first rule comes before all that follows, and every
rule before the utility u. With a multiplier lambda_i per rule the policy follows the Lagrangian (Skalse et al. 2022,
section 4; the limits are given, instead of what the best policy for a rule attains)

    maximise_pi min_lambda>=0  u(E[R]) - sum_i lambda_i (E[C_i] / l_i - 1)                             (1)

A multiplier is thus in units of u per limit. Advantages and targets are those of MO-PPO (:mod:`algorithms.mo_ppo`): D_t
is the vector of its eq. 3, A^u_t the advantage of its eq. 5 for u. As the reward of a cost is minus its magnitude,

    A_t = A^u_t + sum_i lambda_i / l_i D_t,i                                                           (2)

which is normalised, so that it is multipliers in proportion to each other and to u that count. After every rollout,
with the running mean C_i of episodes that have ended, and b_i, whether a rule before i is broken (C_j > l_j, j < i),

    e_i      = min(C_i / l_i - 1, 1)                excess, at most 1 and at least -1                  (3)
    e_i      <- min(e_i, 0)  where b_i              nothing is gained by a rule before which one is broken  (4)
    lambda_i <- max(0, lambda_i + eta k^(i-1) e_i)  of several time scales, the first the fastest      (5)

The loss is eq. 7 of MO-PPO. Multipliers rest while costs grow in (``cost_growth``).

J. Skalse, L. Hammond, C. Griffin, A. Abate, "Lexicographic multi-objective reinforcement learning", IJCAI 2022
(arXiv:2212.13769). A. Censi et al., "Liability, ethics, and culture-aware behavior specification using rulebooks", ICRA
2019.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor

from algorithms.hyperparameters import AccruedSettings, NonNegative, Positive, PositiveFraction, ProximalSettings
from algorithms.mo_ppo import MOPPO
from mo_deepdrive.evaluation.metrics import MULTIPLIER, RUNNING_COST
from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.config import Rulebook

if TYPE_CHECKING:
    from algorithms.actor_critic import PolicyLearner
    from algorithms.learning.storage import Rollout, RolloutStorage


class RulebookPPO(MOPPO):
    """MO-PPO under a rulebook, one independent policy per vehicle, each with multipliers of its own.

    Attributes:
        multipliers: (S, V, m) lambda of the policy of each vehicle; of a shared policy those of its first vehicle.
        running_costs: (S, V, m) C, likewise.

    Raises:
        ValueError: as of MOPPO, and for a rule on what is unknown or no cost.
    """

    name = "rulebook_ppo"

    class Config(AccruedSettings, ProximalSettings):
        """Hyperparameters; the others are described in AccruedSettings, ProximalSettings and ActorCriticSettings."""

        rulebook: Rulebook
        """The rules, the most important first: a list of ``{objective: NAME, at_most: MAGNITUDE}``."""
        multiplier_start: NonNegative = 0.0
        """lambda of every rule at the start of training, in units of the utility per limit."""
        multiplier_rate: Positive = 0.01
        """eta, by which the first rule's lambda moves in an update at the most."""
        rate_ratio: PositiveFraction = 0.5
        """k, the rate of a rule in proportion to that of the rule before it."""
        cost_episodes: Annotated[int, Field(ge=1)] = 1000
        """Number of episodes that the running means C_i remember."""
        advantage: Literal["utility_difference", "as_printed", "utility_gradient"] = "utility_difference"
        """How A^u_t is calculated, as of MO-PPO with a critic per objective."""
        accrued_discount: PositiveFraction | None = 1.0
        """g, discount of the accrued reward that u judges; the rules are about undiscounted costs."""

    def prepare(self) -> None:
        """Multipliers and means, and where the objectives of the rules are."""
        config, env = self.config, self.env
        negative = env.costs & (env.cost_sign == "maximise")
        costs = [name for name, cost in zip(env.objectives, negative, strict=True) if cost]
        for i, rule in enumerate(config.rulebook):
            where, name = f"algorithm.rulebook.{i}.objective = {rule.objective!r}", rule.objective
            if name not in env.objectives:
                raise ValueError(f"{where} is not an objective of {env.name}; {nearest(name, env.objectives)}")
            if name not in costs:
                known = ", ".join(costs) or "none"
                raise ValueError(f"{where} must be a cost, whose rewards are never positive; in {env.name}: {known}")
        self.places = torch.tensor([env.objectives.index(rule.objective) for rule in config.rulebook]).to(self.device)
        self.limits = torch.tensor([rule.at_most for rule in config.rulebook], device=self.device)
        self.rates = config.multiplier_rate * config.rate_ratio ** torch.arange(len(self.places), device=self.device)
        shape = len(self.seeds), env.vehicles, len(self.places)
        self.multipliers = torch.full(shape, config.multiplier_start, device=self.device)
        self.running_costs = torch.zeros(shape, device=self.device)
        self._moving = torch.ones((), device=self.device)  # 0 while costs grow

    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """A_t (T, N) of eq. 2 and y_t (T, N, d), from v(S_t) and v(S_{t+1}), as y_t."""
        advantages, targets = super().advantages(rollout, values, next_values)
        return advantages + (targets - values) @ rollout.prices, targets  # eq. 2, where D_t = y_t - v(S_t)

    def rollout_of(self, learner: PolicyLearner, storage: RolloutStorage) -> dict[str, Tensor]:
        """What a policy did, and the prices lambda_i / l_i of the objectives."""
        prices = torch.zeros_like(learner.expected_return)
        prices.index_copy_(1, self.places, self.multipliers[:, learner.vehicles[0]] / self.limits)
        return {**super().rollout_of(learner, storage), "prices": prices}

    def move_multipliers(self, learner: PolicyLearner, ended: Tensor, magnitudes: Tensor) -> None:
        """Equations 3 to 5 for a policy, with magnitudes (S, T, N, m) of the episodes that ended, where a mask says."""
        multipliers, means = self.multipliers[:, learner.vehicles[0]], self.running_costs[:, learner.vehicles[0]]
        number = ended.sum((1, 2)).unsqueeze(-1)
        total = learner.episodes.unsqueeze(-1)
        # The plain mean at first: the earliest ends are those of short episodes, which failed.
        keep = torch.minimum((1.0 - 1.0 / self.config.cost_episodes) ** number, 1.0 - number / total.clamp(min=1))
        latest = magnitudes.masked_fill(~ended.unsqueeze(-1), 0.0).sum((1, 2)) / number.clamp(min=1)
        means.copy_(keep * means + (1.0 - keep) * latest)
        excess = (means / self.limits - 1.0).clamp(max=1.0)  # eq. 3
        broken = (excess > 0.0).int()
        earlier = broken.cumsum(-1) > broken
        excess = torch.where(earlier, excess.clamp(max=0.0), excess)  # eq. 4
        moving = self._moving * (total > 0)
        multipliers.add_(moving * self.rates * excess).clamp_(min=0.0)  # eq. 5

    def learn_once(self, learner: PolicyLearner, storage: RolloutStorage) -> dict[str, Tensor]:
        """Move the multipliers of a policy, and let it learn under them."""
        ended, sums = (storage.of_vehicles(each, learner.vehicles) for each in (storage.ended, storage.ended_sums))
        self.move_multipliers(learner, ended, -sums[..., 2:].index_select(-1, self.places))
        parts = super().learn_once(learner, storage)
        for i, rule in enumerate(self.config.rulebook):
            parts[MULTIPLIER + rule.objective] = self.multipliers[:, learner.vehicles[0], i]
            parts[RUNNING_COST + rule.objective] = self.running_costs[:, learner.vehicles[0], i]
        return parts

    def grow_costs(self, share: float) -> None:
        """Multiply the costs among the rewards that are learnt from by a share; multipliers rest until it is 1."""
        super().grow_costs(share)
        self._moving.fill_(float(share == 1.0))

    @property
    def running(self) -> dict[str, Tensor]:
        """The multipliers and the running means."""
        return {"rulebook.multipliers": self.multipliers, "rulebook.running_costs": self.running_costs}
