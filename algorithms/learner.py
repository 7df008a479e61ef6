"""One vehicle's learner: settings, networks, optimiser and the losses that all actor-critics share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator

from algorithms.common.checkpoints import below
from algorithms.common.env_adapter import EnvAdapter
from algorithms.common.networks import CategoricalActor, GaussianActor, mlp
from algorithms.common.optimisers import linear, optimiser_state, set_optimiser_state
from algorithms.common.rollout import Rollout, VehicleRollout
from mo_deepdrive.config import Settings
from mo_deepdrive.utilities import Utility


class ActorCriticConfig(Settings):
    """Hyperparameters that all actor-critics share.

    Attributes:
        learning_rate, learning_rate_end: Adam's step size, moving linearly from one to the other (None: constant).
        gamma: discount.
        gae_lambda: decay of the advantage estimator; 0 is one step, 1 the whole rollout.
        steps: decisions per world and update.
        hidden: sizes of the hidden layers of actor and critic.
        entropy_start, entropy_end, entropy_until: weight of the entropy bonus, moving geometrically from the first
            to the second over this fraction of training.
        value_coefficient: weight of the critic's loss.
        max_grad_norm: clipping of the gradient's norm.
        normalise_advantages: bring the advantages of an update to mean 0 and deviation 1.
        objective_scales: nominal size of each objective's return; None for the environment's own.
        centralised_critic: the critic also sees what the other vehicles observe; the actor does not.
    """

    learning_rate: float = Field(default=1e-3, gt=0.0, le=1.0)
    learning_rate_end: float | None = Field(default=None, ge=0.0, le=1.0)
    gamma: float = Field(default=0.99, ge=0.0, le=1.0)
    gae_lambda: float = Field(default=0.95, ge=0.0, le=1.0)
    steps: int = Field(default=16, ge=1, le=4096)
    hidden: list[int] = Field(default=[64, 32], min_length=1)
    entropy_start: float = Field(default=0.01, ge=0.0)
    entropy_end: float = Field(default=0.01, ge=0.0)
    entropy_until: float = Field(default=1.0, gt=0.0, le=1.0)
    value_coefficient: float = Field(default=0.5, gt=0.0)
    max_grad_norm: float = Field(default=0.5, gt=0.0)
    normalise_advantages: bool = True
    objective_scales: list[float] | None = None
    centralised_critic: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> ActorCriticConfig:
        if any(size < 1 for size in self.hidden):
            raise ValueError(f"hidden = {self.hidden} must be positive layer sizes")
        if (self.entropy_start == 0.0) != (self.entropy_end == 0.0):
            raise ValueError(
                f"entropy_start = {self.entropy_start} and entropy_end = {self.entropy_end} must both be positive "
                "or both be 0: the weight moves geometrically between them"
            )
        if self.objective_scales is not None and any(scale <= 0.0 for scale in self.objective_scales):
            raise ValueError(f"objective_scales = {self.objective_scales} must be positive")
        return self

    @property
    def accrual(self) -> float:
        """Discount of the accrued reward."""
        return self.gamma

    def entropy_at(self, progress: float) -> float:
        """Weight of the entropy bonus at ``progress`` in [0, 1]."""
        if self.entropy_start == 0.0:
            return 0.0
        part = min(1.0, progress / self.entropy_until)
        return self.entropy_start * (self.entropy_end / self.entropy_start) ** part

    def learning_rate_at(self, progress: float) -> float:
        """Adam's step size at ``progress`` in [0, 1]."""
        return linear(self.learning_rate, self.learning_rate_end, progress)


def normalised(advantages: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """``advantages`` with mean 0 and deviation 1 under ``weight``, which sums to 1; both of one shape."""
    mean = (weight * advantages).sum()
    deviation = (weight * (advantages - mean).square()).sum().sqrt()
    return (advantages - mean) / (deviation + 1e-8)


class Learner(ABC):
    """Networks and optimiser of one vehicle.

    Subclasses say what the networks see and predict, and how a rollout changes them.

    Args:
        worlds: where the vehicle drives.
        vehicle: which one it is.
        utility: what it maximises.
        config: hyperparameters.
        generator: draws the initial weights.
        device: where the networks live.

    Raises:
        ValueError: for hyperparameters that do not fit the worlds.
    """

    def __init__(
        self,
        worlds: EnvAdapter,
        vehicle: int,
        utility: Utility,
        config: Any,
        generator: torch.Generator,
        device: torch.device,
    ):
        self.vehicle = vehicle
        self.utility = utility
        self.config = config
        self.device = device
        scales = worlds.objective_scales if config.objective_scales is None else config.objective_scales
        if len(scales) != len(worlds.objectives):
            raise ValueError(
                f"objective_scales = {list(scales)} needs {len(worlds.objectives)} numbers: {worlds.objectives}"
            )
        self.observation_scales = torch.tensor(worlds.observation_scales, device=device)
        self.objective_scales = torch.tensor(np.asarray(scales, dtype=np.float32), device=device)
        if config.centralised_critic and worlds.vehicles == 1:
            raise ValueError("centralised_critic = True needs an environment with more than one vehicle")
        inputs = self.input_size(worlds)
        others = (worlds.vehicles - 1) * worlds.observation_size if config.centralised_critic else 0
        kind = GaussianActor if worlds.continuous else CategoricalActor
        self.actor = kind(inputs, config.hidden, worlds.actions, generator).to(device)
        outputs = self.value_size(worlds)
        self.critic = mlp(inputs + others, config.hidden, outputs, generator, output_gain=1.0).to(device)
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimiser = torch.optim.Adam(self.parameters, lr=config.learning_rate, fused=True)

    @abstractmethod
    def input_size(self, worlds: EnvAdapter) -> int:
        """Width of what the networks see."""

    @abstractmethod
    def value_size(self, worlds: EnvAdapter) -> int:
        """Width of what the critic predicts."""

    @abstractmethod
    def inputs(self, observations: torch.Tensor, accrued: torch.Tensor, discounts: torch.Tensor) -> torch.Tensor:
        """What the actor sees, (..., inputs), from (..., o), (..., d) and (...)."""

    def critic_inputs(self, inputs: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """What the critic sees: ``inputs`` (..., inputs), and of the others (..., (V - 1) * o) if it is centralised."""
        if not self.config.centralised_critic:
            return inputs
        scaled = others.unflatten(-1, (-1, len(self.observation_scales))) / self.observation_scales
        return torch.cat([inputs, scaled.flatten(-2)], dim=-1)

    @abstractmethod
    def values(self, critic_inputs: torch.Tensor) -> torch.Tensor:
        """v (..., value size) in the units of the returns."""

    @abstractmethod
    def estimates(
        self, rollout: VehicleRollout, values: torch.Tensor, following: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Scalar advantages (T, N) and the critic's targets (T, N, value size), without gradient.

        Args:
            rollout: of this vehicle.
            values: (T, N, value size) v(S_t).
            following: (T, N, value size) v(S_{t+1}), 0 after termination.
        """

    @abstractmethod
    def value_losses(self, values: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        """Squared errors (...) of ``values`` (..., value size) in the critic's own units."""

    def finished(self, discounted_returns: NDArray[np.float64]) -> None:
        """Take note of the discounted returns (E, d) of episodes that ended; most learners need none."""
        return

    def update(self, rollout: Rollout, learning_rate: float, entropy_weight: float) -> dict[str, float]:
        """Learn from the rollout of all vehicles; the losses by name."""
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate
        return self.learn(rollout.of_vehicle(self.vehicle, self.device), entropy_weight)

    def learn(self, rollout: VehicleRollout, entropy_weight: float) -> dict[str, float]:
        """Learn from the rollout of this vehicle, by one gradient step; the losses by name."""
        losses = self.losses(rollout, entropy_weight)
        self.descend(losses["total"])
        return {name: float(loss.detach()) for name, loss in losses.items() if name != "total"}

    def losses(self, rollout: VehicleRollout, entropy_weight: float) -> dict[str, torch.Tensor]:
        """The loss to descend as "total", and its parts: policy gradient, critic and entropy.

        Samples in which the vehicle did not act do not count.
        """
        inputs = self.inputs(rollout.observations, rollout.accrued, rollout.discounts)
        critic_inputs = self.critic_inputs(inputs, rollout.others)
        values = self.values(critic_inputs[:-1])
        following = self.next_values(rollout, critic_inputs, values)
        advantages, targets = self.estimates(rollout, values.detach(), following)
        weight = rollout.acted.to(advantages.dtype)
        weight = weight / weight.sum().clamp(min=1.0)
        if self.config.normalise_advantages:
            advantages = normalised(advantages, weight)
        log_probability, entropies = self.actor.log_probability(inputs[:-1], rollout.actions)
        policy_loss = -(weight * advantages * log_probability).sum()
        value_loss = (weight * self.value_losses(values, targets)).sum()
        entropy = (weight * entropies).sum()
        total = policy_loss + self.config.value_coefficient * value_loss - entropy_weight * entropy
        return {"total": total, "loss/policy": policy_loss, "loss/value": value_loss, "policy/entropy": entropy}

    def descend(self, loss: torch.Tensor) -> None:
        """One step of the optimiser, with the gradient's norm clipped."""
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        self.optimiser.step()

    def next_values(self, rollout: VehicleRollout, critic_inputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """v(S_{t+1}) (T, N, ...) without gradient: 0 after termination, of the true final state after truncation.

        Args:
            rollout: of this vehicle.
            critic_inputs: (T + 1, N, ...) what the critic saw.
            values: (T, N, value size) v(S_t).
        """
        with torch.no_grad():
            following = torch.cat([values[1:].detach(), self.values(critic_inputs[-1:])])
            following[rollout.terminated] = 0.0
            cut = rollout.truncated & ~rollout.terminated
            if cut.any():
                factors = rollout.discounts[:-1][cut]
                accrued = rollout.accrued[:-1][cut] + factors.unsqueeze(-1) * rollout.rewards[cut]
                final = self.inputs(rollout.final[cut], accrued, factors * self.config.accrual)
                following[cut] = self.values(self.critic_inputs(final, rollout.final_others[cut]))
        return following

    def get_state(self) -> dict[str, torch.Tensor]:
        """Weights and the optimiser's state as named tensors."""
        state = self.get_policy()
        state |= {f"critic.{name}": tensor for name, tensor in self.critic.state_dict().items()}
        state |= {f"optimiser.{name}": tensor for name, tensor in optimiser_state(self.optimiser).items()}
        return state

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        self.set_policy(state)
        self.critic.load_state_dict(below(state, "critic."))
        set_optimiser_state(self.optimiser, below(state, "optimiser."))

    def get_policy(self) -> dict[str, torch.Tensor]:
        """The actor's weights as named tensors."""
        return {f"actor.{name}": tensor for name, tensor in self.actor.state_dict().items()}

    def set_policy(self, state: dict[str, torch.Tensor]) -> None:
        """Act as the learner of :meth:`get_policy` or :meth:`get_state` does."""
        self.actor.load_state_dict(below(state, "actor."))
