"""The losses of actor-critics, compiled: one call instead of some thirty operations of torch."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mo_deepdrive.simulation.jit import jit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float32]

NONE = np.zeros(0, np.float32)  # weights where all are alike, log pi_old where there is none
SMALLEST = float(np.finfo(np.float32).tiny)  # sum of weights that is divided by


@jit
def _share(weights: Array, count: int) -> float:
    """What a weight of 1 is in a mean over ``count`` samples."""
    total = 0.0
    for i in range(len(weights)):
        total += weights[i]
    return 1.0 / max(total, SMALLEST) if len(weights) else 1.0 / count


@jit
def _loss(
    log_prob: Array,
    entropies: Array,
    outputs: Array,
    old_log_prob: Array,
    advantages: Array,
    targets: Array,
    weights: Array,
    value_weights: Array,
    clip: float,
    value_coefficient: float,
    entropy_coefficient: float,
    parts: Array,
    log_ratios: Array,
    by_log_prob: Array,
    by_entropies: Array,
    by_outputs: Array,
) -> None:
    """Write the parts of the loss (4,), log rho (M,) and the gradients of the total.

    Args:
        log_prob: (M,); so are the next and those before ``targets``.
        entropies: of the policy.
        outputs: (K, M) of the critic.
        old_log_prob: under pi_old, for the loss of PPO; (0,) for that of A2C.
        advantages: A.
        targets: (M, K) of the outputs.
        weights: (M,); (0,) for equal ones.
        value_weights: the same for the critic.
        clip: epsilon.
        value_coefficient: c_v.
        entropy_coefficient: c_e.
        parts: total, policy loss, value loss and entropy.
        log_ratios: log rho.
        by_log_prob: (M,).
        by_entropies: (M,).
        by_outputs: (K, M).
    """
    policy, value, entropy, outs, count = 0.0, 0.0, 0.0, len(outputs), len(log_prob)
    share, value_share = _share(weights, count), _share(value_weights, count)
    for i in range(count):
        weight = share * weights[i] if len(weights) else share
        advantage = np.float64(advantages[i])
        if len(old_log_prob) == 0:
            by_log_prob[i] = -weight * advantage
            policy -= weight * advantage * log_prob[i]
        else:
            log_ratios[i] = log_prob[i] - old_log_prob[i]
            # In double precision, or a surrogate that is not clipped could be rounded above itself.
            ratio = math.exp(np.float64(log_prob[i]) - np.float64(old_log_prob[i]))
            surrogate, clipped = ratio * advantage, min(max(ratio, 1.0 - clip), 1.0 + clip) * advantage
            by_log_prob[i] = -weight * surrogate if surrogate <= clipped else 0.0
            policy -= weight * min(surrogate, clipped)
        by_entropies[i] = -entropy_coefficient * weight
        entropy += weight * entropies[i]
    scale = 2.0 * value_coefficient / outs
    for k in range(outs):
        for i in range(count):
            weight = value_share * value_weights[i] if len(value_weights) else value_share
            error = np.float64(outputs[k, i]) - np.float64(targets[i, k])
            by_outputs[k, i] = scale * weight * error
            value += weight * error * error / outs
    parts[0] = policy + value_coefficient * value - entropy_coefficient * entropy
    parts[1], parts[2], parts[3] = policy, value, entropy


class ActorCriticLoss(torch.autograd.Function):
    """:func:`algorithms.networks.losses.proximal_loss`, or without log pi_old ``policy_gradient_loss``.

    The total alone is differentiable.
    """

    @staticmethod
    def forward(
        ctx: Any,
        log_prob: torch.Tensor,
        entropies: torch.Tensor,
        outputs: torch.Tensor,
        samples: tuple[torch.Tensor | None, torch.Tensor, torch.Tensor],
        weights: tuple[torch.Tensor | None, torch.Tensor | None],
        coefficients: tuple[float, float, float],
    ) -> tuple[torch.Tensor, ...]:
        """Total, policy loss, value loss, entropy and log rho."""
        z = outputs.t().contiguous().numpy()
        parts, log_ratios, by_log_prob, by_entropies = (
            np.empty(4, np.float32),
            *np.empty((3, len(log_prob)), np.float32),
        )
        by_outputs = np.empty_like(z)
        old, a, y, w, value_w = [NONE if each is None else each.numpy() for each in (*samples, *weights)]
        _loss(
            log_prob.numpy(), entropies.numpy(), z, old, a, y, w, value_w, *coefficients,
            parts, log_ratios, by_log_prob, by_entropies, by_outputs,
        )  # fmt: skip
        ctx.gradients = by_log_prob, by_entropies, by_outputs.T
        found = *torch.from_numpy(parts), torch.from_numpy(log_ratios)
        ctx.mark_non_differentiable(*found[1:])
        ctx.set_materialize_grads(False)
        return found

    @staticmethod
    def backward(ctx: Any, by_total: torch.Tensor, *_: torch.Tensor) -> tuple[Any, ...]:
        """By log-probabilities, entropies and outputs."""
        factor = float(by_total)
        gradients = [torch.from_numpy(each if factor == 1.0 else factor * each) for each in ctx.gradients]
        return *gradients, None, None, None
