"""PPO on time-step scalarised rewards, and the clipped steps that it shares with MO-PPO.

Instead of one step along the policy gradient, every rollout serves several epochs of minibatches that ascend the
clipped surrogate (Schulman et al. 2017, eq. 7)

    E[min(rho_t A_t, clip(rho_t, 1 - epsilon, 1 + epsilon) A_t)],   rho_t = pi(a_t | S_t) / pi_old(a_t | S_t),

so that a policy can learn from a rollout more than once without moving far from the one that collected it. Critic,
inputs and advantages A_t are those of the learner that it is mixed into: of :mod:`algorithms.a2c` here.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from pydantic import Field

from algorithms.a2c import A2CConfig, A2CLearner
from algorithms.actor_critic import ActorCritic
from algorithms.common.env_adapter import EnvAdapter
from algorithms.common.rollout import VehicleRollout
from algorithms.learner import ActorCriticConfig, Learner, normalised
from mo_deepdrive.utilities import Utility


class ClippedConfig(ActorCriticConfig):
    """Hyperparameters of the clipped steps.

    Attributes:
        epochs: passes over every rollout.
        minibatches: gradient steps per pass.
        clip: epsilon, how far the probability ratio counts.
    """

    epochs: int = Field(default=4, ge=1, le=100)
    minibatches: int = Field(default=4, ge=1, le=4096)
    clip: float = Field(default=0.2, gt=0.0, lt=1.0)


class Samples(NamedTuple):
    """M samples of one vehicle.

    Attributes:
        inputs: (M, inputs) what the actor saw.
        critic_inputs: (M, ...) what the critic saw.
        actions: (M,) or (M, k).
        log_probability: (M,) of the actions under the policy that took them.
        advantages: (M,).
        targets: (M, value size) of the critic.
    """

    inputs: torch.Tensor
    critic_inputs: torch.Tensor
    actions: torch.Tensor
    log_probability: torch.Tensor
    advantages: torch.Tensor
    targets: torch.Tensor

    def at(self, chosen: torch.Tensor) -> Samples:
        """The samples at indices or where a mask is True; the masked axes become one."""
        return Samples(*(tensor[chosen] for tensor in self))


class ClippedLearner(Learner):
    """Clipped steps, to be mixed into a learner that says what is seen and predicted."""

    config: ClippedConfig

    def __init__(
        self,
        worlds: EnvAdapter,
        vehicle: int,
        utility: Utility,
        config: ClippedConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(worlds, vehicle, utility, config, generator, device)
        # Draws the minibatches.
        self._generator = torch.Generator().manual_seed(int(torch.randint(2**62, (1,), generator=generator)))

    def learn(self, rollout: VehicleRollout, entropy_weight: float) -> dict[str, float]:
        """Several epochs of clipped steps on the rollout of this vehicle."""
        samples = self._samples(rollout)
        count = len(samples.actions)
        if count == 0:
            return {}
        steps = [self._step(samples.at(chosen), entropy_weight) for chosen in self._minibatches(count)]
        return {name: float(torch.stack([step[name] for step in steps]).mean()) for name in steps[0]}

    @torch.no_grad()
    def _samples(self, rollout: VehicleRollout) -> Samples:
        """What the vehicle did itself, with the estimates of the networks as they are now."""
        inputs = self.inputs(rollout.observations, rollout.accrued, rollout.discounts)
        critic_inputs = self.critic_inputs(inputs, rollout.others)
        values = self.values(critic_inputs[:-1])
        following = self.next_values(rollout, critic_inputs, values)
        advantages, targets = self.estimates(rollout, values, following)
        if self.config.normalise_advantages:
            weight = rollout.acted.to(advantages.dtype)
            advantages = normalised(advantages, weight / weight.sum().clamp(min=1.0))
        log_probability, _ = self.actor.log_probability(inputs[:-1], rollout.actions)
        everything = Samples(inputs[:-1], critic_inputs[:-1], rollout.actions, log_probability, advantages, targets)
        return everything.at(rollout.acted)

    def _minibatches(self, count: int) -> Iterator[torch.Tensor]:
        """Indices of the minibatches of every epoch, drawn without replacement."""
        for _ in range(self.config.epochs):
            order = torch.randperm(count, generator=self._generator).to(self.device)
            yield from order.tensor_split(min(self.config.minibatches, count))

    def _step(self, samples: Samples, entropy_weight: float) -> dict[str, torch.Tensor]:
        """One gradient step; its losses, the share of samples that were clipped and the KL divergence."""
        clip = self.config.clip
        log_probability, entropies = self.actor.log_probability(samples.inputs, samples.actions)
        log_ratio = log_probability - samples.log_probability
        ratio = log_ratio.exp()
        bounded = ratio.clamp(1.0 - clip, 1.0 + clip)
        policy_loss = -torch.minimum(ratio * samples.advantages, bounded * samples.advantages).mean()
        value_loss = self.value_losses(self.values(samples.critic_inputs), samples.targets).mean()
        entropy = entropies.mean()
        self.descend(policy_loss + self.config.value_coefficient * value_loss - entropy_weight * entropy)
        with torch.no_grad():
            return {
                "loss/policy": policy_loss.detach(),
                "loss/value": value_loss.detach(),
                "policy/entropy": entropy.detach(),
                "policy/clipped": ((ratio - 1.0).abs() > clip).to(ratio.dtype).mean(),
                "policy/kl": (ratio - 1.0 - log_ratio).mean(),
            }

    def get_state(self) -> dict[str, torch.Tensor]:
        return {**super().get_state(), "generator": self._generator.get_state()}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        super().set_state(state)
        self._generator.set_state(state["generator"])


class PPOConfig(ClippedConfig, A2CConfig):
    """Hyperparameters of PPO: those of A2C and of the clipped steps."""


class PPOLearner(ClippedLearner, A2CLearner):
    """Clipped steps with a scalar critic on u(r_t)."""

    config: PPOConfig


class PPO(ActorCritic):
    """Proximal policy optimisation on time-step scalarised rewards."""

    name = "ppo"
    Config = PPOConfig
    learner = PPOLearner
