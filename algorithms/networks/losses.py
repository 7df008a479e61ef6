"""Losses as functions of tensors that autograd differentiates, and how far a step has moved a policy.

Rows are samples. Their ``weights`` (M,) need not sum to 1; None weighs all alike, and a row of weight 0 does not count.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch

from algorithms.networks.compiled import serves
from algorithms.networks.compiled.losses import ActorCriticLoss
from mo_deepdrive.evaluation.metrics import APPROX_KL, CLIP_FRACTION, ENTROPY, POLICY_LOSS, VALUE_LOSS

if TYPE_CHECKING:
    from collections.abc import Sequence

LARGEST_LOG_RATIO = 80.0  # whose exponential is finite in single precision


class Losses(NamedTuple):
    """A loss of an actor-critic and the scalars of which it consists.

    Attributes:
        total: what is minimised.
        policy, value, entropy: its parts.
        log_ratio: (M,) log rho of the samples, of PPO and its relatives.
    """

    total: torch.Tensor
    policy: torch.Tensor
    value: torch.Tensor
    entropy: torch.Tensor
    log_ratio: torch.Tensor | None = None

    def parts(self) -> dict[str, float]:
        """The parts by the names of metrics."""
        return {POLICY_LOSS: float(self.policy), VALUE_LOSS: float(self.value), ENTROPY: float(self.entropy)}


def means(losses: Sequence[Losses]) -> dict[str, float]:
    """The parts by the names of metrics, in the mean over gradient steps."""
    parts = torch.stack([torch.stack(each[1:4]) for each in losses]).detach().double().mean(0).tolist()
    return dict(zip((POLICY_LOSS, VALUE_LOSS, ENTROPY), parts, strict=True))


def mean(values: torch.Tensor, weights: torch.Tensor | None = None) -> torch.Tensor:
    """The weighted mean of ``values`` (M,); 0 if all weights are."""
    if weights is None:
        return values.mean()
    return (weights * values).sum() / weights.sum().clamp(min=torch.finfo(weights.dtype).tiny)


def squared_error(outputs: torch.Tensor, targets: torch.Tensor, weights: torch.Tensor | None = None) -> torch.Tensor:
    """The weighted mean over the rows of the mean (y - v)^2 of outputs v and targets y, both (M, K)."""
    return mean((outputs - targets).square().mean(-1), weights)


class OldSamples(Protocol):
    """What the losses take of :class:`algorithms.rollouts.buffers.Samples`, each (M,) or (M, K)."""

    @property
    def log_prob(self) -> torch.Tensor | None:
        """Log pi_old, for :func:`proximal_loss`."""

    @property
    def advantages(self) -> torch.Tensor:
        """A."""

    @property
    def targets(self) -> torch.Tensor:
        """Y."""

    @property
    def weights(self) -> torch.Tensor | None:
        """1 for samples that count, else 0."""


class LossSettings(Protocol):
    """The hyperparameter of :func:`policy_gradient_loss`: c_v."""

    value_coefficient: float


class ProximalSettings(LossSettings, Protocol):
    """The hyperparameters of :func:`proximal_loss`: epsilon and c_v."""

    clip: float


def policy_gradient_loss(
    log_prob: torch.Tensor,
    entropies: torch.Tensor,
    outputs: torch.Tensor,
    samples: OldSamples,
    config: LossSettings,
    entropy_coefficient: float | torch.Tensor,
) -> Losses:
    """The loss of A2C and its relatives (Mnih et al. 2016).

        L = -E[A log pi] + c_v E[|y - v|^2 / K] - c_e E[H(pi)]

    Args:
        log_prob: (M,) log pi of the actions.
        entropies: (M,) H(pi).
        outputs: (M, K) v.
        samples: A, y and weights.
        config: c_v.
        entropy_coefficient: c_e.
    """
    weights = samples.weights
    if serves(log_prob):
        given, coefficients = (None, samples.advantages, samples.targets), (0.0, config.value_coefficient)
        found = ActorCriticLoss.apply(  # type: ignore[no-untyped-call]
            log_prob, entropies, outputs, given, (weights, weights), (*coefficients, float(entropy_coefficient))
        )
        return Losses(*found[:4])
    policy_loss = -mean(samples.advantages * log_prob, weights)
    value_loss = squared_error(outputs, samples.targets, weights)
    entropy = mean(entropies, weights)
    total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
    return Losses(total, policy_loss, value_loss, entropy)


def proximal_loss(
    log_prob: torch.Tensor,
    entropies: torch.Tensor,
    outputs: torch.Tensor,
    samples: OldSamples,
    config: ProximalSettings,
    entropy_coefficient: float | torch.Tensor,
    *,
    critic_learns_from_all: bool = False,
) -> Losses:
    """The loss of PPO and its relatives (Schulman et al. 2017, eqs. 7 and 9).

    With rho = pi / pi_old,

        L = -E[min(rho A, clip(rho, 1 - epsilon, 1 + epsilon) A)] + c_v E[|y - v|^2 / K] - c_e E[H(pi)]

    Args:
        log_prob: (M,) log pi of the actions.
        entropies: (M,) H(pi).
        outputs: (M, K) v.
        samples: log pi_old, A, y and weights.
        config: epsilon and c_v.
        entropy_coefficient: c_e.
        critic_learns_from_all: whether samples of weight 0 count in the second term.
    """
    weights = samples.weights, None if critic_learns_from_all else samples.weights
    assert samples.log_prob is not None
    old = samples.log_prob, samples.advantages, samples.targets
    if serves(log_prob):
        coefficients = config.clip, config.value_coefficient, float(entropy_coefficient)
        found = ActorCriticLoss.apply(log_prob, entropies, outputs, old, weights, coefficients)  # type: ignore[no-untyped-call]
        return Losses(*found)
    log_ratio = log_prob - samples.log_prob
    ratio, advantages = log_ratio.exp(), samples.advantages
    clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -mean(torch.minimum(ratio * advantages, clipped * advantages), weights[0])
    value_loss = squared_error(outputs, samples.targets, weights[1])
    entropy = mean(entropies, weights[0])
    total = policy_loss + config.value_coefficient * value_loss - entropy_coefficient * entropy
    return Losses(total, policy_loss, value_loss, entropy, log_ratio)


def policy_shift(
    log_ratio: torch.Tensor, clip: float, weights: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """The fraction of clipped samples, and E[rho - 1 - log rho], an estimate of KL(pi_old || pi), in a gradient step.

    Args:
        log_ratio: (M,) log rho of samples of pi_old.
        clip: epsilon.
        weights: of the samples.
    """
    ratio = log_ratio.clamp(max=LARGEST_LOG_RATIO).exp()
    clipped = ((ratio - 1.0).abs() > clip).to(ratio.dtype)
    return mean(clipped, weights), mean(ratio - 1.0 - log_ratio, weights)


def policy_change(losses: Sequence[Losses], clip: float) -> dict[str, float]:
    """:func:`policy_shift` over the samples of several gradient steps, by the names of metrics."""
    log_ratio = torch.cat([each.log_ratio.detach() for each in losses if each.log_ratio is not None])
    clipped, divergence = policy_shift(log_ratio, clip)
    return {CLIP_FRACTION: float(clipped), APPROX_KL: float(divergence)}
