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

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pydantic import Field, model_validator

from algorithms.agent import DRAWS, SHUFFLES, FrontAgent, PolicyOfFront
from algorithms.files.checkpoints import GUIDES, PRICE, RHO, strip_prefix
from algorithms.hyperparameters import (
    Count,
    FinalLearningRate,
    Fraction,
    LearningRate,
    NetworkSettings,
    NonNegative,
    Positive,
    PositiveFraction,
    Scales,
    check_entropy_schedule,
    schedules,
)
from algorithms.networks.actors import make_actor
from algorithms.networks.losses import Losses, means, policy_change, proximal_loss
from algorithms.networks.modules import make_network
from algorithms.networks.optimiser import Adam, geometric_schedule, linear_schedule
from algorithms.networks.trained import TrainedNetworks, learners_identity
from algorithms.rollouts.advantages import generalised_advantages, next_values, normalise
from algorithms.rollouts.buffers import Samples
from algorithms.rollouts.collector import Collector
from algorithms.rollouts.compiled_collection import CompiledCollection
from algorithms.rollouts.compiled_preferences import act_under_preferences, conditioned
from algorithms.rollouts.guides import Guides
from algorithms.rollouts.preferences import CHEBYSHEV, COMFORT_BUDGET, LINEAR, Drawn, Preferences, PreferenceSettings
from mo_deepdrive.evaluation.accrued_reward import SMALLEST_DISCOUNT
from mo_deepdrive.evaluation.metrics import (
    ENTROPY_COEFFICIENT,
    LEARNING_RATE,
    vehicle_prefix,
)
from mo_deepdrive.evaluation.policy import check_same_task

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gymnasium.vector import VectorEnv
    from numpy.typing import NDArray

    from algorithms.rollouts.buffers import Episodes, Rollout, VehicleRollout
    from algorithms.rollouts.guides import Guide
    from mo_deepdrive.evaluation.accrued_reward import AccruedReward
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter


class ConditionedMOPPOConfig(PreferenceSettings, NetworkSettings):
    """Hyperparameters of conditioned MO-PPO; the others are described in PreferenceSettings and NetworkSettings."""

    objective_scales: Scales | None = None
    """s, nominal size of each objective's return; None for the environment's own."""
    switching: Fraction = 0.01
    """Probability per decision that the preference changes in the middle of an episode."""
    cost_growth: Fraction = 0.15
    """Fraction of the training in which c of eq. 12 grows linearly from 0 to 1; 0 for weights as drawn from the start.
    Until the first arrival the destination counts as a cost."""
    max_policies: Annotated[int, Field(ge=1, le=100_000)] = 200
    """Number of preferences under which the front is evaluated."""
    learning_rate: LearningRate = 1e-3
    """Adam's step size at the start of training."""
    learning_rate_end: FinalLearningRate | None = None
    """Adam's step size at the end, to which it moves linearly; None for a constant one."""
    gamma: PositiveFraction = 0.99
    """Discount of the return of which the utility is taken."""
    gae_lambda: Fraction = 0.95
    """lambda of eq. 8."""
    steps: Count = 32
    """T, time steps per environment and update."""
    epochs: Annotated[int, Field(ge=1, le=100)] = 4
    """Passes over every rollout."""
    minibatches: Count = 4
    """Gradient steps per pass."""
    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2
    """epsilon of eq. 9."""
    entropy_start: NonNegative = 0.01
    """c_e at the start of training."""
    entropy_end: NonNegative = 0.001
    """c_e at the end, to which it moves geometrically."""
    entropy_until: PositiveFraction = 1.0
    """Fraction of the training after which c_e is ``entropy_end``."""
    value_coefficient: Positive = 0.5
    """c_v."""
    vector_critic: bool = False
    """Whether the critic predicts the return of each objective, as the vector-valued Q of Abels et al. (2019) and Yang
    et al. (2019) do, instead of linear utilities of them; only where families has linear ones."""
    max_grad_norm: Positive = 0.5
    """Maximum norm of the gradient."""
    state_dependent_std: bool = True

    @model_validator(mode="after")
    def _consistent(self) -> ConditionedMOPPOConfig:
        check_entropy_schedule(self.entropy_start, self.entropy_end)
        return self


class ConditionedLearner(TrainedNetworks):
    """The networks of one policy, and how they learn.

    Args:
        env: where the vehicles drive.
        vehicles: the indices of those with this policy.
        preferences: of the agent.
        config: hyperparameters.
        generator: draws the initial weights.
        device: of the networks.

    Attributes:
        static_shapes: as of :class:`algorithms.actor_critic.Learner`.
    """

    static_shapes = False

    def __init__(
        self,
        env: EnvAdapter,
        vehicles: tuple[int, ...],
        preferences: Preferences,
        config: ConditionedMOPPOConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        self.vehicles = vehicles
        self.config = config
        self.preferences = preferences
        self.observation_scales = torch.tensor(env.observation_scales, device=device)
        self.input_size = env.observation_size + preferences.width
        self.actor = make_actor(config, self.input_size, env.actions, generator, continuous=env.continuous).to(device)
        # Which components X_t has.
        self.has_objectives = config.vector_critic and LINEAR in preferences.used
        self.has_increases = not self.has_objectives or preferences.used != [LINEAR]
        self.value_size = self.has_objectives * len(env.objectives) + self.has_increases
        self.critic = make_network(config, self.input_size, self.value_size, generator).to(device)
        self.optimiser = Adam([*self.actor.parameters(), *self.critic.parameters()])

    def inputs(
        self,
        observations: torch.Tensor,
        preferences: torch.Tensor,
        accrued: torch.Tensor,
        discounts: torch.Tensor,
    ) -> torch.Tensor:
        """S_t of eq. 6, scaled: (..., input_size) from s_t (..., o), p (..., m), R_t (..., d) and gamma^t (...)."""
        features = self.preferences.features(preferences, accrued, discounts)
        return torch.cat([observations / self.observation_scales, features], dim=-1)

    def update(
        self,
        rollout: VehicleRollout,
        preferences: torch.Tensor,
        learning_rate: float,
        entropy_coefficient: float,
        generator: torch.Generator,
    ) -> dict[str, float]:
        """Epochs of minibatch steps of eq. 9 on a rollout of T steps in N environments; mean losses by name.

        Args:
            rollout: of this vehicle.
            preferences: (T, N, m) under which it acted.
            learning_rate: of Adam.
            entropy_coefficient: c_e.
            generator: shuffles the samples.
        """
        config, samples, steps = self.config, self.samples(rollout, preferences).acted(), []
        if len(samples.actions) == 0:
            return {}
        self.optimiser.param_groups[0]["lr"] = learning_rate
        for minibatch in samples.minibatches(config.epochs, config.minibatches, generator):
            losses = self.loss(minibatch, entropy_coefficient)
            self.optimiser.zero_grad()
            losses.total.backward()
            self.optimiser.clip(config.max_grad_norm, losses.parts)
            self.optimiser.step()
            steps.append(losses)
        return {**means(steps), **policy_change(steps, config.clip)}

    @torch.no_grad()
    def samples(self, rollout: VehicleRollout, preferences: torch.Tensor) -> Samples:
        """What is learnt from a rollout, (T N, ...): B_t, Y_t and log pi_old of the networks as they are now.

        Args:
            rollout: of this vehicle.
            preferences: (T, N, m) under which it acted.
        """
        # V(S_T) is not used where the episode ends with the rollout, else it is that under the preference so far.
        followed = torch.cat([preferences, preferences[-1:]])
        inputs = self.inputs(rollout.observations, followed, rollout.accrued, rollout.discounts)
        values, states = self.critic(inputs), inputs[:-1]
        # Where the preference changes within an episode, S_{t+1} has the one of S_t.
        switched = (followed[1:] != followed[:-1]).any(-1) & ~(rollout.terminated | rollout.truncated)
        following = self.next_values(rollout, preferences, values, switched)
        advantages = self.advantages(rollout, preferences, values[:-1], following, switched)
        weights = rollout.acted.to(advantages.dtype)
        weighed = normalise((self.component_weights(preferences) * advantages).sum(-1), weights)
        log_prob, _ = self.actor(states, rollout.actions)
        return Samples(states, states, rollout.actions, weighed, advantages + values[:-1], weights, log_prob).flat()

    def next_values(
        self, rollout: VehicleRollout, preferences: torch.Tensor, values: torch.Tensor, switched: torch.Tensor
    ) -> torch.Tensor:
        """V(S_{t+1}) (T, N, K): 0 after termination, the value of the true final state after truncation.

        Args:
            rollout: T steps of this vehicle.
            preferences: (T, N, m) under which it acted.
            values: (T + 1, N, K) V of the states in which it acted.
            switched: (T, N) whether another preference follows in the same episode; S_{t+1} has the one of S_t.
        """
        elsewhere = rollout.truncated | switched
        final_values = self.final_values(rollout, preferences, elsewhere)
        return next_values(values[1:], final_values, rollout.terminated, elsewhere)

    def advantages(
        self,
        rollout: VehicleRollout,
        preferences: torch.Tensor,
        values: torch.Tensor,
        next_values: torch.Tensor,
        switched: torch.Tensor,
    ) -> torch.Tensor:
        """A_t (T, N, K) of eqs. 7 and 8 from V(S_t) and V(S_{t+1}); the sum ends where the preference switches."""
        ended, gamma = rollout.terminated | rollout.truncated | switched, self.config.gamma
        deltas = self.components(rollout, preferences) + gamma * next_values - values
        return generalised_advantages(deltas, ended.unsqueeze(-1), gamma * self.config.gae_lambda)

    def final_values(self, rollout: VehicleRollout, preferences: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        """V (T, N, K) of the true states after the steps of a mask, under the preferences (T, N, m) before them.

        Elsewhere it is anything.
        """

        def values(where: torch.Tensor | slice) -> torch.Tensor:
            observations, accrued, discounts = rollout.final_states(where, self.config.gamma)
            found: torch.Tensor = self.critic(self.inputs(observations, preferences[where], accrued, discounts))
            return found

        if self.static_shapes:
            return values(slice(None))
        found = torch.zeros((*where.shape, self.value_size), device=where.device)
        if where.any():
            found[where] = values(where)
        return found

    def loss(self, samples: Samples, entropy_coefficient: float | torch.Tensor) -> Losses:
        """L of eq. 9, a function of tensors that autograd differentiates."""
        log_prob, entropies = self.actor(samples.inputs, samples.actions)
        outputs = self.critic(samples.critic_inputs)
        return proximal_loss(log_prob, entropies, outputs, samples, self.config, entropy_coefficient)

    def components(self, rollout: VehicleRollout, preferences: torch.Tensor) -> torch.Tensor:
        """X_t (T, N, K) of a rollout that acted under preferences (T, N, m)."""
        parts = []
        if self.has_objectives:
            parts.append(rollout.rewards / self.preferences.scales.to(rollout.rewards))
        if self.has_increases:
            u, discounts = self.preferences.utility, rollout.discounts[:-1].clamp(min=SMALLEST_DISCOUNT)
            # Equation 5, in double precision because gamma^t becomes small.
            before = rollout.accrued[:-1].double()
            after = before + discounts.unsqueeze(-1) * rollout.rewards
            increases = (u(after, preferences) - u(before, preferences)) / discounts
            parts.append(increases.to(rollout.rewards.dtype).unsqueeze(-1))
        return torch.cat(parts, dim=-1)

    def component_weights(self, preferences: torch.Tensor) -> torch.Tensor:
        """k(p) (..., K) of preferences (..., m)."""
        linear = self.preferences.is_family(preferences, LINEAR).unsqueeze(-1)
        parts = []
        if self.has_objectives:
            parts.append(self.preferences.weights(preferences) * linear)
        if self.has_increases:
            parts.append((~linear if self.has_objectives else torch.ones_like(linear)).to(preferences.dtype))
        return torch.cat(parts, dim=-1)


class ConditionedMOPPO(FrontAgent):
    """MO-PPO conditioned on preferences: every vehicle has one of its own, and a learner, or all share one.

    Args:
        env: a vector environment with vector rewards, from `mo_deepdrive.evaluation.env_adapter.make_env`.
        guides: what begins episodes.
        share_policy: one policy, learnt from what all vehicles do, instead of one for each.
        **options: ``seed``, ``device`` and the hyperparameters, as of :class:`algorithms.agent.Agent`.

    Attributes:
        preferences: what a condition means; ``agent.policy(agent.preferences.condition("linear", {"distance": 1}))``
            drives one vehicle under weights, and ``agent.policy(rows)`` each of V under its row of ``rows`` (V, m).

    Raises:
        ValueError: for unknown or invalid hyperparameters or spaces, an environment that emits magnitudes, or guides
            that cannot drive here.
    """

    name = "conditioned_mo_ppo"
    Config = ConditionedMOPPOConfig
    trains_on_devices = True
    trains_with_guides = True
    shares_policies = True

    def __init__(self, env: VectorEnv, *, guides: Sequence[Guide] = (), share_policy: bool = False, **options: Any):
        super().__init__(env, **options)
        if self.env.cost_sign != "maximise":
            raise ValueError(f"cost_sign = {self.env.cost_sign!r}: algorithm {self.name!r} needs 'maximise'")
        self.guides = Guides(guides, self.accrued_discount)
        for guide in self.guides:
            check_same_task(guide.driver.members[0].env, self.env)
        config = self.config
        self.scales = self.env.chosen_objective_scales(config.objective_scales)
        self.preferences = Preferences(config, self.env.objectives, self.scales)
        self.learners = [
            ConditionedLearner(self.env, vehicles, self.preferences, config, self.initial, self.device)
            for vehicles in self.vehicle_groups(share_policy)
        ]
        self.collector = Collector(self.env, self.accrued_discount, config.steps)
        self._compiled: CompiledCollection | None = None
        m = len(self.preferences.names)
        self._current = np.zeros((self.env.num_envs, self.env.vehicles, m), dtype=np.float32)

    @property
    def schedules(self) -> list[str]:
        """Those of learning rate, entropy and costs, and guides, which withdraw."""
        return [*schedules(self.config), *self.guides.schedules]

    # ------------------------------------------------------------------------------------------------------ the update

    def begin(self) -> None:
        """Reset the environments."""
        self.collector.reset(self.env_seed)

    def update(self, progress: float) -> dict[str, float]:
        """Collect one rollout; each learner learns from its vehicles' part."""
        config = self.config
        drawn = self._draw_preferences(progress)
        rollout, episodes = self._collect(progress, drawn)
        self.episodes.append(episodes)
        self.step += config.steps * self.env.num_envs
        self.updates += 1

        learning_rate = linear_schedule(config.learning_rate, config.learning_rate_end, progress)
        entropy_coefficient = geometric_schedule(
            config.entropy_start, config.entropy_end, progress / config.entropy_until
        )
        metrics = {LEARNING_RATE: learning_rate, ENTROPY_COEFFICIENT: entropy_coefficient}
        followed = torch.from_numpy(drawn.followed).to(self.device)
        for learner in self.learners:
            own = rollout.of_vehicles(learner.vehicles, self.device, others=False)
            generator = self.update_generator(SHUFFLES + learner.vehicle)
            under = followed[:, :, list(learner.vehicles)].flatten(1, 2)
            losses = learner.update(own, under, learning_rate, entropy_coefficient, generator)
            prefix = learner.metric_prefix(self.env.vehicles)
            metrics |= {prefix + name: value for name, value in losses.items()}
        self.preferences.note_episodes(episodes.discounted)
        return metrics

    def _draw_preferences(self, progress: float) -> Drawn:
        """Preferences for every decision of a rollout; those are followed with which an episode begins, or a change."""
        config, rng = self.config, np.random.default_rng([self.seed, DRAWS, self.updates])
        cost_share = min(1.0, progress / config.cost_growth) if config.cost_growth else 1.0
        changes = rng.random((config.steps, *self._current.shape[:2])) < config.switching
        rows = self.preferences.draw(changes.size, rng, cost_share).reshape(*changes.shape, -1)
        return Drawn(rows, changes, np.empty_like(rows))

    def _collect(self, progress: float, drawn: Drawn) -> tuple[Rollout, Episodes]:
        """A rollout; without guides and with networks of ours in one compiled call, with the same bits."""
        if self._compiled is None and self._can_be_compiled():
            actors = {learner.vehicles: learner.actor for learner in self.learners}
            self._compiled = CompiledCollection(self.collector, actors, None, act_under_preferences)
        if self._compiled is not None:
            complete = partial(conditioned, preferences=self.preferences, current=self._current, drawn=drawn)
            self._compiled.collect(self.generator, complete)
            return self.collector.collected()
        steps = zip(*drawn, strict=True)

        def explore(observations: NDArray[np.float32], accrued_reward: AccruedReward) -> NDArray[Any]:
            candidates, changes, followed = next(steps)
            begins = (accrued_reward.decisions == 0) | changes
            self._current[begins] = candidates[begins]
            followed[:] = self._current
            actions = self.choose_actions(observations, self._current, accrued_reward, self.generator)
            return self.guides.drive(actions, observations, accrued_reward, self.generator)

        self.guides.begin_rollout(progress)
        rollout, episodes = self.collector.collect(explore)
        self.guides.hide(rollout)
        return rollout, episodes

    def _can_be_compiled(self) -> bool:
        """Whether the learners alone act, as this file defines it."""
        own = type(self).choose_actions is ConditionedMOPPO.choose_actions
        actors = [learner.actor for learner in self.learners]
        return own and not any(self.guides) and CompiledCollection.serves(self.collector, actors)

    # ---------------------------------------------------------------------------------------------------------- acting

    @torch.inference_mode()
    def choose_actions(
        self,
        observations: NDArray[np.float32],
        preferences: NDArray[np.float32],
        accrued_reward: AccruedReward,
        generator: torch.Generator | None,
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o) under preferences (N, V, m); greedy without generator.

        Args:
            observations: (N, V, o).
            preferences: (N, V, m).
            accrued_reward: of the running episodes.
            generator: samples actions; None acts greedily.
        """
        arrays = (observations, preferences, accrued_reward.value, accrued_reward.discounts)
        chosen: dict[int, NDArray[Any]] = {}
        for learner in self.learners:
            x = learner.inputs(*(learner.rows(array).to(self.device) for array in arrays))
            chosen |= learner.choose(x, generator)
        return np.stack([chosen[v] for v in sorted(chosen)], axis=1)

    # ------------------------------------------------------------------------------------------------------- the front

    @property
    def condition_names(self) -> tuple[str, ...]:
        """The components of a preference, of each vehicle in turn."""
        vehicles = self.env.vehicles
        return tuple(vehicle_prefix(v, vehicles) + name for v in range(vehicles) for name in self.preferences.names)

    def conditions(self) -> NDArray[np.float32]:
        """(K, V m) preferences from the distribution of training, the same ones every time."""
        count, vehicles = self.config.max_policies, self.env.vehicles
        rows = self.preferences.draw(count * vehicles, np.random.default_rng(0))
        return rows.reshape(count, -1)

    def policies(self, conditions: NDArray[np.float32]) -> PreferencePolicy:
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
        return PreferencePolicy(self, preferences)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share; with other scales, families, rho or price a preference means something else."""
        config = self.config
        return {
            **super().identity(),
            GUIDES: self.guides.identity(),
            **config.identity(continuous=self.env.continuous),
            "preferences": list(self.preferences.names),
            "objective_scales": self.scales.tolist(),
            "budgets": dict(config.budgets),
            **({RHO: config.rho} if CHEBYSHEV in self.preferences.used else {}),
            **({PRICE: config.price} if COMFORT_BUDGET in self.preferences.used else {}),
            "gamma": self.accrued_discount,
            **learners_identity(self.learners),
        }

    def get_state(self) -> dict[str, torch.Tensor]:
        """Learners, the preferences of running episodes, environments and the ideal point."""
        state = {
            "preferences": torch.from_numpy(self._current.copy()),
            "seen_any": torch.tensor(self.preferences.seen_any),
            **self._ideal_tensor(),
            **self.guides.get_state(),
        }
        for learner in self.learners:
            state |= {f"{learner.name}.{name}": tensor for name, tensor in learner.get_state().items()}
        state |= {f"collector.{name}": tensor for name, tensor in self.collector.tensors().items()}
        return state

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`.

        Raises:
            ValueError: for values from which training cannot continue.
        """
        for learner in self.learners:
            learner.set_state(strip_prefix(state, f"{learner.name}."))
        self.preferences.ideal = state["ideal"].clone()
        if self.step:
            self.preferences.check(state["preferences"].numpy())
        self._current[...] = state["preferences"].numpy()
        self.preferences.seen_any = bool(state["seen_any"])
        self.guides.set_state(state)
        self.updates = self.collector.resume(strip_prefix(state, "collector."), self.step, self.env_seed)

    def _ideal_tensor(self) -> dict[str, torch.Tensor]:
        return {"ideal": self.preferences.ideal}

    def get_policy(self) -> dict[str, torch.Tensor]:
        """The actors' weights and the ideal point, on which they depend."""
        policy = self._ideal_tensor()
        for learner in self.learners:
            policy |= {f"{learner.name}.{name}": tensor for name, tensor in learner.get_policy().items()}
        return policy

    def set_policy(self, state: dict[str, torch.Tensor]) -> None:
        """Act as the agent of :meth:`get_policy` or :meth:`get_state`."""
        for learner in self.learners:
            learner.set_policy(strip_prefix(state, f"{learner.name}."))
        self.preferences.ideal = state["ideal"].clone()


@dataclass(frozen=True)
class PreferencePolicy(PolicyOfFront):
    """The network under fixed preferences.

    Attributes:
        agent: whose networks act.
        preferences: (N, V, m), one row per environment, or (1, V, m) for all.
    """

    agent: ConditionedMOPPO
    preferences: NDArray[np.float32]

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy where ``generator`` is None."""
        rows = np.broadcast_to(self.preferences, (len(observations), *self.preferences.shape[1:])).copy()
        return self.agent.choose_actions(observations, rows, accrued_reward, generator)
