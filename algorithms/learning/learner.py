"""The networks of one policy for S seeds: parameters with the seeds as their first axis, and Adam for all of them."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.utils._pytree import tree_map

from algorithms.learning.compiling import Compiled, origin, pure

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from algorithms.learning.losses import Loss

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
LANES = 64
TINY = 1e-6  # added to the norm of a gradient that is clipped
NORM = "the norm of the gradient"  # among the parts of a loss
# Of the products of a gradient on a GPU: rows of a part, and how many parts of all seeds keep it busy.
ROWS, PARTS = 128, 256


class Networks(nn.Module):
    """All networks of a policy by name, so that whatever is done with them can be done with other parameters."""

    actor: Any
    critic: Any
    target_critic: Any
    network: Any

    def __init__(self, **networks: nn.Module):
        super().__init__()
        for name, network in networks.items():
            self.add_module(name, network)

    def forward(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """``function(self, *arguments)``."""
        return function(self, *arguments)


class Learner:
    """Networks of S seeds, and one step of Adam for all of them down the gradient of their losses.

    What is done for one seed, :meth:`call` does for all at once, by ``torch.func.vmap``; seeds do not meet. All
    parameters are views of one matrix, so that a step of Adam is one operation.

    Args:
        networks: of each seed, alike but for their parameters, on the device; those of the first lend the structure.
        max_grad_norm: to which the norm of a seed's gradient is clipped; infinite for no limit.
        name: in checkpoints.
    """

    def __init__(self, networks: Sequence[Networks], max_grad_norm: float, name: str):
        self.networks, self.name, self.seeds = networks[0], name, len(networks)
        self._max_grad_norm = max_grad_norm
        first = next(self.networks.parameters())
        if first.is_cuda:
            for layer in self.networks.modules():
                if isinstance(layer, nn.Linear):
                    layer.forward = partial(_linear, layer, PARTS // self.seeds)  # type: ignore[method-assign]
        self._shapes = {name: each.shape for name, each in self.networks.named_parameters()}
        self._sizes = [shape.numel() for shape in self._shapes.values()]
        size = sum(self._sizes)
        # Padded, so that every number of a seed is in the lane of a vector instruction in which it is alone.
        self._padding = -size % LANES if self.seeds > 1 else 0
        # (S, P) the parameters, and the moments of Adam; (S, 1) its steps.
        self.vector, self.mean, self.mean_square = torch.zeros(3, self.seeds, size + self._padding, device=first.device)
        self.count = torch.zeros(self.seeds, 1, device=first.device)
        for row, each in zip(self.vector, networks, strict=True):
            row[:size] = torch.cat([parameter.detach().flatten() for parameter in each.parameters()])
        for parameter, data in zip(self.networks.parameters(), self._views(self.vector[0]).values(), strict=True):
            parameter.data = data
        self._rows = torch.arange(self.seeds, device=first.device).unsqueeze(1)
        # Whether gradient steps, and what `compute` computes, go through torch.compile; "auto" where that is possible.
        self.compiled: bool | Literal["auto"] = False
        self.computes_compiled: bool | Literal["auto"] = False
        self._functions: dict[Any, Compiled] = {}
        self._mapped: set[Any] = set()  # functions that have been called for several seeds

    @property
    def state(self) -> tuple[Tensor, ...]:
        """What a gradient step changes: parameters, the means of Adam, and its numbers of steps."""
        return self.vector, self.mean, self.mean_square, self.count

    def _views(self, vector: Tensor) -> dict[str, Tensor]:
        """The parameters by name, (...) of a vector (P,) or (S, ...) of a matrix."""
        parts = vector[..., : sum(self._sizes)].split(self._sizes, dim=-1)
        return {
            name: part.unflatten(-1, shape) for (name, shape), part in zip(self._shapes.items(), parts, strict=True)
        }

    def parameters(self, network: str) -> dict[str, Tensor]:
        """Those of one network of all seeds by name, (S, ...), as views."""
        return {name: each for name, each in self._views(self.vector).items() if name.startswith(f"{network}.")}

    def compute(self, function: Callable[..., Any], arguments: Any, *shared: Any) -> Any:
        """:meth:`call` with the parameters as they are, without a gradient."""
        if self.seeds == 1 and not self.computes_compiled:  # they are those of the networks
            return tree_map(_with_axis, function(self.networks, tree_map(_only, arguments), *shared))
        return self._function(self.call, function, self.computes_compiled)(self.vector, arguments, *shared)

    def _function(
        self, method: Callable[..., Any], function: Callable[..., Any], compiled: bool | Literal["auto"]
    ) -> Compiled:
        key = method.__name__, function, compiled
        if key not in self._functions:
            self._functions[key] = Compiled(partial(method, function), enabled=compiled)
        return self._functions[key]

    def call(self, function: Callable[..., Any], vector: Tensor, arguments: Any, *shared: Any) -> Any:
        """What ``function(networks, arguments, *shared)`` gives for every seed, a tree of tensors (S, ...).

        The networks have a seed's row of ``vector`` (S, P), and its part of ``arguments``, a tree of tensors (S, ...).
        """

        def of_one(own: Any, part: Any) -> Any:
            return functional_call(self.networks, own, (function, part, *shared))

        parameters = self._views(vector)
        if self.seeds == 1:
            return tree_map(_with_axis, of_one(*tree_map(_only, (parameters, arguments))))
        try:
            found = vmap(of_one)(parameters, arguments)
        except (RuntimeError, TypeError) as error:
            if function in self._mapped or isinstance(error, torch.OutOfMemoryError):
                raise
            raise ValueError(
                f"an update cannot be calculated for several seeds at once, because of {origin(error)}; take "
                "operations of torch on whole tensors, such as torch.where instead of if, or train each seed alone"
            ) from error
        self._mapped.add(function)
        return found

    def minimise(
        self,
        loss: Callable[..., Loss],
        samples: Mapping[str, Tensor],
        rows: Sequence[Tensor],
        learning_rate: Tensor,
        *shared: Tensor,
    ) -> dict[str, Tensor]:
        """One step of every seed down the gradient of its loss, whose norm is clipped.

        A seed whose gradient is 0, or not finite, stays where it is. ``loss(networks, samples, *shared)`` is that of
        one seed and must not change its samples in place, which are (S, M, ...) by name. Of them it takes those at
        ``rows`` [(S, m)], or all if that is empty. Gives the parts of the loss and the norm of the gradient, (S,).
        """
        step: Any = self._function(self._step, loss, self.compiled)
        return dict(step(self.state, dict(samples), list(rows), learning_rate, *shared))

    def _step(
        self,
        loss: Callable[..., Loss],
        state: tuple[Tensor, ...],
        samples: dict[str, Tensor],
        rows: Sequence[Tensor],
        learning_rate: Tensor,
        *shared: Tensor,
    ) -> dict[str, Tensor]:
        vector, mean, mean_square, count = state
        for chosen in rows:
            samples = {name: self._at(each, chosen) for name, each in samples.items()}
        with torch.enable_grad():
            leaf = vector.detach().requires_grad_()
            with pure("a loss", samples):
                totals, parts = self.call(loss, leaf, samples, *shared)
            (gradient,) = torch.autograd.grad(totals.sum(), leaf)
        norms = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
        moves = norms.isfinite() & (norms > 0.0)
        gradient = torch.where(moves, gradient * (self._max_grad_norm / (norms + TINY)).clamp(max=1.0), 0.0)
        # Adam (Kingma and Ba 2015, algorithm 1).
        count += moves
        mean.lerp_(gradient, (1.0 - BETA1) * moves)
        mean_square.lerp_(gradient.square(), (1.0 - BETA2) * moves)
        # In double precision: 1 - 0.999 would lose five digits in single.
        correction1, correction2 = ((1.0 - beta ** count.double()).to(vector.dtype) for beta in (BETA1, BETA2))
        update = learning_rate / correction1 * mean / ((mean_square / correction2).sqrt() + EPSILON)
        vector -= torch.where(moves, update, 0.0)
        return {**{name: part.detach() for name, part in parts.items()}, NORM: norms.squeeze(1)}

    def _at(self, samples: Tensor, rows: Tensor) -> Tensor:
        """The samples (S, m, ...) of (S, M, ...) at ``rows`` (S, m)."""
        if self.seeds == 1:
            return samples[0].index_select(0, rows[0]).unsqueeze(0)
        return samples[self._rows, rows]

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def get_state(self, seed: int = 0) -> dict[str, Tensor]:
        """Weights and the optimiser's state of the seed with this index, as named tensors."""
        size = sum(self._sizes)
        return {
            **self._weights(seed),
            "optimiser.step": self.count[seed, 0],
            "optimiser.exp_avg": self.mean[seed, :size],
            "optimiser.exp_avg_sq": self.mean_square[seed, :size],
        }

    def set_state(self, state: Mapping[str, Tensor], seed: int = 0) -> None:
        """Resume from :meth:`get_state`."""
        self.set_weights(state, seed)
        self.count[seed] = state["optimiser.step"]
        for moments, name in ((self.mean, "exp_avg"), (self.mean_square, "exp_avg_sq")):
            moments[seed, : sum(self._sizes)] = state[f"optimiser.{name}"]

    def _weights(self, seed: int) -> dict[str, Tensor]:
        """Parameters and buffers by name."""
        return {**self._views(self.vector[seed]), **dict(self.networks.named_buffers())}

    def get_weights(self, network: str, seed: int = 0) -> dict[str, Tensor]:
        """The part of :meth:`get_state` that one network consists of."""
        return {name: each for name, each in self._weights(seed).items() if name.startswith(f"{network}.")}

    def set_weights(self, state: Mapping[str, Tensor], seed: int = 0) -> None:
        """Take those weights that are in a state."""
        with torch.no_grad():
            for name, each in self._weights(seed).items():
                if name in state:
                    each.copy_(state[name])

    def park(self, seed: int) -> None:
        """Give a seed that has failed parameters with which it goes on doing no harm."""
        for each in self.state:
            each[seed] = 0.0


def _only(tensor: Tensor) -> Tensor:
    """That of the only seed."""
    return tensor[0]


def _with_axis(tensor: Tensor) -> Tensor:
    return tensor.unsqueeze(0)


def _linear(layer: nn.Linear, most_parts: int, x: Tensor) -> Tensor:
    """X W^T + b, for which many rows x (M, inputs) are parted.

    The gradient dL/dW = sum_m g_m x_m^T is then a sum of products that a GPU calculates at the same time; as a single
    product of two long and narrow matrices it would leave most of the GPU idle.
    """
    rows = len(x) if x.dim() == 2 else 0
    parts = min(rows // ROWS, most_parts, rows & -rows)  # the last one is the greatest power of two that divides rows
    if parts < 2:
        return nn.functional.linear(x, layer.weight, layer.bias)
    parts = 1 << (parts.bit_length() - 1)
    weights = layer.weight.t().expand(parts, layer.in_features, layer.out_features)
    return torch.bmm(x.view(parts, rows // parts, layer.in_features), weights).flatten(0, 1) + layer.bias
