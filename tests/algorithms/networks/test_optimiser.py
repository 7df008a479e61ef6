"""Schedules at their ends and in between; Adam against torch's, and its state."""

from __future__ import annotations

import pytest
import torch
from algorithms.networks.compiled import plain_torch
from algorithms.networks.modules import mlp
from algorithms.networks.optimiser import Adam, geometric_schedule, linear_schedule

from mo_deepdrive.faults import NotFinite


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


def step(network: torch.nn.Module, optimiser: Adam, batch: int) -> None:
    x, y = problem(batch)
    optimiser.zero_grad()
    (network(x) - y).square().mean().backward()
    optimiser.clip(0.7)
    optimiser.step()


def test_the_steps_are_those_of_torchs_adam_after_clipping_the_norm() -> None:
    network, reference = network_of(), network_of()
    optimiser, theirs = Adam(network.parameters(), lr=0.01), torch.optim.Adam(reference.parameters(), lr=0.01)
    clipped = []
    for batch in range(20):
        step(network, optimiser, batch)
        x, y = problem(batch)
        theirs.zero_grad()
        with plain_torch():
            (reference(x) - y).square().mean().backward()
        clipped.append(float(torch.nn.utils.clip_grad_norm_(reference.parameters(), 0.7)) > 0.7)
        theirs.step()
        for mine, expected in zip(network.parameters(), reference.parameters(), strict=True):
            torch.testing.assert_close(mine.grad, expected.grad, rtol=1e-4, atol=1e-6)
    assert 0 < sum(clipped) < 20
    for mine, expected in zip(network.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-4, atol=1e-5)


def test_a_gradient_that_is_not_finite_is_refused_with_the_parts_of_the_loss() -> None:
    network = network_of()
    optimiser = Adam(network.parameters())
    (network(problem(0)[0]).sum() * torch.inf).backward()
    with pytest.raises(NotFinite, match=r"^the norm of the gradient = (nan|inf) in single precision \(loss = 3\)$"):
        optimiser.clip(0.7, lambda: {"loss": 3.0})


def test_a_restored_optimiser_takes_the_same_steps() -> None:
    first, second = network_of(), network_of(seed=1)
    optimiser, restored = Adam(first.parameters()), Adam(second.parameters())
    step(first, optimiser, 0)
    restored.set_state({name: tensor.clone() for name, tensor in optimiser.get_state().items()})
    second.load_state_dict(first.state_dict())
    step(first, optimiser, 1)
    step(second, restored, 1)
    assert all(torch.equal(mine, theirs) for mine, theirs in zip(second.parameters(), first.parameters(), strict=True))
