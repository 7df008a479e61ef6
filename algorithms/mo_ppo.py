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

The means are over the samples in which the vehicle acted. :mod:`algorithms.mo_a2c` explains ``accrued_gamma`` (g), the
forms of ``advantage``.

Objective, as there: ``utility_difference``, the default, follows the expected utility of the return (ESR) within the
rollout, and the utility of the expected return (SER) for what lies beyond it or beyond 1 / (1 - lambda) decisions;
``utility_gradient`` follows SER; ``expected_utility`` ESR, with gamma < g that of episodes which are cut short.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch
from pydantic import Field, model_validator

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
from algorithms.networks.losses import Losses, means, policy_change, proximal_loss
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


class MOPPOConfig(ActorCriticSettings):
    """Hyperparameters of MO-PPO; those of actor and critic are described in ActorCriticSettings."""

    learning_rate: LearningRate = 1e-3
    """Adam's step size at the start of training."""
    learning_rate_end: FinalLearningRate | None = None
    """Adam's step size at the end, to which it moves linearly; None for a constant one."""
    gamma: Fraction = 0.99
    """Discount of the critic; with "expected_utility" at most g, and gamma / g is that of the increases of u."""
    gae_lambda: Fraction = 0.95
    """lambda of eqs. 3 and 5; 0 gives one-step advantages, 1 uses the whole rollout."""
    advantage: AdvantageForm = "utility_difference"
    """How A_t is calculated, by eqs. 4 and 5, as printed in the paper, by the gradient of u, or by eqs. 8 and 9."""
    accrued_gamma: PositiveFraction | None = None
    """g, discount of the accrued reward; None for gamma, as in the paper."""
    observe_accrued: bool = True
    """Include R_t in the state, as the theory requires; without it the policy ignores the past."""
    observe_discount: bool = True
    """Include g^t in the state, on which eq. 4 depends too."""
    steps: Count = 16
    """T, time steps per environment and update."""
    epochs: Annotated[int, Field(ge=1, le=100)] = 4
    """Passes over every rollout."""
    minibatches: Count = 4
    """Gradient steps per pass."""
    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2
    """epsilon of eq. 7."""
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
    """Normalise the advantages of a rollout to mean 0 and standard deviation 1."""
    objective_scales: Scales | None = None
    """Nominal size of each objective's return; None for the environment's own."""
    utility_scale: Positive = 10.0
    """Nominal size of the utility of a return, for the critic of "expected_utility"."""
    centralised_critic: bool = False
    """The critic also sees the observations of the other vehicles; the actor does not."""

    @model_validator(mode="after")
    def _consistent(self) -> MOPPOConfig:
        check_entropy_schedule(self.entropy_start, self.entropy_end)
        check_discounts(self.advantage, self.gamma, self.accrued_discount)
        return self

    @property
    def accrued_discount(self) -> float:
        """g: ``accrued_gamma``, or gamma where that is None."""
        return self.gamma if self.accrued_gamma is None else self.accrued_gamma


class MOPPOLearner(Learner):
    """MO-PPO for one policy; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: MOPPOConfig

    def __init__(
        self,
        env: EnvAdapter,
        vehicles: tuple[int, ...],
        utility: Utility,
        config: MOPPOConfig,
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
        """Epochs of minibatch steps of eq. 7 on a rollout of T steps in N environments; mean losses by name."""
        config, samples, steps = self.config, self.samples(rollout).acted(), []
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
    def samples(self, rollout: VehicleRollout) -> Samples:
        """What is learnt from a rollout, (T N, ...): A_t, y_t and log pi_old of the networks as they are now."""
        inputs = self.inputs(rollout.observations, rollout.accrued, rollout.discounts)
        values = self.values(self.critic_inputs(inputs, rollout.others))
        advantages, targets = self.advantages(rollout, values[:-1], self.next_values(rollout, values))
        weights, states = rollout.acted.to(advantages.dtype), inputs[:-1]
        if self.config.normalise_advantages:
            advantages = normalise(advantages, weights)
        log_prob, _ = self.actor(states, rollout.actions)
        critic_states = self.critic_inputs(states, rollout.others[:-1])
        targets = targets / self.value_scales
        return Samples(states, critic_states, rollout.actions, advantages, targets, weights, log_prob).flat()

    def advantages(
        self, rollout: VehicleRollout, values: torch.Tensor, next_values: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """A_t (T, N) and y_t (T, N, d or 1) of eqs. 2 to 5, or 8 and 9, from v(S_t) and v(S_{t+1}), as y_t."""
        expected = self.expected_return.value
        return utility_advantages(rollout, values, next_values, self.utility, self.config, expected)

    def loss(self, samples: Samples, entropy_coefficient: float | torch.Tensor) -> Losses:
        """L of eq. 7, a function of tensors that autograd differentiates."""
        log_prob, entropies = self.actor(samples.inputs, samples.actions)
        outputs = self.critic(samples.critic_inputs)
        return proximal_loss(log_prob, entropies, outputs, samples, self.config, entropy_coefficient)

    def on_episodes_end(self, discounted_returns: NDArray[np.float64]) -> None:
        """Update E[R] with the discounted returns (E, d) of episodes that ended, also of those that a guide began."""
        self.expected_return.add(discounted_returns)
        if self.config.advantage == "utility_gradient":
            check_utility_gradient(self.utility, self.expected_return.value)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def get_state(self) -> dict[str, torch.Tensor]:
        """Networks, optimiser and E[R]."""
        return {**super().get_state(), **self.expected_return.get_state()}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        super().set_state(state)
        self.expected_return.set_state(state)


class MOPPO(ActorCritic):
    """Multi-objective proximal policy optimisation for a known utility, one independent learner per vehicle."""

    name = "mo_ppo"
    Config = MOPPOConfig
    learner = MOPPOLearner
    trains_on_devices = True

    @property
    def accrued_discount(self) -> float:
        """Discount g of the accrued reward."""
        return float(self.config.accrued_discount)
