"""A2C: advantage actor-critic on scalarised rewards (Mnih et al. 2016), the baseline of Ajridi et al. 2023, section 5.

With the utility u, the reward of a time step is the scalar u(r_t), and the critic v predicts its discounted sum:

    delta_t = u(r_t) + gamma v(s_{t+1}) - v(s_t)                                      (1)
    A_t     = delta_t + gamma lambda A_{t+1}      within an episode                   (2)
    y_t     = A_t + v(s_t)                        target of the critic                (3)
    L       = E[-A_t log pi(a_t | s_t)] + c_v E[(y_t - v(s_t))^2] - c_e E[H(pi)]      (4)

Under a linear utility this maximises what MO-A2C maximises. Under a non-linear one it maximises the expected sum of
u(r_t), which is neither the utility of the expected return (SER) nor the expected utility of the return (ESR).
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
    check_entropy_schedule,
)
from algorithms.networks.actors import make_actor
from algorithms.networks.losses import Losses, policy_gradient_loss
from algorithms.networks.modules import make_network
from algorithms.networks.optimiser import Adam
from algorithms.rollouts.advantages import generalised_advantages, normalise
from algorithms.rollouts.buffers import Samples

if TYPE_CHECKING:
    from algorithms.rollouts.buffers import VehicleRollout
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility


class A2CConfig(ActorCriticSettings):
    """Hyperparameters of A2C; those of actor and critic are described in ActorCriticSettings."""

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
    """Normalise the advantages of an update to mean 0 and standard deviation 1."""
    objective_scales: Scales | None = None
    """Nominal size of each objective's return; None for the environment's own."""
    centralised_critic: bool = False
    """The critic also sees the observations of the other vehicles; the actor does not."""

    @model_validator(mode="after")
    def _consistent(self) -> A2CConfig:
        check_entropy_schedule(self.entropy_start, self.entropy_end)
        return self


class A2CLearner(Learner):
    """A2C for one policy; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: A2CConfig

    def __init__(
        self,
        env: EnvAdapter,
        vehicles: tuple[int, ...],
        utility: Utility,
        config: A2CConfig,
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
        """One gradient step of eq. 4 on a rollout of T steps in N environments; the losses by name."""
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
        """What is learnt from a rollout, (T N, ...): A_t, y_t and v(s_t) of the networks as they are now."""
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
        """A_t (T, N) and y_t (T, N, 1) of eqs. 1 to 3, from v(s_t) and v(s_{t+1}), as y_t."""
        ended, gamma = (rollout.terminated | rollout.truncated).unsqueeze(-1), self.config.gamma
        deltas = self.utility(rollout.rewards).unsqueeze(-1) + gamma * next_values - values
        advantages = generalised_advantages(deltas, ended, gamma * self.config.gae_lambda)
        return advantages.squeeze(-1), advantages + values

    def loss(self, samples: Samples, entropy_coefficient: float | torch.Tensor) -> Losses:
        """L of eq. 4, a function of tensors that autograd differentiates."""
        log_prob, entropies = self.actor(samples.inputs, samples.actions)
        outputs = self.critic(samples.critic_inputs) if samples.outputs is None else samples.outputs
        return policy_gradient_loss(log_prob, entropies, outputs, samples, self.config, entropy_coefficient)


class A2C(ActorCritic):
    """Advantage actor-critic on scalarised rewards, one independent learner per vehicle."""

    name = "a2c"
    Config = A2CConfig
    learner = A2CLearner
    trains_on_devices = True
