"""A multilayer perceptron with ReLU whose gradient is written out: little more than its matrix products.

At the sizes of our networks, autograd's graph of the layers costs as much as the products. The matrices lie in memory
as the products are fastest: outputs, of which there are few, one after the other (what is returned is the transposed
view), and likewise the gradient of the weights where a layer widens.
"""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence


class _Space:
    """Memory for the hidden layers of M rows and for their gradients; the system's would be mapped anew every time.

    Args:
        flat: with room for two numbers per row and hidden unit.
        rows: M.
        widths: of the hidden layers.

    Attributes:
        layers, gradients: (M, width) per hidden layer.
    """

    def __init__(self, flat: torch.Tensor, rows: int, widths: Sequence[int]):
        self.flat, self.rows = flat, rows
        parts = flat[: 2 * rows * sum(widths)].split([rows * width for width in widths for _ in range(2)])
        matrices = [part.view(rows, -1) for part in parts]
        self.layers, self.gradients = matrices[::2], matrices[1::2]


@dataclass
class Pass:
    """One forward pass that autograd does not see: for it, the outputs are where the graph begins.

    Attributes:
        perceptron: whose pass.
        inputs: (M, inputs).
        space: with the hidden layers after ReLU.
        outputs: (M, outputs), a leaf of autograd's graph.
    """

    perceptron: Perceptron
    inputs: torch.Tensor
    space: _Space
    outputs: torch.Tensor

    @torch.no_grad()
    def add_gradient(self, by_outputs: torch.Tensor, gradients: Mapping[Any, torch.Tensor]) -> None:
        """Add the gradient by the parameters to ``gradients``, from that by the outputs; ends the pass."""
        self.perceptron.add_gradient(self.inputs, self.space, by_outputs, gradients)
        self.perceptron.release(self.space)


_passes: ContextVar[list[Pass] | None] = ContextVar("passes", default=None)


@contextmanager
def recorded_passes() -> Iterator[list[Pass]]:
    """Within the context, perceptrons keep their passes in the list instead of in autograd's graph.

    The parameters get a gradient from :meth:`Pass.add_gradient` alone. Passes whose inputs need a gradient themselves
    stay in the graph.
    """
    passes: list[Pass] = []
    token = _passes.set(passes)
    try:
        yield passes
    finally:
        _passes.reset(token)


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
        self._spare: list[_Space] = []

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Outputs (..., outputs) for inputs (..., inputs)."""
        rows = inputs if inputs.dim() == 2 else inputs.reshape(-1, inputs.shape[-1])
        passes = _passes.get()
        if not torch.is_grad_enabled():
            space = self._claim(rows)
            outputs = self.outputs(rows, space)
            self.release(space)
        elif passes is None or inputs.requires_grad:
            outputs = _Differentiable.apply(self, rows, *self.weights, *self.biases)  # type: ignore[no-untyped-call]
        else:
            with torch.no_grad():
                space = self._claim(rows)
                outputs = self.outputs(rows, space).requires_grad_()
            passes.append(Pass(self, rows, space, outputs))
        return outputs if inputs.dim() == 2 else outputs.reshape(*inputs.shape[:-1], -1)

    def _claim(self, rows: torch.Tensor) -> _Space:
        """Memory for the hidden layers of ``rows`` (M, inputs), until :meth:`release`."""
        count, size = len(rows), 2 * len(rows) * sum(self._widths)
        spare = self._spare.pop() if self._spare else None
        if spare is not None and spare.rows == count:
            return spare
        if spare is not None and len(spare.flat) >= size and spare.flat.device == rows.device:
            return _Space(spare.flat, count, self._widths)
        with torch.inference_mode(False):
            return _Space(torch.empty(size, dtype=rows.dtype, device=rows.device), count, self._widths)

    def release(self, space: _Space) -> None:
        """Let another pass use the memory."""
        self._spare.append(space)

    def outputs(self, rows: torch.Tensor, space: _Space) -> torch.Tensor:
        """z_n (M, outputs) of the rows h_0 = x, with z_k = h_{k-1} W_k^T + b_k and h_k = max(0, z_k)."""
        layer = rows
        for weight, bias, hidden in zip(self.weights, self.biases, space.layers, strict=False):
            layer = torch.addmm(bias, layer, weight.t(), out=hidden).relu_()
        return torch.mm(self.weights[-1], layer.t()).add_(self.biases[-1].unsqueeze(1)).t()

    def add_gradient(
        self,
        rows: torch.Tensor,
        space: _Space,
        by_outputs: torch.Tensor,
        gradients: Mapping[Any, torch.Tensor],
    ) -> torch.Tensor:
        """Add the gradient of a loss L by the parameters, dL/dW_k = G_k^T h_{k-1} and dL/db_k = 1^T G_k.

        G_n = dL/dz_n is given, and G_{k-1} = (G_k W_k) [h_{k-1} > 0].

        Args:
            rows: (M, inputs) of the pass.
            space: its hidden layers.
            by_outputs: (M, outputs) dL/dz_n.
            gradients: by parameter, in its shape; they are added to.

        Returns:
            (M, width) G_1.
        """
        gradient = by_outputs.t().contiguous().t()
        layers = [rows, *space.layers]
        for k in range(len(layers) - 1, -1, -1):
            weight, layer = self.weights[k], layers[k]
            if len(weight) > weight.shape[1]:
                gradients[weight] += torch.mm(layer.t(), gradient).t()
            else:
                gradients[weight].addmm_(gradient.t(), layer)
            gradients[self.biases[k]] += gradient.sum(0)
            if k > 0:
                back = torch.mm(gradient, weight, out=space.gradients[k - 1])
                gradient = torch.ops.aten.threshold_backward.grad_input(back, layer, 0, grad_input=back)
        return gradient


class _Differentiable(torch.autograd.Function):
    """A perceptron as one node of autograd's graph."""

    @staticmethod
    def forward(ctx: Any, perceptron: Perceptron, rows: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        ctx.perceptron, ctx.space = perceptron, perceptron._claim(rows)
        # Autograd notices if what is saved changes before the backward pass.
        ctx.save_for_backward(rows, *parameters)
        return perceptron.outputs(rows, ctx.space)

    @staticmethod
    def backward(ctx: Any, *by_outputs: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        perceptron: Perceptron = ctx.perceptron
        rows = ctx.saved_tensors[0]
        gradients = {each: torch.zeros_like(each) for each in (*perceptron.weights, *perceptron.biases)}
        gradient = perceptron.add_gradient(rows, ctx.space, by_outputs[0], gradients)
        by_rows = gradient @ perceptron.weights[0] if ctx.needs_input_grad[1] else None
        return None, by_rows, *gradients.values()
