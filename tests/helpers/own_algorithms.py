"""Algorithms, a network and a utility of a user: changed formulas, and what cannot be learnt from."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from algorithms import MOPPO, PCN
from algorithms.learning.losses import Loss


class Stubborn(MOPPO):
    """Its loss keeps the policy where it was, too."""

    class Config(MOPPO.Config):
        stay: float = 10.0
        """Weight of what keeps it."""

    def loss(self, networks: Any, samples: Any, entropy_coefficient: torch.Tensor) -> Loss:
        total, parts = super().loss(networks, samples, entropy_coefficient)
        log_prob, _ = networks.actor(samples.inputs, samples.actions)
        moved = (log_prob - samples.log_prob).square().mean()
        return Loss(total + self.config.stay * moved, {**parts, "loss/stay": moved})


class Squared(MOPPO):
    """Its advantages are squares."""

    def advantages(self, rollout: Any, values: Any, next_values: Any) -> tuple[torch.Tensor, torch.Tensor]:
        advantages, targets = super().advantages(rollout, values, next_values)
        return advantages * advantages.abs(), targets


class LossInPlace(MOPPO):
    """Its loss changes its samples."""

    def loss(self, networks: Any, samples: Any, entropy_coefficient: torch.Tensor) -> Loss:
        samples.advantages.mul_(2.0)
        return super().loss(networks, samples, entropy_coefficient)


class AdvantagesInPlace(MOPPO):
    """Its advantages change the rollout."""

    def advantages(self, rollout: Any, values: Any, next_values: Any) -> tuple[torch.Tensor, torch.Tensor]:
        rollout.rewards.add_(1.0)
        return super().advantages(rollout, values, next_values)


class Deciding(MOPPO):
    """Its loss decides by the values of its samples how it is calculated."""

    def loss(self, networks: Any, samples: Any, entropy_coefficient: torch.Tensor) -> Loss:
        total, parts = super().loss(networks, samples, entropy_coefficient)
        return Loss(2.0 * total if samples.advantages.sum() > 0.0 else total, parts)


class CommandsInPlace(PCN):
    """Its loss changes its commands."""

    def loss(self, networks: Any, samples: Any) -> Loss:
        samples["commands"].mul_(2.0)
        return super().loss(networks, samples)


class DecidingNetwork(nn.Linear):
    """Decides by the values of its inputs what its outputs are."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        outputs: torch.Tensor = super().forward(x)
        return 2.0 * outputs if x.sum() > 0.0 else outputs


def deciding_network(inputs: int, outputs: int, _: torch.Generator) -> nn.Module:
    """A network that seeds side by side cannot share."""
    return DecidingNetwork(inputs, outputs)


def deciding_utility(returns: Any) -> Any:
    """Decides by the values of its returns how it is calculated."""
    return returns.sum(-1) if (returns >= 0.0).all() else returns[..., 0]
