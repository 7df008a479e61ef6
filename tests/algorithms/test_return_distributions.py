"""Categorical grids and particles: projection, expected utility and losses against plain loops."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from algorithms import mocac
from algorithms.mocac import CategoricalGrid, Particles, energy_score, project
from mo_deepdrive.utilities import Utility

LOW, HIGH, ATOMS = (-1.0, 0.0, 2.0), (1.0, 4.0, 3.0), 4
PRODUCT = Utility("product", ("a", "b", "c"), lambda returns: returns.prod(-1))


def grid() -> CategoricalGrid:
    return CategoricalGrid(LOW, HIGH, ATOMS, torch.device("cpu"))


def plain_projection(masses: np.ndarray, shift: np.ndarray, discount: float) -> np.ndarray:
    """Mass by mass and corner by corner."""
    result = np.zeros((ATOMS,) * 3)
    for source in itertools.product(range(ATOMS), repeat=3):
        below, share = [], []
        for k, j in enumerate(source):
            spacing = (HIGH[k] - LOW[k]) / (ATOMS - 1)
            value = min(max(shift[k] + discount * (LOW[k] + j * spacing), LOW[k]), HIGH[k])
            position = (value - LOW[k]) / spacing
            below.append(min(int(position), ATOMS - 2))
            share.append(position - below[-1])
        for corner in itertools.product((0, 1), repeat=3):
            factor = math.prod(s if up else 1.0 - s for s, up in zip(share, corner, strict=True))
            result[tuple(b + up for b, up in zip(below, corner, strict=True))] += factor * masses[source]
    return result


def test_the_projection_is_that_of_a_plain_loop_and_keeps_the_mass() -> None:
    rng = np.random.default_rng(0)
    masses = rng.dirichlet(np.ones(ATOMS**3), size=6)
    shifts = rng.normal(size=(6, 3))
    discounts = np.array([0.0, 0.3, 0.9, 1.0, 1.0, 0.5])
    found = project(*(torch.tensor(each, dtype=torch.float32) for each in (masses, shifts, discounts)), grid().values)
    for row in range(6):
        expected = plain_projection(masses[row].reshape((ATOMS,) * 3), shifts[row], discounts[row])
        np.testing.assert_allclose(found[row].numpy().reshape(expected.shape), expected, atol=1e-6)
    torch.testing.assert_close(found.sum(-1), torch.ones(6))
    assert (found >= 0.0).all()


def test_targets_of_particles_are_moved_and_clipped_in_the_units_of_the_returns() -> None:
    scales = torch.tensor([2.0, 10.0])
    particles = Particles(2, scales, [-1.0, -1.0], [1.0, 100.0])
    following = torch.tensor([[0.1, 0.2, 0.3, 0.4]])
    outputs = torch.zeros(1, 4)
    found = particles.distance(outputs, torch.tensor([[0.9, 5.0]]), torch.tensor([0.5]), following)
    # 0.9 + 0.5 * 0.2 = 1.0 and 0.9 + 0.5 * 0.6 = 1.2, clipped to 1; 5 + 0.5 * 2 and 5 + 0.5 * 4; divided by the scales.
    targets = torch.tensor([[[0.5, 0.6], [0.5, 0.7]]])
    torch.testing.assert_close(found, energy_score(torch.zeros(1, 2, 2), targets))


@pytest.mark.parametrize("kind", ["categorical", "particles"])
def test_the_expected_utility_is_the_mean_over_the_distribution_in_parts_too(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scales = torch.tensor([2.0, 1.0, 3.0])
    distribution = grid() if kind == "categorical" else Particles(5, scales, LOW, HIGH)
    rng = torch.Generator().manual_seed(1)
    outputs = torch.randn(7, distribution.outputs, generator=rng)
    accrued, discounts = torch.randn(7, 3, generator=rng), torch.rand(7, generator=rng)
    returns, masses = distribution.support(outputs)
    expected = [
        sum(
            float(p) * float((accrued[m] + discounts[m] * z).prod())
            for p, z in zip(masses[m], returns[m % len(returns)], strict=True)
        )
        for m in range(7)
    ]
    for at_a_time in (2**20, 3 * returns[0].numel(), 1):
        monkeypatch.setattr(mocac, "MAX_RETURNS", at_a_time)
        found = distribution.expected_utility(PRODUCT, outputs, accrued, discounts)
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-3, atol=1e-4)
