"""Compiled perceptrons against torch's layers, autograd and a plain loop."""

from __future__ import annotations

from itertools import pairwise

import numba
import pytest
import torch
from algorithms.networks.compiled.perceptron import Perceptron, forward_pass
from algorithms.networks.threads import set_threads
from torch import nn

SIZES = [(5, 8, 4, 3), (5, 4, 8, 1), (3, 16, 16, 16, 6), (22, 64, 32, 22), (22, 128, 64, 4)]
ROWS = [0, 1, 7, 256, 300, 1024]


def both(sizes: tuple[int, ...]) -> tuple[Perceptron, nn.Sequential]:
    """A perceptron and the same layers as a Sequential."""
    torch.manual_seed(0)
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    reference = nn.Sequential(*layers[:-1])
    perceptron = Perceptron(*(type(each)(*_arguments(each)) for each in layers[:-1]))
    perceptron.load_state_dict(reference.state_dict())
    return perceptron, reference


def _arguments(layer: nn.Module) -> tuple[int, ...]:
    return (layer.in_features, layer.out_features) if isinstance(layer, nn.Linear) else ()


def gradients_of(network: nn.Module) -> list[torch.Tensor]:
    """The gradients, which are then 0."""
    gradients = [parameter.grad.clone() for parameter in network.parameters()]
    network.zero_grad(set_to_none=False)
    return gradients


def assert_all_close(found: list[torch.Tensor], wanted: tuple[torch.Tensor, ...]) -> None:
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * max(1.0, float(other.abs().max())))


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("rows", ROWS)
def test_outputs_and_gradients_are_autograds(sizes: tuple[int, ...], rows: int) -> None:
    perceptron, reference = both(sizes)
    x = torch.randn(rows, sizes[0])
    expected = reference(x)
    with torch.no_grad():
        torch.testing.assert_close(perceptron(x), expected, rtol=1e-5, atol=1e-5)
    outputs = perceptron(x)
    torch.testing.assert_close(outputs, expected, rtol=1e-5, atol=1e-5)
    by_outputs = torch.randn_like(expected)
    outputs.backward(by_outputs)
    assert_all_close(gradients_of(perceptron), torch.autograd.grad(expected, [*reference.parameters()], by_outputs))


@pytest.mark.parametrize("shape", [(), (4,), (3, 4), (2, 1, 3)])
def test_inputs_have_any_number_of_axes_and_any_layout(shape: tuple[int, ...]) -> None:
    perceptron, reference = both((5, 8, 4, 3))
    for x in (torch.randn(*shape, 5), torch.randn(5, *shape).movedim(0, -1), torch.randn(*shape, 10)[..., ::2]):
        with torch.no_grad():
            outputs = perceptron(x)
        assert outputs.shape == (*shape, 3)
        torch.testing.assert_close(outputs, reference(x).detach(), rtol=1e-5, atol=1e-5)


def test_passes_of_other_sizes_in_between_do_not_disturb_a_pass() -> None:
    perceptron, reference = both((5, 8, 4, 3))
    x, y = torch.randn(300, 5), torch.randn(300, 5)
    with torch.inference_mode():
        perceptron(torch.randn(900, 5))
    one, other = perceptron(x), perceptron(y)
    with torch.no_grad():
        for rows in (2, 300, 3000):
            perceptron(torch.randn(rows, 5))
    (one + 2.0 * other).sum().backward()
    wanted = torch.autograd.grad((reference(x) + 2.0 * reference(y)).sum(), [*reference.parameters()])
    assert_all_close(gradients_of(perceptron), wanted)


def act_on(perceptron: Perceptron, x: torch.Tensor) -> None:
    """Keep a pass over ``x``, as a compiled rollout does."""
    kept = perceptron.keep_passes(len(x))
    weights, biases = perceptron.parameter_arrays()
    kept.rows[:] = x.numpy()
    forward_pass(0, len(x), kept.rows, weights, biases, kept.space.hidden(len(x)), kept.outputs)
    kept.outputs += 1.0  # a mark
    kept.done = len(x)


@pytest.mark.parametrize("change", ["nothing", "parameters", "rows", "number of rows", "nothing kept since"])
def test_a_pass_over_what_was_kept_takes_its_results_and_one_over_anything_else_is_made(change: str) -> None:
    perceptron, reference = both((5, 8, 3))
    x = torch.randn(700, 5)
    act_on(perceptron, x)
    if change == "parameters":
        with torch.no_grad():
            for network in (perceptron, reference):
                network[2].bias[1] += 1.0
    elif change == "rows":
        x[7, 3] += 1.0
    elif change == "number of rows":
        x = x[:19]
    elif change == "nothing kept since":
        perceptron.keep_passes(700)
    outputs, expected = perceptron(x), reference(x)
    torch.testing.assert_close(outputs, expected + float(change == "nothing"), rtol=1e-5, atol=1e-5)
    outputs.sum().backward()
    assert_all_close(gradients_of(perceptron), torch.autograd.grad(expected.sum(), [*reference.parameters()]))


@pytest.mark.slow
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="there is one core")
def test_the_number_of_threads_does_not_change_a_bit() -> None:
    perceptron, _ = both((22, 64, 32, 22))
    x = torch.randn(1000, 22)
    results = []
    for count in (1, 2):
        set_threads(count)
        outputs = perceptron(x)
        outputs.sum().backward()
        results.append([outputs.detach(), *gradients_of(perceptron)])
    set_threads(1)
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


def test_parameters_that_have_moved_are_found() -> None:
    perceptron, reference = both((5, 8, 3))
    x = torch.randn(4, 5)
    with torch.no_grad():
        perceptron(x)
        for parameter, theirs in zip(perceptron.parameters(), reference.parameters(), strict=True):
            theirs.copy_(torch.randn_like(theirs))
            parameter.data = theirs.clone()
        torch.testing.assert_close(perceptron(x), reference(x), rtol=1e-5, atol=1e-5)


def test_what_is_not_a_number_stays_so() -> None:
    perceptron, _ = both((5, 8, 3))
    x = torch.randn(3, 5)
    x[1, 2] = float("nan")
    with torch.no_grad():
        assert perceptron(x).isnan().any(-1).tolist() == [False, True, False]


def test_double_precision_and_gradients_by_the_inputs_are_torchs() -> None:
    perceptron, reference = both((5, 8, 3))
    x = torch.randn(4, 5, requires_grad=True)
    outputs = perceptron(x)
    assert perceptron.double()(x.double()).dtype == torch.float64
    (found,), (wanted,) = (torch.autograd.grad(each.sum(), x) for each in (outputs, reference(x)))
    torch.testing.assert_close(found, wanted)
