"""Schedules at their ends and in between; Adam against torch's, with and without recorded passes, and its state."""

from __future__ import annotations

import pytest
import torch

from algorithms.networks.modules import mlp
from algorithms.networks.optimiser import Adam, geometric_schedule, linear_schedule


def test_a_linear_schedule_moves_evenly_and_stops_at_its_end() -> None:
    assert [linear_schedule(1.0, 0.0, progress) for progress in (0.0, 0.25, 1.0, 2.0)] == [1.0, 0.75, 0.0, 0.0]
    assert linear_schedule(0.3, None, 0.9) == 0.3


def test_a_geometric_schedule_moves_by_a_constant_factor_and_stops_at_its_end() -> None:
    values = [geometric_schedule(0.1, 0.001, progress) for progress in (0.0, 0.5, 1.0, 3.0)]
    assert values == pytest.approx([0.1, 0.01, 0.001, 0.001])
    assert geometric_schedule(0.0, 0.0, 0.5) == 0.0


def network_of(seed: int = 0) -> torch.nn.Sequential:
    return mlp(5, (8, 4), 3, torch.Generator().manual_seed(seed), output_gain=1.0)


def problem(batch: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(batch)
    return torch.randn(16, 5, generator=generator), torch.randn(16, 3, generator=generator)


def step(network: torch.nn.Module, optimiser: Adam, batch: int, *, recorded: bool = True) -> None:
    x, y = problem(batch)
    if recorded:
        with optimiser.recording():
            loss = (network(x) - y).square().mean()
    else:
        loss = (network(x) - y).square().mean()
    optimiser.minimise(loss, 0.01, max_grad_norm=0.7)


@pytest.mark.parametrize("recorded", [True, False])
def test_the_steps_are_those_of_torchs_adam_after_clipping_the_norm(recorded: bool) -> None:
    network, reference = network_of(), network_of()
    optimiser, theirs = Adam(network.parameters()), torch.optim.Adam(reference.parameters(), lr=0.01)
    clipped = []
    for batch in range(20):
        step(network, optimiser, batch, recorded=recorded)
        x, y = problem(batch)
        theirs.zero_grad()
        (reference(x) - y).square().mean().backward()
        clipped.append(float(torch.nn.utils.clip_grad_norm_(reference.parameters(), 0.7)) > 0.7)
        theirs.step()
        for mine, expected in zip(network.parameters(), reference.parameters(), strict=True):
            torch.testing.assert_close(optimiser.gradients[mine], expected.grad, rtol=1e-4, atol=1e-6)
    assert 0 < sum(clipped) < 20
    for mine, expected in zip(network.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-4, atol=1e-5)


def test_a_parameter_outside_the_loss_has_no_gradient() -> None:
    used, unused = network_of(0), network_of(1)
    optimiser = Adam([*used.parameters(), *unused.parameters()])
    with optimiser.recording():
        unused(problem(0)[0])
        loss = used(problem(0)[0]).square().mean()
    optimiser.minimise(loss, 0.01)
    assert all(bool(optimiser.gradients[parameter].eq(0).all()) for parameter in unused.parameters())
    assert all(bool(optimiser.gradients[parameter].ne(0).any()) for parameter in used.parameters())


def test_a_network_that_is_used_twice_in_a_loss_has_the_sum_of_both_gradients() -> None:
    network, reference = network_of(), network_of()
    optimiser = Adam(network.parameters())
    (x, _), (other, _) = problem(0), problem(1)
    with optimiser.recording():
        loss = network(x).square().mean() + network(network(other).repeat(1, 2)[:, :5]).mean()
    optimiser.minimise(loss, 0.01)
    (reference(x).square().mean() + reference(reference(other).repeat(1, 2)[:, :5]).mean()).backward()
    for mine, expected in zip(network.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(optimiser.gradients[mine], expected.grad, rtol=1e-4, atol=1e-6)


def test_a_restored_optimiser_takes_the_same_steps() -> None:
    first, second = network_of(), network_of(seed=1)
    optimiser, restored = Adam(first.parameters()), Adam(second.parameters())
    assert optimiser.get_state() == {}
    step(first, optimiser, 0)
    restored.set_state({name: tensor.clone() for name, tensor in optimiser.get_state().items()})
    second.load_state_dict(first.state_dict())
    step(first, optimiser, 1)
    step(second, restored, 1)
    assert all(torch.equal(mine, theirs) for mine, theirs in zip(second.parameters(), first.parameters(), strict=True))
    # An empty state is that before the first step.
    restored.set_state({})
    assert restored.get_state() == {}


def test_the_state_has_the_form_of_torchs_adam() -> None:
    network, reference = network_of(), network_of()
    optimiser, theirs = Adam(network.parameters()), torch.optim.Adam(reference.parameters())
    step(network, optimiser, 0)
    reference(problem(0)[0]).sum().backward()
    theirs.step()
    form = {f"{i}.{name}": t.shape for i, each in theirs.state_dict()["state"].items() for name, t in each.items()}
    assert {name: tensor.shape for name, tensor in optimiser.get_state().items()} == form


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: {k: v for k, v in state.items() if k[0] == "0"}, r"covers the parameters \[0\]; it has 6"),
        (lambda state: {**state, "x.step": state["0.step"]}, "has 'x.step'; expected PARAMETER.ENTRY"),
        (lambda state: {**state, "1.exp_avg": torch.zeros(3)}, r"of parameter 1 has .*'exp_avg': \(3,\)"),
        (lambda state: {**state, "1.exp_avg": state["1.exp_avg"].double()}, "of parameter 1 has .*float64"),
        (lambda state: {**state, "2.step": torch.tensor(-1.0)}, r"parameter 2 has step = -1\.0"),
        (lambda state: {**state, "2.step": torch.tensor(9.0)}, r"different numbers of steps: \[1, 9\]"),
    ],
)
def test_a_state_of_another_optimiser_is_refused_and_changes_nothing(change, message) -> None:  # type: ignore[no-untyped-def]
    network = network_of()
    optimiser = Adam(network.parameters())
    step(network, optimiser, 0)
    before = {name: tensor.clone() for name, tensor in optimiser.get_state().items()}
    with pytest.raises(ValueError, match=message):
        optimiser.set_state(change(before))
    assert all(torch.equal(tensor, before[name]) for name, tensor in optimiser.get_state().items())
