"""A multilayer perceptron with ReLU, compiled: little more than its matrix products.

Forward and backward pass are one compiled call each on the memory of the tensors, a block of rows at a time, so that
what a block needs stays in the cache. The compiled passes serve float32 on the CPU, where gradients are not wanted or a
:mod:`algorithms.common.tape` records; everything else is torch's.
"""

from __future__ import annotations

from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from algorithms.common.tape import current_tape
from mo_deepdrive.simulation.jit import jit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from algorithms.common.tape import Tape

    Arrays = tuple[NDArray[np.float32], ...]

BLOCK = 256  # rows


@jit
def forward_pass(
    rows: NDArray[np.float32], weights: Arrays, biases: Arrays, hidden: Arrays, outputs: NDArray[np.float32]
) -> None:
    """h_0 = x, z_k = W_k h_{k-1} + b_k and h_k = max(0, z_k), for rows x (M, inputs).

    Writes h_k (M, width) of every hidden layer, and the outputs z_n (outputs, M).
    """
    n = len(weights)
    for first in range(0, len(rows), BLOCK):
        last = min(first + BLOCK, len(rows))
        below = rows[first:last]
        for k in range(n - 1):
            layer, bias = hidden[k][first:last], biases[k]
            np.dot(below, weights[k].T, layer)
            for i in range(last - first):
                for j in range(len(bias)):
                    z = layer[i, j] + bias[j]
                    layer[i, j] = 0.0 if z < 0.0 else z  # keeps a NaN
            below = layer
        block = np.dot(weights[n - 1], below.T)
        for j in range(len(outputs)):
            bias_j = biases[n - 1][j]
            for i in range(last - first):
                outputs[j, first + i] = block[j, i] + bias_j


@jit
def backward_pass(
    rows: NDArray[np.float32],
    weights: Arrays,
    hidden: Arrays,
    by_outputs: NDArray[np.float32],
    by_weights: Arrays,
    by_biases: Arrays,
) -> None:
    """Add dL/dW_k = G_k^T h_{k-1} and dL/db_k = 1^T G_k, where G_{k-1} = (G_k W_k) [h_{k-1} > 0].

    Args:
        rows: (M, inputs) of the forward pass.
        weights: of the forward pass.
        hidden: from the forward pass.
        by_outputs: (outputs, M) G_n = dL/dz_n.
        by_weights: gradients, added to.
        by_biases: gradients, added to.
    """
    n = len(weights)
    for first in range(0, len(rows), BLOCK):
        last = min(first + BLOCK, len(rows))
        block = np.ascontiguousarray(by_outputs[:, first:last])
        for j in range(len(block)):
            by_biases[n - 1][j] += block[j].sum()
        _add(by_weights[n - 1], np.dot(block, hidden[n - 2][first:last]))
        gradient = np.dot(block.T, weights[n - 1])
        for k in range(n - 2, -1, -1):
            layer, total = hidden[k][first:last], by_biases[k]
            for i in range(last - first):
                for j in range(len(total)):
                    kept = np.float32(0.0) if layer[i, j] <= 0.0 else gradient[i, j]
                    gradient[i, j] = kept
                    total[j] += kept
            below = rows[first:last] if k == 0 else hidden[k - 1][first:last]
            _add(by_weights[k], np.dot(gradient.T, below))
            if k > 0:
                gradient = np.dot(gradient, weights[k])


@jit
def _add(total: NDArray[np.float32], part: NDArray[np.float32]) -> None:
    for i in range(total.shape[0]):
        for j in range(total.shape[1]):
            total[i, j] += part[i, j]


class _Space:
    """Memory for the hidden layers of M rows, (M, width) each, with room for the rows for which it was made."""

    def __init__(self, memory: NDArray[np.float32], rows: int, widths: Sequence[int]):
        self.memory, self.rows = memory, rows
        ends = list(accumulate((rows * width for width in widths), initial=0))
        parts = zip(pairwise(ends), widths, strict=True)
        self.hidden = tuple(memory[first:last].reshape(rows, width) for (first, last), width in parts)


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
        self._widths = [len(bias) for bias in self.biases[:-1]]
        # Memory that no pass holds; the system's would be mapped and cleared every time.
        self._spare: list[_Space] = []
        self._memory: tuple[tuple[int, ...], Arrays, Arrays] = ((), (), ())

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Outputs (..., outputs) for inputs (..., inputs)."""
        tape = current_tape()
        if not self._is_compiled(inputs, tape):
            result: torch.Tensor = super().forward(inputs)  # type: ignore[no-untyped-call]
            return result
        rows = np.ascontiguousarray(inputs.detach().numpy()).reshape(-1, inputs.shape[-1])
        weights, biases = self._arrays()
        space = self._claim(len(rows))
        transposed = np.empty((len(biases[-1]), len(rows)), np.float32)
        forward_pass(rows, weights, biases, space.hidden, transposed)
        outputs = torch.from_numpy(transposed).t()
        if tape is None:
            self._spare.append(space)
        else:

            def backward(by_outputs: Sequence[NDArray[Any]], gradients: Mapping[Any, NDArray[Any]]) -> None:
                by_weights = tuple([gradients[weight] for weight in self.weights])
                by_biases = tuple([gradients[bias] for bias in self.biases])
                by_transposed = np.ascontiguousarray(by_outputs[0].T)
                backward_pass(rows, weights, space.hidden, by_transposed, by_weights, by_biases)
                self._spare.append(space)

            tape.record(inputs, [outputs], backward)
        return outputs if inputs.dim() == 2 else outputs.reshape(*inputs.shape[:-1], -1)

    def _arrays(self) -> tuple[Arrays, Arrays]:
        """The memory of weights and biases, looked up again where it has moved."""
        addresses = tuple([each.data_ptr() for each in (*self.weights, *self.biases)])
        if addresses != self._memory[0]:
            weights, biases = (tuple([each.detach().numpy() for each in kind]) for kind in (self.weights, self.biases))
            self._memory = (addresses, weights, biases)
        return self._memory[1:]

    def _is_compiled(self, inputs: torch.Tensor, tape: Tape | None) -> bool:
        wanted = not torch.is_grad_enabled() if tape is None else not inputs.requires_grad
        fits = inputs.dtype == self.weights[0].dtype == torch.float32 and inputs.device.type == "cpu"
        return wanted and fits and bool(self._widths)

    def _claim(self, rows: int) -> _Space:
        """Memory for the hidden layers of ``rows`` rows, until it is spare again."""
        spare = self._spare.pop() if self._spare else None
        if spare is not None and spare.rows == rows:
            return spare
        size = rows * sum(self._widths)
        memory = np.empty(size, np.float32) if spare is None or len(spare.memory) < size else spare.memory
        return _Space(memory, rows, self._widths)
