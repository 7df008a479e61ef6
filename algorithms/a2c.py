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
from algorithms.networks.losses import Loss, squared_error, weighted_sum
from algorithms.networks.modules import centralised_inputs, make_network
from algorithms.networks.optimiser import Adam
from algorithms.rollouts.advantages import generalised_advantages, normalise
from mo_deepdrive.evaluation.metrics import ENTROPY, POLICY_LOSS, VALUE_LOSS

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
    """A2C for one vehicle; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: A2CConfig

    def __init__(
        self,
        env: EnvAdapter,
        vehicle: int,
        utility: Utility,
        config: A2CConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(env, vehicle, utility, config, generator, device)
        self.input_size = env.observation_size
        self.actor = make_actor(config, self.input_size, env.actions, generator, continuous=env.continuous).to(device)
        self.critic = make_network(config, self.input_size + self.others_size, 1, generator).to(device)
        self.optimiser = Adam([*self.actor.parameters(), *self.critic.parameters()])

    # ------------------------------------------------------------------------------------------- what the networks see

    def critic_inputs(self, inputs: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """What the critic sees: ``inputs``, and with a centralised critic the other vehicles' observations."""
        return centralised_inputs(inputs, others, self.observation_scales) if self.others_size else inputs

    def values(self, critic_inputs: torch.Tensor) -> torch.Tensor:
        """v(s) (...), in the units of the return."""
        outputs: torch.Tensor = self.critic(critic_inputs)
        return self.config.value_scale * outputs.squeeze(-1)

    # ------------------------------------------------------------------------------------------------------ the update

    def update(self, rollout: VehicleRollout, learning_rate: float, entropy_coefficient: float) -> dict[str, float]:
        """One gradient step of eq. 4 on a rollout of T steps in N environments; the losses by name."""
        if not rollout.acted.any():
            return {}
        with self.optimiser.recording():
            losses = self.losses(rollout, entropy_coefficient)
        total = losses.pop("total")
        self.optimiser.minimise(total, learning_rate, self.config.max_grad_norm, losses)
        return {name: float(loss) for name, loss in losses.items()}

    def losses(self, rollout: VehicleRollout, entropy_coefficient: float) -> dict[str, Loss]:
        """L of eq. 4 as "total", and its parts, over the samples in which the vehicle acted."""
        config = self.config
        inputs = self.inputs(rollout.observations, rollout.accrued, rollout.discounts)
        critic_inputs = self.critic_inputs(inputs, rollout.others)
        outputs: torch.Tensor = self.critic(critic_inputs[:-1].flatten(0, 1))  # v(s_t) / scale
        values = config.value_scale * outputs.detach().view(rollout.acted.shape)
        next_values = self.next_values(rollout, critic_inputs, values)
        advantages, targets = self.advantages(rollout, values, next_values)

        weights = rollout.acted.to(advantages.dtype)
        weights = weights / weights.sum().clamp(min=1.0)
        if config.normalise_advantages:
            advantages = normalise(advantages, weights)

        log_prob, entropies = self.actor.log_prob_and_entropy(inputs[:-1].flatten(0, 1), rollout.actions.flatten(0, 1))
        weights, advantages, targets = (each.flatten(0, 1) for each in (weights, advantages, targets))
        policy_loss = -weighted_sum(weights * advantages, log_prob)
        value_loss = squared_error(outputs, (targets / config.value_scale).unsqueeze(-1), weights)
        entropy = weighted_sum(weights, entropies)
        total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
        return {POLICY_LOSS: policy_loss, VALUE_LOSS: value_loss, ENTROPY: entropy, "total": total}

    @torch.no_grad()
    def next_values(self, rollout: VehicleRollout, critic_inputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """v(s_{t+1}) (T, N): 0 after termination, the value of the true final state after truncation.

        Args:
            rollout: T steps of this vehicle.
            critic_inputs: (T + 1, N, ...) of s_0 to s_T.
            values: (T, N) v(s_t).
        """
        next_values = torch.cat([values[1:], self.values(critic_inputs[-1:])])
        next_values[rollout.terminated] = 0.0
        truncated = rollout.truncated & ~rollout.terminated
        if truncated.any():
            final = self.inputs(*rollout.final_states(truncated, self.config.gamma))
            next_values[truncated] = self.values(self.critic_inputs(final, rollout.final_others[truncated]))
        return next_values

    def advantages(
        self, rollout: VehicleRollout, values: torch.Tensor, next_values: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """A_t and y_t of eqs. 1 to 3, each (T, N), from v(s_t) and v(s_{t+1}), each (T, N)."""
        gamma = self.config.gamma
        not_done = (~(rollout.terminated | rollout.truncated)).to(values.dtype)
        deltas = self.utility(rollout.rewards) + gamma * next_values - values
        advantages = generalised_advantages(deltas, not_done, gamma * self.config.gae_lambda)
        return advantages, advantages + values


class A2C(ActorCritic):
    """Advantage actor-critic on scalarised rewards, one independent learner per vehicle."""

    name = "a2c"
    Config = A2CConfig
    learner = A2CLearner
