"""Schedules at their ends and in between; the state of an optimiser through named tensors."""

from __future__ import annotations

import pytest
import torch

from algorithms.common.optimisers import (
    geometric_schedule,
    linear_schedule,
    optimiser_state,
    set_learning_rate,
    set_optimiser_state,
)


def test_a_linear_schedule_moves_evenly_and_stops_at_its_end() -> None:
    assert [linear_schedule(1.0, 0.0, progress) for progress in (0.0, 0.25, 1.0, 2.0)] == [1.0, 0.75, 0.0, 0.0]
    assert linear_schedule(0.3, None, 0.9) == 0.3


def test_a_geometric_schedule_moves_by_a_constant_factor_and_stops_at_its_end() -> None:
    values = [geometric_schedule(0.1, 0.001, progress) for progress in (0.0, 0.5, 1.0, 3.0)]
    assert values == pytest.approx([0.1, 0.01, 0.001, 0.001])
    assert geometric_schedule(0.0, 0.0, 0.5) == 0.0


def small_problem() -> tuple[list[torch.nn.Parameter], torch.optim.Adam]:
    parameters = [torch.nn.Parameter(torch.ones(3)), torch.nn.Parameter(torch.ones(2))]
    return parameters, torch.optim.Adam(parameters, lr=0.1)


def step(parameters: list[torch.nn.Parameter], optimiser: torch.optim.Adam) -> None:
    optimiser.zero_grad()
    torch.stack([(parameter**2).sum() for parameter in parameters]).sum().backward()
    optimiser.step()


@pytest.mark.slow
def test_a_restored_optimiser_takes_the_same_steps() -> None:
    (first, adam), (second, restored) = small_problem(), small_problem()
    step(first, adam)
    set_optimiser_state(restored, {name: tensor.clone() for name, tensor in optimiser_state(adam).items()})
    with torch.no_grad():
        for mine, theirs in zip(second, first, strict=True):
            mine.copy_(theirs)
    step(first, adam)
    step(second, restored)
    assert all(torch.equal(mine, theirs) for mine, theirs in zip(second, first, strict=True))


def test_a_state_that_covers_only_some_parameters_is_refused() -> None:
    parameters, adam = small_problem()
    step(parameters, adam)
    state = {name: tensor for name, tensor in optimiser_state(adam).items() if name.startswith("0.")}
    with pytest.raises(ValueError, match=r"covers the parameters \[0\]; it has 2"):
        set_optimiser_state(adam, state)


def test_the_learning_rate_is_set_for_all_parameters() -> None:
    _, adam = small_problem()
    set_learning_rate(adam, 0.5)
    assert {group["lr"] for group in adam.param_groups} == {0.5}
