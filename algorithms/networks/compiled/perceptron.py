"""A multilayer perceptron with ReLU, compiled: little more than its matrix products.

Forward and backward pass are one compiled call each on the memory of the tensors, a block of rows at a time, so that
what a block needs stays in the cache. Where the gradient by the inputs is wanted, torch does it.
"""

from __future__ import annotations

from operator import is_not
from typing import TYPE_CHECKING, Any, Protocol

import numba
import numpy as np
import torch
from torch import nn

from algorithms.networks.compiled import serves
from algorithms.networks.compiled.products import add_product, product
from algorithms.networks.threads import one_blas_thread, threads
from mo_deepdrive.simulation.jit import jit, parallel_jit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float32]
    Arrays = tuple[Array, ...]

BLOCK = 256  # rows


@jit
def blocks(rows: int) -> int:
    """Number of blocks of ``rows`` rows."""
    return (rows + BLOCK - 1) // BLOCK


@jit
def forward_rows(
    first: int, last: int, rows: Array, weights: Arrays, biases: Arrays, hidden: Arrays, outputs: Array
) -> None:
    """h_0 = x, z_k = W_k h_{k-1} + b_k and h_k = max(0, z_k), for the rows x from ``first`` to ``last`` - 1.

    Args:
        first: the first row.
        last: the row after the last one, at most ``first`` + BLOCK.
        rows: (M, inputs).
        weights: of the layers.
        biases: of the layers.
        hidden: (M, width) h_k of every hidden layer, written.
        outputs: (outputs, M) z_n, written.
    """
    n = len(weights)
    below = rows[first:last]
    for k in range(n - 1):
        layer, bias = hidden[k][first:last], biases[k]
        product(below, weights[k].T, layer)
        for i in range(last - first):
            for j in range(len(bias)):
                z = layer[i, j] + bias[j]
                layer[i, j] = 0.0 if z < 0.0 else z  # keeps a NaN
        below = layer
    block, bias = outputs[:, first:last], biases[n - 1]
    product(weights[n - 1], below.T, block)
    for j in range(len(bias)):
        for i in range(last - first):
            block[j, i] += bias[j]


@jit
def _backward_block(
    b: int, rows: Array, weights: Arrays, hidden: Arrays, by_outputs: Array, by_weights: Arrays, by_biases: Arrays,
    part: int,
) -> None:  # fmt: skip
    """Add dL/dW_k = G_k^T h_{k-1} and dL/db_k = 1^T G_k of block ``b``, with G_{k-1} = (G_k W_k) [h_{k-1} > 0].

    They are added to the entry ``part`` of ``by_weights`` and ``by_biases``.
    """
    first, last = b * BLOCK, min((b + 1) * BLOCK, len(rows))
    n = len(weights)
    block = by_outputs[:, first:last]
    for j in range(len(block)):
        by_biases[n - 1][part, j] += block[j].sum()
    add_product(block, hidden[n - 2][first:last], by_weights[n - 1][part])
    above = block.T
    for k in range(n - 2, -1, -1):
        width = weights[k + 1].shape[1]
        gradient, total = np.empty((last - first, width), np.float32), np.zeros(width, np.float32)
        product(above, weights[k + 1], gradient)
        layer = hidden[k][first:last]
        for i in range(last - first):
            for j in range(width):
                kept = np.float32(0.0) if layer[i, j] <= 0.0 else gradient[i, j]
                gradient[i, j] = kept
                total[j] += kept
        for j in range(width):  # an assignment takes much longer to compile
            by_biases[k][part, j] += total[j]
        below = rows[first:last] if k == 0 else hidden[k - 1][first:last]
        add_product(gradient.T, below, by_weights[k][part])
        above = gradient


@jit
def forward_pass(
    first: int, last: int, rows: Array, weights: Arrays, biases: Arrays, hidden: Arrays, outputs: Array
) -> None:
    """As :func:`forward_rows`, for any number of rows, block by block."""
    for b in range(blocks(last - first)):
        start = first + b * BLOCK
        forward_rows(start, min(start + BLOCK, last), rows, weights, biases, hidden, outputs)


@parallel_jit
def parallel_forward_pass(
    first: int, last: int, rows: Array, weights: Arrays, biases: Arrays, hidden: Arrays, outputs: Array
) -> None:
    """As :func:`forward_pass`, with the blocks shared among threads."""
    for b in numba.prange(blocks(last - first)):
        start = first + b * BLOCK
        forward_rows(start, min(start + BLOCK, last), rows, weights, biases, hidden, outputs)


@jit
def backward_pass(
    rows: Array, weights: Arrays, hidden: Arrays, by_outputs: Array, by_weights: Arrays, by_biases: Arrays
) -> None:
    """Add the gradient.

    Args:
        rows: (M, inputs) of the forward pass.
        weights: of the forward pass.
        hidden: from the forward pass.
        by_outputs: (outputs, M) G_n = dL/dz_n.
        by_weights: (1, outputs, inputs) per layer, added to.
        by_biases: (1, outputs) per layer, added to.
    """
    for b in range(blocks(len(rows))):
        _backward_block(b, rows, weights, hidden, by_outputs, by_weights, by_biases, 0)


@parallel_jit
def parallel_backward_pass(
    rows: Array, weights: Arrays, hidden: Arrays, by_outputs: Array, by_weights: Arrays, by_biases: Arrays
) -> None:
    """As :func:`backward_pass`, with the blocks shared among threads, and the gradient of every block apart.

    Args:
        rows: as there; so are the next three.
        weights: of the forward pass.
        hidden: from it.
        by_outputs: (outputs, M).
        by_weights: (blocks, outputs, inputs) per layer, written.
        by_biases: (blocks, outputs) per layer, written.
    """
    for b in numba.prange(blocks(len(rows))):
        for k in range(len(weights)):
            by_weights[k][b] = 0.0
            by_biases[k][b] = 0.0
        _backward_block(b, rows, weights, hidden, by_outputs, by_weights, by_biases, b)


@jit
def _add_blocks(totals: Arrays, parts: Arrays) -> None:
    """Add the blocks to a gradient (1, ...), in their order, whichever threads they come from."""
    for k in range(len(totals)):
        total = totals[k].reshape(-1)
        for b in range(len(parts[k])):
            part = parts[k][b].reshape(-1)
            for j in range(len(total)):
                total[j] += part[j]


class _Space:
    """Memory for a pass; the system's would be mapped and cleared every time.

    Args:
        rows: for at most so many.
        weights: of the layers, for their shapes.
    """

    def __init__(self, rows: int, weights: Arrays):
        self.rows = rows
        self._hidden = [np.empty((rows, len(weight)), np.float32) for weight in weights[:-1]]
        # Touched, and so really there, only if threads share a pass.
        shapes = [(blocks(rows), *weight.shape) for weight in weights]
        self._by_weights = [np.empty(shape, np.float32) for shape in shapes]
        self._by_biases = [np.empty(shape[:2], np.float32) for shape in shapes]

    def hidden(self, rows: int) -> Arrays:
        """(rows, width) per hidden layer."""
        return tuple([each[:rows] for each in self._hidden])

    def gradients(self, rows: int) -> tuple[Arrays, Arrays]:
        """Those of every block of ``rows``: (blocks, outputs, inputs) and (blocks, outputs) per layer."""
        count = blocks(rows)
        return tuple([each[:count] for each in self._by_weights]), tuple([each[:count] for each in self._by_biases])


def shares_rows(rows: int) -> bool:
    """Whether threads share a pass over so many rows."""
    return threads() > 1 and rows > BLOCK


class KeptPasses:
    """Memory for a pass over the rows of a rollout, which learning from it need not repeat.

    Args:
        rows: number of rows.
        weights: of the layers, for their shapes.

    Attributes:
        rows: (rows, inputs) what has been passed, up to ``done``.
        outputs: (outputs, rows) the results.
        space: memory that has the hidden layers.
        done: number of rows that have been passed.
    """

    def __init__(self, rows: int, weights: Arrays):
        self.rows = np.empty((rows, weights[0].shape[1]), np.float32)
        self.outputs = np.empty((len(weights[-1]), rows), np.float32)
        self.space = _Space(rows, weights)
        self.done = 0
        self._parameters: Arrays = ()

    def begin(self, parameters: Arrays) -> None:
        """Begin anew, with these parameters."""
        self.done = 0
        self._parameters = tuple([each.copy() for each in parameters])

    def has(self, rows: Array, parameters: Arrays) -> bool:
        """Whether the pass was over these ``rows`` with these ``parameters``."""
        same = len(rows) == self.done and np.array_equal(rows, self.rows[: self.done])
        return same and all(map(np.array_equal, self._parameters, parameters))


class Perceptron(nn.Sequential):
    """Linear layers with ReLU between them, with the parameters of ``nn.Sequential(Linear, ReLU, Linear, ...)``.

    Args:
        *layers: alternately ``nn.Linear`` and ``nn.ReLU``; the first and the last are linear.

    Attributes:
        weights, biases: of the linear layers, in order.
    """

    def __init__(self, *layers: nn.Module):
        super().__init__(*layers)
        linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
        self.weights = [layer.weight for layer in linear]
        self.biases = [layer.bias for layer in linear]
        self._spare: list[_Space] = []  # that no pass needs
        self._kept: KeptPasses | None = None
        self._memory: tuple[tuple[int, ...], Arrays, Arrays] = ((), (), ())
        self._gradients: tuple[list[torch.Tensor | None], Arrays, Arrays] = ([], (), ())

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Outputs (..., outputs) for inputs (..., inputs)."""
        if not self.serves(inputs):
            result: torch.Tensor = super().forward(inputs)  # type: ignore[no-untyped-call]
            return result
        (outputs,) = pass_through(self, inputs.reshape(-1, inputs.shape[-1]), Outputs())
        return outputs if inputs.dim() == 2 else outputs.reshape(*inputs.shape[:-1], -1)

    def serves(self, inputs: torch.Tensor) -> bool:
        """Whether the compiled passes take ``inputs``."""
        return self.can_be_compiled and serves(inputs) and not (inputs.requires_grad and torch.is_grad_enabled())

    def keep_passes(self, rows: int) -> KeptPasses:
        """Memory in which whoever acts keeps a pass over ``rows`` rows; a later one over the same takes its results."""
        weights, biases = self.parameter_arrays()
        if self._kept is None or len(self._kept.rows) != rows:
            self._kept = KeptPasses(rows, weights)
        self._kept.begin(weights + biases)
        return self._kept

    def run(self, rows: Array) -> tuple[Array, _Space]:
        """Outputs (outputs, M) for ``rows`` (M, inputs), and the memory that has the hidden layers."""
        weights, biases = self.parameter_arrays()
        kept, count = self._kept, len(rows)
        if kept is not None and kept.has(rows, weights + biases):
            return kept.outputs[:, :count], kept.space
        outputs, space = np.empty((len(biases[-1]), count), np.float32), self._claim(count, weights)
        run_forward = parallel_forward_pass if shares_rows(count) else forward_pass
        with one_blas_thread():
            run_forward(0, count, rows, weights, biases, space.hidden(count), outputs)
        return outputs, space

    def add_gradients(self, rows: Array, space: _Space, by_outputs: Array) -> None:
        """Add the gradients by weights and biases to theirs.

        Args:
            rows: of the forward pass.
            space: from it.
            by_outputs: (outputs, M) by its outputs.
        """
        weights, (by_weights, by_biases) = self._memory[1], self._gradient_arrays()
        hidden = space.hidden(len(rows))
        with one_blas_thread():
            if shares_rows(len(rows)):
                parts = space.gradients(len(rows))
                parallel_backward_pass(rows, weights, hidden, by_outputs, *parts)
                _add_blocks(by_weights, parts[0])
                _add_blocks(by_biases, parts[1])
            else:
                backward_pass(rows, weights, hidden, by_outputs, by_weights, by_biases)

    def _gradient_arrays(self) -> tuple[Arrays, Arrays]:
        """The memory of the gradients of weights and biases, (1, ...) each, looked up again where it has moved."""
        found = [each.grad for each in (*self.weights, *self.biases)]
        if not self._gradients[0] or any(map(is_not, found, self._gradients[0])):
            arrays = [tuple([gradient_array(each)[None] for each in kind]) for kind in (self.weights, self.biases)]
            self._gradients = [each.grad for each in (*self.weights, *self.biases)], arrays[0], arrays[1]
        return self._gradients[1:]

    def release(self, space: _Space) -> None:
        """Let another pass have the memory."""
        if self._kept is None or space is not self._kept.space:
            self._spare.append(space)

    def parameter_arrays(self) -> tuple[Arrays, Arrays]:
        """The memory of weights and biases, looked up again where it has moved."""
        addresses = tuple([each.data_ptr() for each in (*self.weights, *self.biases)])
        if addresses != self._memory[0]:
            weights, biases = (tuple([each.detach().numpy() for each in kind]) for kind in (self.weights, self.biases))
            self._memory = (addresses, weights, biases)
        return self._memory[1:]

    @property
    def can_be_compiled(self) -> bool:
        """Whether there are compiled passes for these layers and parameters."""
        return serves(self.weights[0]) and len(self.weights) > 1

    def _claim(self, rows: int, weights: Arrays) -> _Space:
        """Memory for ``rows`` rows, until it is spare again."""
        space = self._spare.pop() if self._spare else None
        return _Space(rows, weights) if space is None or space.rows < rows else space


def gradient_array(parameter: torch.Tensor) -> Array:
    """The memory of a parameter's gradient."""
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter)
    array: Array = parameter.grad.numpy()
    return array


class Head(Protocol):
    """What follows on the outputs z (n, M) of a perceptron, with its gradient written out."""

    def forward(self, z: Array) -> tuple[Array, ...]:
        """The results."""

    def backward(self, *by_results: Array) -> Array:
        """The gradient (n, M) by z; those by the head's own parameters are added to theirs."""


class Outputs:
    """A head that returns the outputs (M, n) themselves."""

    def forward(self, z: Array) -> tuple[Array, ...]:
        """The outputs."""
        return (z.T,)

    def backward(self, *by_results: Array) -> Array:
        """The gradient as it is."""
        return np.ascontiguousarray(by_results[0].T)


def pass_through(network: Perceptron, inputs: torch.Tensor, head: Head) -> tuple[torch.Tensor, ...]:
    """The results of a head on the outputs of a network for ``inputs`` (M, inputs); ``backward`` differentiates them.

    Args:
        network: which takes the inputs.
        inputs: (M, inputs).
        head: for one use.
    """
    if torch.is_grad_enabled():
        results: tuple[torch.Tensor, ...] = _Pass.apply(inputs, network, head, network.weights[0])  # type: ignore[no-untyped-call]
        return results
    z, space = network.run(np.ascontiguousarray(inputs.numpy()))
    network.release(space)
    return tuple(map(torch.from_numpy, head.forward(z)))


class _Pass(torch.autograd.Function):
    """Adds gradients to ``parameter.grad`` itself: a node of autograd's graph for each takes as long as its product."""

    @staticmethod
    def forward(
        ctx: Any, inputs: torch.Tensor, network: Perceptron, head: Head, _parameter: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        ctx.rows = np.ascontiguousarray(inputs.numpy())
        z, ctx.space = network.run(ctx.rows)
        ctx.network, ctx.head = network, head
        return tuple(map(torch.from_numpy, head.forward(z)))

    @staticmethod
    def backward(ctx: Any, *by_results: torch.Tensor) -> tuple[None, ...]:
        by_z = ctx.head.backward(*[each.numpy() for each in by_results])
        ctx.network.add_gradients(ctx.rows, ctx.space, by_z)
        ctx.network.release(ctx.space)
        ctx.space = None
        return None, None, None, None
