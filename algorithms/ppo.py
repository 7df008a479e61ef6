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

from statistics import fmean
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
from algorithms.networks.losses import clipped_surrogate, mean, policy_change, squared_error
from algorithms.networks.modules import centralised_inputs, make_network
from algorithms.networks.optimiser import Adam
from algorithms.rollouts.advantages import generalised_advantages, normalise
from algorithms.rollouts.buffers import Samples
from mo_deepdrive.evaluation.metrics import APPROX_KL, CLIP_FRACTION, ENTROPY, POLICY_LOSS, VALUE_LOSS

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
    """PPO for one vehicle; the arguments are those of :class:`algorithms.actor_critic.Learner`."""

    config: PPOConfig
    shuffle: torch.Generator

    def __init__(
        self,
        env: EnvAdapter,
        vehicle: int,
        utility: Utility,
        config: PPOConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(env, vehicle, utility, config, generator, device)
        self.input_size = env.observation_size
        self.actor = make_actor(config, self.input_size, env.actions, generator, continuous=env.continuous).to(device)
        self.critic = make_network(config, self.input_size + self.others_size, 1, generator).to(device)
        self.optimiser = Adam([*self.actor.parameters(), *self.critic.parameters()])
        # Shuffles the minibatches.
        self.shuffle = torch.Generator().manual_seed(int(torch.randint(2**62, (1,), generator=generator)))

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
        """Epochs of minibatch steps of eq. 4 on a rollout of T steps in N environments; mean losses by name."""
        samples = self.samples(rollout)
        if len(samples.actions) == 0:
            return {}
        losses, log_ratios = zip(
            *(
                self.gradient_step(minibatch, learning_rate, entropy_coefficient)
                for _ in range(self.config.epochs)
                for minibatch in samples.shuffled(self.shuffle).split(self.config.minibatches)
            ),
            strict=True,
        )
        means = {name: fmean(each[name] for each in losses) for name in losses[0]}
        means[CLIP_FRACTION], means[APPROX_KL] = policy_change(torch.cat(log_ratios), self.config.clip)
        return means

    @torch.no_grad()
    def samples(self, rollout: VehicleRollout) -> Samples:
        """The samples in which the vehicle acted, with A_t, y_t and log pi_old of the networks as they are now."""
        inputs = self.inputs(rollout.observations, rollout.accrued, rollout.discounts)
        critic_inputs = self.critic_inputs(inputs, rollout.others)
        values = self.values(critic_inputs[:-1])
        next_values = self.next_values(rollout, critic_inputs, values)
        advantages, targets = self.advantages(rollout, values, next_values)
        if self.config.normalise_advantages:
            weights = rollout.acted.to(advantages.dtype)
            advantages = normalise(advantages, weights / weights.sum().clamp(min=1.0))
        log_prob, _ = self.actor.log_prob_and_entropy(inputs[:-1], rollout.actions)
        all_samples = Samples(inputs[:-1], critic_inputs[:-1], rollout.actions, log_prob, advantages, targets)
        return all_samples.at(rollout.acted)

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
        """A_t and y_t of eqs. 1 and 2, each (T, N), from v(s_t) and v(s_{t+1}), each (T, N)."""
        gamma = self.config.gamma
        not_done = (~(rollout.terminated | rollout.truncated)).to(values.dtype)
        deltas = self.utility(rollout.rewards) + gamma * next_values - values
        advantages = generalised_advantages(deltas, not_done, gamma * self.config.gae_lambda)
        return advantages, advantages + values

    def gradient_step(
        self, samples: Samples, learning_rate: float, entropy_coefficient: float
    ) -> tuple[dict[str, float], torch.Tensor]:
        """One gradient step of eq. 4; its losses, and log rho of the samples before it."""
        config = self.config
        with self.optimiser.recording():
            log_prob, entropies = self.actor.log_prob_and_entropy(samples.inputs, samples.actions)
            values = self.critic(samples.critic_inputs)
        policy_loss = -clipped_surrogate(log_prob, samples.log_prob, samples.advantages, config.clip)
        value_loss = squared_error(values, (samples.targets / config.value_scale).unsqueeze(-1))
        entropy = mean(entropies)
        loss = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
        losses = {POLICY_LOSS: float(policy_loss), VALUE_LOSS: float(value_loss), ENTROPY: float(entropy)}
        self.optimiser.minimise(loss, learning_rate, config.max_grad_norm, losses)
        return losses, log_prob.detach() - samples.log_prob


class PPO(ActorCritic):
    """Proximal policy optimisation on scalarised rewards, one independent learner per vehicle."""

    name = "ppo"
    Config = PPOConfig
    learner = PPOLearner
