"""Conditioned MO-PPO: one network for a family of utilities, for a utility that is not known yet.

A preference p, the family and parameters of a utility u(.; p), is drawn at the start of every episode and is part of
the state, as the weights of Abels et al. (2019) and Yang et al. (2019); one actor and one critic per vehicle serve
all of them. With returns R in R^d, scales s, weights w of the simplex, budgets b and an ideal point z the families are

    linear           u(R) = sum_i w_i R_i / s_i                                                                      (1)
    chebyshev        u(R) = -(max_i q_i + rho sum_i q_i),    q_i = w_i (z_i - R_i) / s_i                             (2)
    comfort_budget   u(R) = sum_{i not in B} R_i / s_i - price sum_{i in B} max(0, -R_i - b_i) / s_i                 (3)

Eq. 2 is the augmented Chebyshev function (Steuer and Choo 1983), here with the weights in its second sum, too, so that
an objective of weight 0 does not count; it has optima that no weights of eq. 1 have where a front is not convex (Van
Moffaert et al. 2013). Eq. 3 lets a passenger bear so much of some costs (g-force, jerk) and charges what exceeds it:
the constraint method of Haimes et al. (1971) with a penalty. z is the best discounted return of each objective in any
episode so far, and 0 before one has ended.

The objective is the expected utility of the discounted return (ESR), in the mean over preferences,

    J = E_p E[u(R_T; p)],    R_t = sum_{i<t} gamma^i r_i.                                                            (4)

The increases of the utility, in units of what the rest of the episode is worth, are a scalar reward:

    x_t = (u(R_{t+1}; p) - u(R_t; p)) / gamma^t,    sum_t gamma^t x_t = u(R_T; p) - u(0; p)                          (5)

which is w . r_t / s for a linear utility. It is learnt from as in PPO (Schulman et al. 2017). The critic V(S) predicts
E[sum_k gamma^k X_{t+k}], 0 after termination, where X_t has K components: x_t alone, or with ``vector_critic`` the d
components r_t / s, whose weighted sum is x_t for a linear utility, and x_t only if there are other families:

    S_t     = (s_t, p, c_t)                                                                                          (6)
    delta_t = X_t + gamma V(S_{t+1}) - V(S_t)                                                                        (7)
    A_t     = delta_t + gamma lambda A_{t+1},    Y_t = A_t + V(S_t)    targets of the critic                         (8)
    L       = -E[min(f_t B_t, clip(f_t, 1 - epsilon, 1 + epsilon) B_t)] + c_v E[|Y_t - V(S_t)|^2 / K] - c_e E[H(pi)] (9)

with the ratio f_t = pi(a_t | S_t) / pi_old(a_t | S_t) and B_t = k(p) . A_t, normalised to mean 0 and standard deviation
1 over the rollout: for a linear utility k(p) weighs the components r_t / s with w, for another it weighs x_t with 1.
All components are predicted under all preferences. c_t is what the past means for the rest of the episode. Since
(u(R_t + gamma^t X) - u(R_t)) / gamma^t depends on R_t only through differences of gaps, and through budgets that are
left, these replace R_t and gamma^t in the state:

    chebyshev        c_i = (q_i(R_t) - max_j q_j(R_t)) / gamma^t                                                    (10)
    comfort_budget   c_i = (R_{t,i} + b_i) / gamma^t / (largest budget)                                             (11)

both clipped; for linear utilities there is none, because the past does not matter to them.

With ``switching`` the preference also changes within episodes. From then on eq. 5 is that of the new preference; the
sum of eq. 8 ends with the last decision under the old one, which bootstraps with V(S_{t+1}) under the old one. Cars
that are under way by one preference then learn under another what moving on is worth; a network that stands still under
costly preferences seldom finds out by itself (docs/lab/conditioned.md has measurements).

In the first part of the training, ``cost_growth`` of it, the weights of costs grow, so that cars drive before they
learn what that costs. Let w be the weights that are drawn, and w' those of the gains among them, divided by their sum.
A linear or Chebyshev preference that is drawn in this part has the weights

    (1 - c) w' + c w,    c from 0 to 1 as training goes on                                                          (12)

where gains are the objectives of which an episode so far has returned more than 0; until there are any it has w.
Budgets are as drawn.

With continuous actions the standard deviations of pi, too, depend on S_t: what one preference has to explore, another
pays for without gaining by it.

The front consists of the greedy policies under a fixed sample of preferences, from the distribution of training, as far
as no other dominates them.

A. Abels, D. M. Roijers, T. Lenaerts, A. Nowé, D. Steckelmacher, "Dynamic weights in multi-objective deep reinforcement
learning", ICML 2019. R. Yang, X. Sun, K. Narasimhan, "A generalized algorithm for multi-objective reinforcement
learning and policy adaptation", NeurIPS 2019. K. Van Moffaert, M. M. Drugan, A. Nowé, "Scalarized multi-objective
reinforcement learning: novel design techniques", ADPRL 2013. Y. Y. Haimes, L. S. Lasdon, D. A. Wismer, "On a
bicriterion formulation of the problems of integrated system identification and system optimization", IEEE Transactions
on Systems, Man, and Cybernetics 1, 1971. R. E. Steuer, E.-U. Choo, "An interactive weighted Tchebycheff procedure for
multiple objective programming", Mathematical Programming 26, 1983. J. Schulman, F. Wolski, P. Dhariwal, A. Radford,
O. Klimov, "Proximal policy optimization algorithms", arXiv:1707.06347, 2017.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from algorithms.actor_critic import ActorCritic
from algorithms.agent import DRAWS, FrontAgent, PolicyOfFront
from algorithms.hyperparameters import Count, Fraction, NonNegative, PositiveFraction, ProximalSettings
from algorithms.learning.advantages import generalised_advantages
from algorithms.learning.checkpoints import PARTNERS
from algorithms.learning.losses import Loss, mean, policy_change
from algorithms.learning.preferences import (
    CHEBYSHEV,
    COMFORT_BUDGET,
    LINEAR,
    Preferences,
    PreferenceSettings,
    TrainingPreferences,
)
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS, vehicle_prefix
from mo_deepdrive.evaluation.policy import SMALLEST_DISCOUNT

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv
    from numpy.typing import NDArray

    from algorithms.actor_critic import PolicyLearner
    from algorithms.learning.learner import Networks
    from algorithms.learning.storage import Rollout, RolloutStorage, Samples
    from mo_deepdrive.evaluation.policy import AccruedReward


class ConditionedMOPPO(FrontAgent, ActorCritic):  # type: ignore[misc]  # it acts under a preference
    """MO-PPO conditioned on preferences: every vehicle has one of its own, and a policy, or all share one.

    The arguments are those of :class:`algorithms.actor_critic.ActorCritic` without ``utility`` and ``partners``.

    Attributes:
        preferences: what a condition means; ``agent.policy(agent.preferences.condition("linear", {"distance": 1}))``
            drives one vehicle under weights, and ``agent.policy(rows)`` each of V under its row of ``rows`` (V, m).
        ideal: (S, d) z.

    Raises:
        ValueError: as there, and for an environment that emits magnitudes.
    """

    name = "conditioned_mo_ppo"
    trains_with_partners = False

    class Config(PreferenceSettings, ProximalSettings):
        """Hyperparameters; the others are described in PreferenceSettings, ProximalSettings and ActorCriticSettings."""

        switching: Fraction = 0.01
        """Probability per decision that the preference changes in the middle of an episode."""
        cost_growth: Fraction = 0.15
        """Fraction of the training in which c of eq. 12 grows from 0 to 1; 0 for weights as drawn from the
        start. Until the first arrival the destination counts as a cost."""
        max_policies: Annotated[int, Field(ge=1, le=100_000)] = 200
        """Number of preferences under which the front is evaluated."""
        gamma: PositiveFraction = 0.99
        """Discount of the return of which the utility is taken."""
        steps: Count = 32
        """T, time steps per environment and update."""
        entropy_end: NonNegative = 0.001
        """c_e at the end, to which it moves geometrically."""
        vector_critic: bool = False
        """Whether the critic predicts the return of each objective, as the vector-valued Q of Abels et al. (2019) and
        Yang et al. (2019) do, instead of linear utilities of them; only where families has linear ones."""
        state_dependent_std: bool = True
        centralised_critic: Literal[False] = False
        """False: the critic sees what the actor sees."""

    def __init__(self, env: VectorEnv, **options: Any):
        super().__init__(env, **options)
        if self.env.cost_sign != "maximise":
            raise ValueError(f"cost_sign = {self.env.cost_sign!r}: algorithm {self.name!r} needs 'maximise'")

    def prepare(self) -> None:
        """Preferences, and which components X_t has."""
        config = self.config
        self.preferences = Preferences(config, self.env.objectives, self.scales)
        self.preferences.to(self.device)
        self.ideal = torch.zeros(len(self.seeds), len(self.scales), device=self.device)
        self.has_objectives = config.vector_critic and LINEAR in self.preferences.used
        self.has_increases = not self.has_objectives or self.preferences.used != [LINEAR]

    # ------------------------------------------------------------------------------------------------------- equations

    @property
    def input_size(self) -> int:
        """Width of S_t of eq. 6."""
        return self.env.observation_size + self.preferences.width

    def inputs(self, observations: Tensor, accrued: Tensor, discounts: Tensor, preference: Any = None) -> Tensor:
        """S_t of eq. 6, scaled: (..., input_size), under a preference: p (..., m), and z (..., d)."""
        rows, ideal = preference
        features = self.preferences.features(rows, accrued, discounts, ideal)
        return torch.cat([observations / self.observation_scales, features], dim=-1)

    @property
    def value_scales(self) -> Tensor:
        """(K,) ones: X_t is in units of the scales already."""
        size = self.has_objectives * len(self.env.objectives) + self.has_increases
        return torch.ones(size, device=self.device)

    def rollout_of(self, learner: PolicyLearner, storage: RolloutStorage) -> dict[str, Tensor]:
        """What a policy did; where its preference changed within an episode, that of before ends there, truncated."""
        rollout = super().rollout_of(learner, storage)
        preferences = rollout["preferences"]
        switched = torch.zeros_like(rollout["truncated"])
        switched[:, :-1] = (preferences[:, 1:] != preferences[:, :-1]).any(-1)
        return {**rollout, "truncated": rollout["truncated"] | (switched & ~rollout["terminated"])}

    def advantages(self, rollout: Rollout, values: Tensor, next_values: Tensor) -> tuple[Tensor, Tensor]:
        """B_t (T, N) and Y_t (T, N, K) of eqs. 7 and 8, from V(S_t) and V(S_{t+1}) (T, N, K)."""
        gamma, ended = self.config.gamma, rollout.ended.unsqueeze(-1)
        deltas = self.components(rollout) + gamma * next_values - values  # eq. 7
        advantages = generalised_advantages(deltas, ended, gamma * self.config.gae_lambda)  # eq. 8
        return (self.component_weights(rollout.preferences) * advantages).sum(-1), advantages + values

    def loss(self, networks: Networks, samples: Samples, entropy_coefficient: Tensor) -> Loss:
        """L of eq. 9."""
        config, weights = self.config, samples.weights
        log_prob, entropies = networks.actor(samples.inputs, samples.actions)
        log_ratio = log_prob - samples.log_prob
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
        policy_loss = -mean(torch.minimum(ratio * samples.advantages, clipped * samples.advantages), weights)
        value_loss = mean((samples.targets - networks.critic(samples.states)).square().mean(-1), weights)
        entropy = mean(entropies, weights)
        total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
        parts = {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy}
        return Loss(total, {**parts, **policy_change(log_ratio, config.clip, weights)})

    def components(self, rollout: Rollout) -> Tensor:
        """X_t (T, N, K)."""
        preferences, parts = rollout.preferences, []
        if self.has_objectives:
            parts.append(rollout.rewards / self.preferences.scales.to(rollout.rewards))
        if self.has_increases:
            u, z = self.preferences.utility, rollout.ideal
            discounts = rollout.discounts[:-1].clamp(min=SMALLEST_DISCOUNT)
            # Equation 5, in double precision because gamma^t becomes small.
            before = rollout.accrued[:-1].double()
            after = before + discounts.unsqueeze(-1) * rollout.rewards
            increases = (u(after, preferences, z) - u(before, preferences, z)) / discounts
            parts.append(increases.to(rollout.rewards.dtype).unsqueeze(-1))
        return torch.cat(parts, dim=-1)

    def component_weights(self, preferences: Tensor) -> Tensor:
        """k(p) (..., K) of preferences (..., m)."""
        linear = self.preferences.is_family(preferences, LINEAR).unsqueeze(-1)
        parts = []
        if self.has_objectives:
            parts.append(self.preferences.weights(preferences) * linear)
        if self.has_increases:
            parts.append((~linear if self.has_objectives else torch.ones_like(linear)).to(preferences.dtype))
        return torch.cat(parts, dim=-1)

    # ------------------------------------------------------------------------------------------------------ preferences

    def training_preferences(self, shape: tuple[int, int, int]) -> TrainingPreferences:
        """Those under which S seeds act in T steps of N environments."""
        made = TrainingPreferences(self.preferences, (*shape, self.env.vehicles), self.config.switching, self.device)
        self.ideal = made.ideal.copy_(self.ideal)
        return made

    @property
    def training(self) -> TrainingPreferences:
        """The preferences of the training."""
        assert self.collector.preferences is not None
        return self.collector.preferences

    def grow_costs(self, share: float) -> None:
        """Set c of eq. 12."""
        self.training.cost_share.fill_(share)

    def _draw(self, seed: int) -> None:
        super()._draw(seed)
        self.training.draw(seed, torch.Generator(self.device).manual_seed(self.seed_of(DRAWS, seed)))

    # ------------------------------------------------------------------------------------------------------- the front

    def act_under(
        self,
        preferences: NDArray[np.float32],
        observations: NDArray[np.float32],
        accrued_reward: AccruedReward,
        generator: torch.Generator | None,
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o) under preferences (N, V, m) or (1, V, m)."""
        rows = np.broadcast_to(preferences, (len(observations), *preferences.shape[1:])).copy()
        preference = torch.from_numpy(rows).to(self.device), self.ideal[0]
        return ActorCritic.act(self, observations, accrued_reward, generator, preference)

    @property
    def condition_names(self) -> tuple[str, ...]:
        """The components of a preference, of each vehicle in turn."""
        prefixes = [vehicle_prefix(v, self.env.vehicles) for v in range(self.env.vehicles)]
        return tuple(prefix + name for prefix in prefixes for name in self.preferences.names)

    def conditions(self) -> NDArray[np.float32]:
        """(K, V m) preferences from the distribution of training, the same ones every time."""
        count = self.config.max_policies
        return self.preferences.draw(count * self.env.vehicles, np.random.default_rng(0)).reshape(count, -1)

    def policies(self, conditions: NDArray[np.float32]) -> PolicyOfFront:
        """What acts under preferences of every vehicle, (N, V m) or (N, V, m), or under the same (1, ...) everywhere.

        Raises:
            ValueError: for another shape, or numbers that are no preference.
        """
        rows = np.atleast_2d(np.asarray(conditions, dtype=np.float32))
        vehicles, names = self.env.vehicles, self.preferences.names
        if rows.shape[1:] not in ((vehicles * len(names),), (vehicles, len(names))):
            raise ValueError(
                f"conditions of shape {rows.shape} must be (n, {vehicles}, {len(names)}): of every vehicle the "
                f"numbers {', '.join(names)}"
            )
        preferences = rows.reshape(len(rows), vehicles, -1)
        self.preferences.check(preferences)
        return PolicyOfFront(self, preferences)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share; with other scales, families, rho or price a preference means something else."""
        config, found = self.config, super().identity()
        for name in ("centralised_critic", "inputs", PARTNERS):
            del found[name]
        return {
            **found,
            "preferences": list(self.preferences.names),
            "objective_scales": self.scales.tolist(),
            "budgets": dict(config.budgets),
            **({"rho": config.rho} if CHEBYSHEV in self.preferences.used else {}),
            **({"price": config.price} if COMFORT_BUDGET in self.preferences.used else {}),
            "gamma": self.accrued_discount,
        }

    @property
    def running(self) -> dict[str, Tensor]:
        """The preferences of running episodes and the ideal point."""
        training = self.training
        return {"preferences": training.current, "seen_any": training.seen_any, "ideal": self.ideal}

    def get_policy(self, seed: int = 0) -> dict[str, Tensor]:
        """The actors' weights and the ideal point, on which they depend."""
        return {**super().get_policy(seed), "ideal": self.ideal[seed]}

    def set_policy(self, state: dict[str, Tensor]) -> None:
        """Act as the agent of :meth:`get_policy` or :meth:`~algorithms.agent.Agent.get_state`."""
        super().set_policy(state)
        self.ideal[0] = state["ideal"]
