"""MO-A2C: advantage actor-critic with a vector critic on the accrued-reward-augmented state, for a known utility.

State S_t = (s_t, R_t) with the accrued reward R_t = sum_{i<t} gamma^i r_i. The critic predicts one value per
objective, v(S_t), with targets r_t + gamma v(S_{t+1}) (lambda-returns per objective). The actor follows one of three
advantages (paper, section 4.2; Reymond et al. 2023; Hayes et al. 2022):

- ``utility_difference``: sums, decaying by lambda, of
  U_t = u(R_{t+1} + gamma^{t+1} v(S_{t+1})) - u(R_t + gamma^t v(S_t));
- ``as_printed``: the same without gamma^{t+1}, as the paper prints eq. 4.2;
- ``utility_gradient``: the advantages per objective weighted with the gradient of u at the expected return, which is
  the policy gradient of u(E[R]) (SER).

With ``accrued_gamma`` g the past counts in full or nearly so: R_t = sum_{i<t} g^i r_i, and a difference is taken at

    U_t = u(R_t + g^t (r_t + gamma v(S_{t+1}))) - u(R_t + g^t v(S_t)),

whose sums decay by lambda gamma / g. At g = 1 a linear utility gives the advantage of A2C at every step, where
g = gamma gives gamma^t times that: a decision late in a long episode hardly counts then, and a product of two
discounted returns is discounted twice.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from algorithms.actor_critic import ActorCritic
from algorithms.common.advantages import AdvantageForm, discounted_sum, utility_differences, utility_gradient
from algorithms.common.env_adapter import EnvAdapter
from algorithms.common.rollout import VehicleRollout
from algorithms.learner import ActorCriticConfig, Learner
from mo_deepdrive.utilities import Utility

# Weight of the past when an episode's return enters the running mean that utility_gradient needs.
RETURN_MEMORY = 0.99


class MOA2CConfig(ActorCriticConfig):
    """Hyperparameters of MO-A2C.

    Attributes:
        advantage: "utility_difference", "as_printed" or "utility_gradient".
        accrued_gamma: discount g of the accrued reward; None for gamma, as in the paper.
        observe_accrued: append the accrued reward to the state, as theory asks for; without it the policy is as blind
            to the past as the baseline's.
        observe_discount: append gamma^t to the augmented state, on which the consistent advantage depends too.
    """

    advantage: AdvantageForm = "utility_difference"
    accrued_gamma: float | None = Field(default=None, gt=0.0, le=1.0)
    observe_accrued: bool = True
    observe_discount: bool = True

    @property
    def accrual(self) -> float:
        return self.gamma if self.accrued_gamma is None else self.accrued_gamma


class MOA2CLearner(Learner):
    """Vector critic on the augmented state."""

    config: MOA2CConfig

    def __init__(
        self,
        worlds: EnvAdapter,
        vehicle: int,
        utility: Utility,
        config: MOA2CConfig,
        generator: torch.Generator,
        device: torch.device,
    ):
        super().__init__(worlds, vehicle, utility, config, generator, device)
        # Running mean (d,) of the discounted returns of finished episodes, and how many there were.
        self._expected_return = torch.zeros(len(worlds.objectives), device=device)
        self._episodes = 0

    def input_size(self, worlds: EnvAdapter) -> int:
        accrued = len(worlds.objectives) if self.config.observe_accrued else 0
        return worlds.observation_size + accrued + self.config.observe_discount

    def value_size(self, worlds: EnvAdapter) -> int:
        return len(worlds.objectives)

    def inputs(self, observations: torch.Tensor, accrued: torch.Tensor, discounts: torch.Tensor) -> torch.Tensor:
        parts = [observations / self.observation_scales]
        if self.config.observe_accrued:
            parts.append(accrued / self.objective_scales)
        if self.config.observe_discount:
            parts.append(discounts.unsqueeze(-1))
        return torch.cat(parts, dim=-1)

    def values(self, critic_inputs: torch.Tensor) -> torch.Tensor:
        return self.objective_scales * self.critic(critic_inputs)

    def estimates(
        self, rollout: VehicleRollout, values: torch.Tensor, following: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        gamma, decay = self.config.gamma, self.config.gae_lambda
        going_on = (~(rollout.terminated | rollout.truncated)).to(values.dtype)
        deltas = rollout.rewards + gamma * following - values
        vector_advantages = discounted_sum(deltas, going_on.unsqueeze(-1), gamma * decay)
        targets = vector_advantages + values
        if self.config.advantage == "utility_gradient":
            return vector_advantages @ utility_gradient(self.utility, self._expected_return), targets
        differences = utility_differences(
            self.utility,
            rollout.accrued[:-1],
            rollout.rewards,
            rollout.discounts[:-1],
            values,
            following,
            gamma,
            as_printed=self.config.advantage == "as_printed",
        )
        if self.config.accrued_gamma is not None:
            decay *= gamma / self.config.accrued_gamma
        return discounted_sum(differences, going_on, decay), targets

    def value_losses(self, values: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        return ((targets - values) / self.objective_scales).square().mean(-1)

    def finished(self, discounted_returns: NDArray[np.float64]) -> None:
        if not len(discounted_returns):
            return
        mean = torch.tensor(discounted_returns.mean(axis=0), dtype=torch.float32, device=self.device)
        keep = RETURN_MEMORY ** len(discounted_returns) if self._episodes else 0.0
        self._expected_return = keep * self._expected_return + (1.0 - keep) * mean
        self._episodes += len(discounted_returns)

    def get_state(self) -> dict[str, torch.Tensor]:
        own = {"expected_return": self._expected_return, "episodes": torch.tensor(self._episodes)}
        return {**super().get_state(), **own}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        super().set_state(state)
        self._expected_return = state["expected_return"].to(self.device)
        self._episodes = int(state["episodes"])


class MOA2C(ActorCritic):
    """Multi-objective advantage actor-critic for a known utility."""

    name = "mo_a2c"
    Config = MOA2CConfig
    learner = MOA2CLearner
