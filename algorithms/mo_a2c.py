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
equation lacks (``advantage: as_printed`` drops it). With ``accrued_gamma: 1`` the past counts in full, and a linear
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
from pydantic import model_validator

from algorithms.actor_critic import ActorCritic, Learner
from algorithms.hyperparameters import (
    ActorCriticSettings,
    Count,
    FinalLearningRate,
    Fraction,
    LearningRate,
    NonNegative,
    Positive,
    PositiveFraction,
    Scales,
    check_discounts,
    check_entropy_schedule,
)
from algorithms.networks.actors import make_actor
from algorithms.networks.losses import Loss, squared_error, weighted_sum
from algorithms.networks.modules import centralised_inputs, make_network
from algorithms.networks.optimiser import Adam
from algorithms.rollouts.advantages import (
    AdvantageForm,
    generalised_advantages,
    normalise,
    utility_gradient,
)
from algorithms.rollouts.running_mean import RunningMean
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from algorithms.rollouts.buffers import VehicleRollout
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility


class MOA2CConfig(ActorCriticSettings):
    """Hyperparameters of MO-A2C; those of actor and critic are described in ActorCriticSettings."""

    learning_rate: LearningRate = 1e-3
    """Adam's step size at the start of training."""
    learning_rate_end: FinalLearningRate | None = None
    """Adam's step size at the end, to which it moves linearly; None for a constant one."""
    gamma: Fraction = 0.99
    """Discount of the critic; with "expected_utility" at most g, and gamma / g is that of the increases of u."""
    gae_lambda: Fraction = 0.95
    """lambda of eqs. 3 and 5; 0 gives one-step advantages, 1 uses the whole rollout."""
    advantage: AdvantageForm = "utility_difference"
    """How A_t is calculated, by eqs. 4 and 5, as printed in the paper, by the gradient of u, or by eqs. 7 and 8."""
    accrued_gamma: PositiveFraction | None = None
    """g, discount of the accrued reward; None for gamma, as in the paper."""
    observe_accrued: bool = True
    """Include R_t in the state, as the theory requires; without it the policy ignores the past."""
    observe_discount: bool = True
    """Include g^t in the state, on which eq. 4 depends too."""
    steps: Count = 16
    """T, time steps per environment and update."""
    entropy_start: NonNegative = 0.01
    """c_e at the start of training."""
    entropy_end: NonNegative = 0.01
    """c_e at the end, to which it moves geometrically."""
    entropy_until: PositiveFraction = 1.0
    """Fraction of the training after which c_e is ``entropy_end``."""
    value_coefficient: Positive = 0.5
    """c_v."""
    max_grad_norm: Positive = 0.5
    """Maximum norm of the gradient."""
    normalise_advantages: bool = True
    """Normalise the advantages of an update to mean 0 and standard deviation 1."""
    objective_scales: Scales | None = None
    """Nominal size of each objective's return; None for the environment's own."""
    utility_scale: Positive = 10.0
    """Nominal size of the utility of a return, for the critic of "expected_utility"."""
    centralised_critic: bool = False
    """The critic also sees the observations of the other vehicles; the actor does not."""

    @model_validator(mode="after")
    def _consistent(self) -> MOA2CConfig:
        check_entropy_schedule(self.entropy_start, self.entropy_end)
        check_discounts(self.advantage, self.gamma, self.accrued_discount)
        return self

    @property
    def accrued_discount(self) -> float:
        """g: ``accrued_gamma``, or gamma where that is None."""
        return self.gamma if self.accrued_gamma is None else self.accrued_gamma


class MOA2CLearner(Learner):
    """MO-A2C for one vehicle; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: MOA2CConfig

    def __init__(
        self,
        env: EnvAdapter,
        vehicle: int,
        utility: Utility,
        config: MOA2CConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(env, vehicle, utility, config, generator, device)
        d = len(env.objectives)
        # S_t of eq. 1: what the actor and the critic see.
        self.observes_accrued, self.observes_discount = config.observe_accrued, config.observe_discount
        self.input_size = env.observation_size + d * config.observe_accrued + config.observe_discount
        self.actor = make_actor(config, self.input_size, env.actions, generator, continuous=env.continuous).to(device)
        # What the critic predicts: returns, or with expected_utility their utility.
        scalar = config.advantage == "expected_utility"
        self.value_scales = torch.tensor([config.utility_scale], device=device) if scalar else self.objective_scales
        outputs = len(self.value_scales)
        self.critic = make_network(config, self.input_size + self.others_size, outputs, generator).to(device)
        self.optimiser = Adam([*self.actor.parameters(), *self.critic.parameters()])
        self.expected_return = RunningMean(d, device)  # E[R], for utility_gradient

    # ------------------------------------------------------------------------------------------- what the networks see

    def critic_inputs(self, inputs: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """What the critic sees: ``inputs``, and with a centralised critic the other vehicles' observations."""
        return centralised_inputs(inputs, others, self.observation_scales) if self.others_size else inputs

    def values(self, critic_inputs: torch.Tensor) -> torch.Tensor:
        """v(S) (..., d) in the units of the returns, or (..., 1) in those of the utility."""
        outputs: torch.Tensor = self.critic(critic_inputs)
        return self.value_scales * outputs

    # ------------------------------------------------------------------------------------------------------ the update

    def update(self, rollout: VehicleRollout, learning_rate: float, entropy_coefficient: float) -> dict[str, float]:
        """One gradient step of eq. 6 on a rollout of T steps in N environments; the losses by name."""
        if not rollout.acted.any():
            return {}
        with self.optimiser.recording():
            losses = self.losses(rollout, entropy_coefficient)
        total = losses.pop("total")
        self.optimiser.minimise(total, learning_rate, self.config.max_grad_norm, losses)
        return {name: float(loss) for name, loss in losses.items()}

    def losses(self, rollout: VehicleRollout, entropy_coefficient: float) -> dict[str, Loss]:
        """L of eq. 6 as "total", and its parts."""
        config = self.config
        inputs = self.inputs(rollout.observations, rollout.accrued, rollout.discounts)
        critic_inputs = self.critic_inputs(inputs, rollout.others)
        outputs: torch.Tensor = self.critic(critic_inputs[:-1].flatten(0, 1))  # v(S_t) / scales
        values = self.value_scales * outputs.detach().view(*rollout.acted.shape, -1)
        next_values = self.next_values(rollout, critic_inputs, values)
        advantages, targets = self.advantages(rollout, values, next_values)

        weights = rollout.acted.to(advantages.dtype)
        weights = weights / weights.sum().clamp(min=1.0)
        if config.normalise_advantages:
            advantages = normalise(advantages, weights)

        log_prob, entropies = self.actor.log_prob_and_entropy(inputs[:-1].flatten(0, 1), rollout.actions.flatten(0, 1))
        weights, advantages, targets = (each.flatten(0, 1) for each in (weights, advantages, targets))
        policy_loss = -weighted_sum(weights * advantages, log_prob)
        value_loss = squared_error(outputs, targets / self.value_scales, weights)
        entropy = weighted_sum(weights, entropies)
        total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
        return {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy, "total": total}

    @torch.no_grad()
    def next_values(self, rollout: VehicleRollout, critic_inputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """v(S_{t+1}) (T, N, d or 1): 0 after termination, the value of the true final state after truncation.

        Args:
            rollout: T steps of this vehicle.
            critic_inputs: (T + 1, N, ...) of S_0 to S_T.
            values: (T, N, d or 1) v(S_t).
        """
        next_values = torch.cat([values[1:], self.values(critic_inputs[-1:])])
        next_values[rollout.terminated] = 0.0
        truncated = rollout.truncated & ~rollout.terminated
        if truncated.any():
            final = self.inputs(*rollout.final_states(truncated, self.config.accrued_discount))
            next_values[truncated] = self.values(self.critic_inputs(final, rollout.final_others[truncated]))
        return next_values

    def advantages(
        self, rollout: VehicleRollout, values: torch.Tensor, next_values: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """A_t (T, N) and y_t (T, N, d or 1) of eqs. 2 to 5 or 7 and 8, from v(S_t) and v(S_{t+1}), as y_t."""
        u, gamma, g, decay = self.utility, self.config.gamma, self.config.accrued_discount, self.config.gae_lambda
        not_done = (~(rollout.terminated | rollout.truncated)).to(values.dtype)
        # R_t and g^t of the accrued reward, and R_{t+1} = R_t + g^t r_t.
        accrued, discounts = rollout.accrued[:-1], rollout.discounts[:-1].unsqueeze(-1)
        next_accrued = accrued + discounts * rollout.rewards
        ratio = 1.0 if g == gamma else gamma / g
        if self.config.advantage == "expected_utility":
            # Equations 7 and 8.
            increases = u(next_accrued) - u(accrued)
            gains = increases + ratio * next_values.squeeze(-1) - values.squeeze(-1)
            advantages = generalised_advantages(gains, not_done, decay * ratio)
            return advantages, advantages.unsqueeze(-1) + values

        # Equations 2 and 3.
        deltas = rollout.rewards + gamma * next_values - values
        vector_advantages = generalised_advantages(deltas, not_done.unsqueeze(-1), gamma * decay)
        targets = vector_advantages + values
        if self.config.advantage == "utility_gradient":
            return vector_advantages @ utility_gradient(u, self.expected_return.value), targets

        # Equation 4.
        expected_rest = next_values if self.config.advantage == "as_printed" else discounts * gamma * next_values
        differences: torch.Tensor = u(next_accrued + expected_rest) - u(accrued + discounts * values)
        # Equation 5.
        return generalised_advantages(differences, not_done, decay * ratio), targets

    def on_episodes_end(self, discounted_returns: NDArray[np.float64]) -> None:
        """Update E[R] with the discounted returns (E, d) of episodes that ended, also of those that a guide began."""
        self.expected_return.add(discounted_returns)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def get_state(self) -> dict[str, torch.Tensor]:
        """Weights, the optimiser's state and E[R]."""
        return {**super().get_state(), **self.expected_return.get_state()}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        super().set_state(state)
        self.expected_return.set_state(state)


class MOA2C(ActorCritic):
    """Multi-objective advantage actor-critic for a known utility, one independent learner per vehicle."""

    name = "mo_a2c"
    Config = MOA2CConfig
    learner = MOA2CLearner

    @property
    def accrued_discount(self) -> float:
        """Discount g of the accrued reward."""
        return float(self.config.accrued_discount)
