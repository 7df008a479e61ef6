"""Compiled perceptrons against torch's layers, autograd and a plain loop."""

from __future__ import annotations

from itertools import pairwise

import numba
import pytest
import torch
from algorithms.networks.compiled.tape import Tape, recording
from torch import nn

from algorithms.networks.compiled.perceptron import Perceptron
from algorithms.networks.threads import set_threads

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


def gradients_of(perceptron: Perceptron, tape: Tape, *by_outputs: torch.Tensor) -> list[torch.Tensor]:
    """The gradients by the parameters, from those by the outputs on the tape."""
    gradients = {parameter: torch.zeros_like(parameter) for parameter in perceptron.parameters()}
    pairs = [(out, by.numpy()) for out, by in zip(tape.outputs, by_outputs, strict=True)]
    tape.add_gradients(pairs, {parameter: gradient.numpy() for parameter, gradient in gradients.items()})
    return list(gradients.values())


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
    with recording() as tape:
        outputs = perceptron(x)
    assert outputs in tape
    torch.testing.assert_close(outputs, expected, rtol=1e-5, atol=1e-5)
    by_outputs = torch.randn_like(expected)
    wanted = torch.autograd.grad(expected, list(reference.parameters()), by_outputs)
    assert_all_close(gradients_of(perceptron, tape, by_outputs), wanted)


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
    with recording() as tape:
        one, other = perceptron(x), perceptron(y)
    with torch.no_grad():
        for rows in (2, 300, 3000):
            perceptron(torch.randn(rows, 5))
    found = gradients_of(perceptron, tape, torch.ones_like(one), 2.0 * torch.ones_like(other))
    assert_all_close(
        found, torch.autograd.grad((reference(x) + 2.0 * reference(y)).sum(), list(reference.parameters()))
    )


def test_a_pass_over_what_was_kept_takes_its_results() -> None:
    perceptron, reference = both((5, 8, 4, 3))
    x = torch.randn(700, 5)
    kept = perceptron.keep_passes(700)
    with torch.no_grad():
        parts = [perceptron(part) for part in x.split([300, 1, 399])]
    assert kept.done == 700
    assert torch.equal(torch.from_numpy(kept.outputs).t(), torch.cat(parts))
    with recording() as tape:
        outputs = perceptron(x.reshape(7, 100, 5))
    assert perceptron._spare == []  # no other memory has been needed
    assert torch.equal(outputs.reshape(700, 3), torch.cat(parts))
    found = gradients_of(perceptron, tape, torch.ones(700, 3))
    assert_all_close(found, torch.autograd.grad(reference(x).sum(), list(reference.parameters())))
    with torch.no_grad():
        assert torch.equal(perceptron(x), torch.cat(parts))
    assert perceptron._spare == []  # what is kept is not handed out


@pytest.mark.parametrize("change", ["parameters", "rows", "number of rows", "nothing kept since"])
def test_a_pass_over_anything_else_is_made(change: str) -> None:
    perceptron, reference = both((5, 8, 3))
    x = torch.randn(20, 5)
    perceptron.keep_passes(20)
    with torch.no_grad():
        perceptron(x)
        if change == "parameters":
            for network in (perceptron, reference):
                network[2].bias[1] += 1.0
        elif change == "rows":
            x[7, 3] += 1.0
        elif change == "number of rows":
            x = x[:19]
        else:
            perceptron.keep_passes(20)
        torch.testing.assert_close(perceptron(x), reference(x), rtol=1e-5, atol=1e-5)


def test_more_rows_than_are_to_be_kept_are_passed_as_usual() -> None:
    perceptron, reference = both((5, 8, 3))
    x, y = torch.randn(20, 5), torch.randn(20, 5)
    kept = perceptron.keep_passes(30)
    with torch.no_grad():
        perceptron(x)
        torch.testing.assert_close(perceptron(y), reference(y), rtol=1e-5, atol=1e-5)
    assert kept.done == 20


@pytest.mark.slow
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="there is one core")
def test_the_number_of_threads_does_not_change_a_bit() -> None:
    perceptron, _ = both((22, 64, 32, 22))
    x = torch.randn(1000, 22)
    results = []
    for count in (1, 2):
        set_threads(count)
        with recording() as tape:
            outputs = perceptron(x)
        results.append([outputs.detach(), *gradients_of(perceptron, tape, torch.ones_like(outputs))])
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
    with recording() as tape:
        outputs = perceptron(x)
        assert perceptron.double()(x.double()).dtype == torch.float64
    assert not tape.outputs
    (found,), (wanted,) = (torch.autograd.grad(each.sum(), x) for each in (outputs, reference(x)))
    torch.testing.assert_close(found, wanted)
