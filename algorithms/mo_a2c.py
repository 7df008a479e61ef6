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
from algorithms.networks.losses import Losses, policy_gradient_loss
from algorithms.networks.modules import make_network
from algorithms.networks.optimiser import Adam
from algorithms.rollouts.advantages import (
    AdvantageForm,
    check_utility_gradient,
    normalise,
    utility_advantages,
)
from algorithms.rollouts.buffers import Samples
from algorithms.rollouts.running_mean import RunningMean

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
    """MO-A2C for one policy; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: MOA2CConfig

    def __init__(
        self,
        env: EnvAdapter,
        vehicles: tuple[int, ...],
        utility: Utility,
        config: MOA2CConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(env, vehicles, utility, config, generator, device)
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

    # ------------------------------------------------------------------------------------------------------ the update

    def update(
        self, rollout: VehicleRollout, learning_rate: float, entropy_coefficient: float, generator: torch.Generator
    ) -> dict[str, float]:
        """One gradient step of eq. 6 on a rollout of T steps in N environments; the losses by name."""
        del generator  # nothing is drawn
        if not rollout.acted.any():
            return {}
        losses = self.loss(self.samples(rollout), entropy_coefficient)
        self.optimiser.param_groups[0]["lr"] = learning_rate
        self.optimiser.zero_grad()
        losses.total.backward()
        self.optimiser.clip(self.config.max_grad_norm, losses.parts)
        self.optimiser.step()
        return losses.parts()

    def samples(self, rollout: VehicleRollout) -> Samples:
        """What is learnt from a rollout, (T N, ...): A_t, y_t and v(S_t) of the networks as they are now."""
        inputs = self.inputs(rollout.observations, rollout.accrued, rollout.discounts)
        critic_inputs = self.critic_inputs(inputs, rollout.others)
        outputs = self.critic(critic_inputs.flatten(0, 1))  # one pass, for the advantages and for the loss
        with torch.no_grad():
            values = (self.value_scales * outputs).unflatten(0, critic_inputs.shape[:2])
            advantages, targets = self.advantages(rollout, values[:-1], self.next_values(rollout, values))
            weights = rollout.acted.to(advantages.dtype)
            if self.config.normalise_advantages:
                advantages = normalise(advantages, weights)
        states, critic_states, targets = inputs[:-1], critic_inputs[:-1], targets / self.value_scales
        samples = Samples(states, critic_states, rollout.actions, advantages, targets, weights).flat()
        return samples._replace(outputs=outputs[: len(samples.actions)]) if outputs.requires_grad else samples

    def advantages(
        self, rollout: VehicleRollout, values: torch.Tensor, next_values: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """A_t (T, N) and y_t (T, N, d or 1) of eqs. 2 to 5, or 7 and 8, from v(S_t) and v(S_{t+1}), as y_t."""
        expected = self.expected_return.value
        return utility_advantages(rollout, values, next_values, self.utility, self.config, expected)

    def loss(self, samples: Samples, entropy_coefficient: float | torch.Tensor) -> Losses:
        """L of eq. 6, a function of tensors that autograd differentiates."""
        log_prob, entropies = self.actor(samples.inputs, samples.actions)
        outputs = self.critic(samples.critic_inputs) if samples.outputs is None else samples.outputs
        return policy_gradient_loss(log_prob, entropies, outputs, samples, self.config, entropy_coefficient)

    def on_episodes_end(self, discounted_returns: NDArray[np.float64]) -> None:
        """Update E[R] with the discounted returns (E, d) of episodes that ended, also of those that a guide began."""
        self.expected_return.add(discounted_returns)
        if self.config.advantage == "utility_gradient":
            check_utility_gradient(self.utility, self.expected_return.value)

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
    trains_on_devices = True

    @property
    def accrued_discount(self) -> float:
        """Discount g of the accrued reward."""
        return float(self.config.accrued_discount)
