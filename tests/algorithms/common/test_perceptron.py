"""Perceptrons whose gradient is written out, against autograd's of the same layers and against a plain loop."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from torch import nn

from algorithms.common.perceptron import Perceptron, recorded_passes

SIZES = [(5, 8, 4, 3), (5, 4, 8, 1), (4, 3), (3, 16, 16, 16, 6)]


def both(sizes: tuple[int, ...]) -> tuple[Perceptron, nn.Sequential]:
    """A perceptron and the same layers as a Sequential, in double precision."""
    torch.manual_seed(0)
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    reference = nn.Sequential(*layers[:-1]).double()
    perceptron = Perceptron(*(type(each)(*_arguments(each)) for each in layers[:-1])).double()
    perceptron.load_state_dict(reference.state_dict())
    return perceptron, reference


def _arguments(layer: nn.Module) -> tuple[int, ...]:
    return (layer.in_features, layer.out_features) if isinstance(layer, nn.Linear) else ()


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("shape", [(7,), (1,), (3, 4), ()])
def test_outputs_and_gradients_are_autograds(sizes: tuple[int, ...], shape: tuple[int, ...]) -> None:
    perceptron, reference = both(sizes)
    x = torch.randn(*shape, sizes[0], dtype=torch.float64)
    mine, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    outputs, expected = perceptron(mine), reference(theirs)
    torch.testing.assert_close(outputs, expected)
    by_outputs = torch.randn_like(expected)
    found = torch.autograd.grad(outputs, [mine, *perceptron.parameters()], by_outputs)
    wanted = torch.autograd.grad(expected, [theirs, *reference.parameters()], by_outputs)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other)
    with torch.no_grad():
        torch.testing.assert_close(perceptron(x), expected)


@pytest.mark.parametrize("sizes", SIZES)
def test_a_recorded_pass_has_the_same_gradient(sizes: tuple[int, ...]) -> None:
    perceptron, reference = both(sizes)
    x = torch.randn(6, sizes[0], dtype=torch.float64)
    with recorded_passes() as passes:
        outputs = perceptron(x)
    (by_outputs,) = torch.autograd.grad(outputs.square().sum(), passes[0].outputs)
    gradients = {parameter: torch.zeros_like(parameter) for parameter in perceptron.parameters()}
    passes[0].add_gradient(by_outputs, gradients)
    wanted = torch.autograd.grad(reference(x).square().sum(), list(reference.parameters()))
    for one, other in zip(gradients.values(), wanted, strict=True):
        torch.testing.assert_close(one, other)


def test_outputs_are_those_of_a_plain_loop() -> None:
    perceptron = both((3, 4, 2))[0].requires_grad_(False)
    first, second = perceptron[0], perceptron[2]
    for row in torch.randn(5, 3, dtype=torch.float64):
        hidden = [
            max(0.0, float(sum(w * x for w, x in zip(weights, row, strict=True)) + b))
            for weights, b in zip(first.weight, first.bias, strict=True)
        ]
        expected = [
            float(sum(w * h for w, h in zip(weights, hidden, strict=True)) + b)
            for weights, b in zip(second.weight, second.bias, strict=True)
        ]
        assert perceptron(row[None])[0].tolist() == pytest.approx(expected)


def test_passes_of_other_sizes_in_between_do_not_disturb_a_pass() -> None:
    perceptron, reference = both((5, 8, 4, 3))
    x = torch.randn(6, 5, dtype=torch.float64)
    with torch.inference_mode():
        perceptron(torch.randn(9, 5, dtype=torch.float64))
    with recorded_passes() as passes:
        outputs = perceptron(x)
    differentiable = perceptron(2 * x)
    with torch.no_grad():
        for rows in (2, 6, 30):
            perceptron(torch.randn(rows, 5, dtype=torch.float64))
    gradients = {parameter: torch.zeros_like(parameter) for parameter in perceptron.parameters()}
    passes[0].add_gradient(torch.ones_like(outputs), gradients)
    expected = torch.autograd.grad(reference(x).sum(), list(reference.parameters()))
    for one, other in zip(gradients.values(), expected, strict=True):
        torch.testing.assert_close(one, other)
    found = torch.autograd.grad(differentiable.sum(), list(perceptron.parameters()))
    expected = torch.autograd.grad(reference(2 * x).sum(), list(reference.parameters()))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


def test_memory_is_used_again() -> None:
    perceptron, _ = both((5, 8, 3))
    x = torch.randn(6, 5, dtype=torch.float64)
    addresses = set()
    for _ in range(5):
        with recorded_passes() as passes:
            outputs = perceptron(x)
        addresses.add(passes[0].space.flat.data_ptr())
        passes[0].add_gradient(torch.ones_like(outputs), {p: torch.zeros_like(p) for p in perceptron.parameters()})
    assert len(addresses) == 1


def test_a_weight_that_changes_before_the_backward_pass_is_noticed() -> None:
    perceptron, _ = both((5, 8, 3))
    outputs = perceptron(torch.randn(6, 5, dtype=torch.float64))
    with torch.no_grad():
        perceptron[0].weight += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        outputs.sum().backward()
