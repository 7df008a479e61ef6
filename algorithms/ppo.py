"""PPO: proximal policy optimisation (Schulman et al. 2017) on scalarised rewards, as A2C is scalarised.

The advantages A_t and the critic's targets y_t are those of A2C (:mod:`algorithms.a2c`):

    delta_t = u(r_t) + gamma v(s_{t+1}) - v(s_t)                                            (1)
    A_t     = delta_t + gamma lambda A_{t+1},    y_t = A_t + v(s_t)                         (2)

but instead of one gradient step, every rollout serves several epochs of minibatches of the clipped surrogate (Schulman
et al. 2017, eq. 7), so that the policy can learn from a rollout more than once without moving far from the policy
pi_old that collected it:

    rho_t = pi(a_t | s_t) / pi_old(a_t | s_t)                                               (3)
    L     = -E[min(rho_t A_t, clip(rho_t, 1 - epsilon, 1 + epsilon) A_t)]
            + c_v E[(y_t - v(s_t))^2] - c_e E[H(pi)]                                        (4)

Objective: the expected discounted sum of u(r_t), as A2C's. For a non-linear u that is neither the expected utility of
the return (ESR) nor the utility of the expected return (SER; Hayes et al. 2022).
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
    check_entropy_schedule,
)
from algorithms.networks.actors import make_actor
from algorithms.networks.losses import Losses, means, policy_change, proximal_loss
from algorithms.networks.modules import make_network
from algorithms.networks.optimiser import Adam
from algorithms.rollouts.advantages import generalised_advantages, normalise
from algorithms.rollouts.buffers import Samples

if TYPE_CHECKING:
    from algorithms.rollouts.buffers import VehicleRollout
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility


class PPOConfig(ActorCriticSettings):
    """Hyperparameters of PPO; those of actor and critic are described in ActorCriticSettings."""

    learning_rate: LearningRate = 1e-3
    """Adam's step size at the start of training."""
    learning_rate_end: FinalLearningRate | None = None
    """Adam's step size at the end, to which it moves linearly; None for a constant one."""
    gamma: Fraction = 0.99
    """Discount."""
    gae_lambda: Fraction = 0.95
    """lambda of eq. 2; 0 gives one-step advantages, 1 uses the whole rollout."""
    steps: Count = 16
    """T, time steps per environment and update."""
    epochs: Annotated[int, Field(ge=1, le=100)] = 4
    """Passes over every rollout."""
    minibatches: Count = 4
    """Gradient steps per pass."""
    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2
    """epsilon of eq. 4."""
    entropy_start: NonNegative = 0.01
    """c_e at the start of training."""
    entropy_end: NonNegative = 0.01
    """c_e at the end, to which it moves geometrically."""
    entropy_until: PositiveFraction = 1.0
    """Fraction of the training after which c_e is ``entropy_end``."""
    value_coefficient: Positive = 0.5
    """c_v."""
    value_scale: Positive = 10.0
    """Nominal size of a scalar return, by which the critic's output is multiplied."""
    max_grad_norm: Positive = 0.5
    """Maximum norm of the gradient."""
    normalise_advantages: bool = True
    """Normalise the advantages of a rollout to mean 0 and standard deviation 1."""
    objective_scales: Scales | None = None
    """Nominal size of each objective's return; None for the environment's own."""
    centralised_critic: bool = False
    """The critic also sees the observations of the other vehicles; the actor does not."""

    @model_validator(mode="after")
    def _consistent(self) -> PPOConfig:
        check_entropy_schedule(self.entropy_start, self.entropy_end)
        return self


class PPOLearner(Learner):
    """PPO for one policy; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: PPOConfig

    def __init__(
        self,
        env: EnvAdapter,
        vehicles: tuple[int, ...],
        utility: Utility,
        config: PPOConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(env, vehicles, utility, config, generator, device)
        self.input_size = env.observation_size
        self.actor = make_actor(config, self.input_size, env.actions, generator, continuous=env.continuous).to(device)
        self.critic = make_network(config, self.input_size + self.others_size, 1, generator).to(device)
        self.value_scales = torch.tensor([config.value_scale], device=device)
        self.optimiser = Adam([*self.actor.parameters(), *self.critic.parameters()])

    # ------------------------------------------------------------------------------------------------------ the update

    def update(
        self, rollout: VehicleRollout, learning_rate: float, entropy_coefficient: float, generator: torch.Generator
    ) -> dict[str, float]:
        """Epochs of minibatch steps of eq. 4 on a rollout of T steps in N environments; mean losses by name."""
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
        """A_t (T, N) and y_t (T, N, 1) of eqs. 1 and 2, from v(s_t) and v(s_{t+1}), as y_t."""
        ended, gamma = (rollout.terminated | rollout.truncated).unsqueeze(-1), self.config.gamma
        deltas = self.utility(rollout.rewards).unsqueeze(-1) + gamma * next_values - values
        advantages = generalised_advantages(deltas, ended, gamma * self.config.gae_lambda)
        return advantages.squeeze(-1), advantages + values

    def loss(self, samples: Samples, entropy_coefficient: float | torch.Tensor) -> Losses:
        """L of eq. 4, a function of tensors that autograd differentiates."""
        log_prob, entropies = self.actor(samples.inputs, samples.actions)
        outputs = self.critic(samples.critic_inputs)
        return proximal_loss(log_prob, entropies, outputs, samples, self.config, entropy_coefficient)


class PPO(ActorCritic):
    """Proximal policy optimisation on scalarised rewards, one independent learner per vehicle."""

    name = "ppo"
    Config = PPOConfig
    learner = PPOLearner
    trains_on_devices = True
