"""Figures of a front: every kind of front can be drawn, and the numbers that they share."""

from __future__ import annotations

import io
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from algorithms.reporting.page.plots import draw_front, importance, principal_components
from algorithms.reporting.style import DPI
from tests.helpers.fronts import driving, front_of

FIGURES = ("importance", "reduction", "scatter")


pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.slow
@pytest.mark.parametrize(("k", "d"), [(1, 4), (12, 5), (40, 6), (300, 2)])
def test_fronts_of_every_size_can_be_drawn(tmp_path: Path, k: int, d: int) -> None:
    front = driving(k, d)
    paths = draw_front(front, tmp_path, reference_front=driving(5, d, seed=1).discounted, title="pcn on somewhere")
    assert paths == [tmp_path / f"{name}.png" for name in FIGURES]
    assert sorted(tmp_path.iterdir()) == sorted(paths), "nothing temporary is left"
    for path in paths:
        pixels = iio.imread(io.BytesIO(path.read_bytes()))[..., :3]
        assert path.read_bytes().startswith(b"\x89PNG")
        assert pixels.shape[1] >= 6.6 * DPI - 1
        assert pixels.shape[0] >= 1.5 * DPI
        assert (pixels != 255).any(axis=2).mean() > 0.005
        edges = (pixels[:3], pixels[-3:], pixels[:, :3], pixels[:, -3:])
        assert all((edge == 255).all() for edge in edges), f"nothing is cut off in {path.name}"


@pytest.mark.slow
@pytest.mark.parametrize(("k", "differing"), [(1, 0.0), (20, 0.0), (2, 1.0)])
def test_fronts_without_variation_or_known_arrivals_can_be_drawn(tmp_path: Path, k: int, differing: float) -> None:
    names = ("objective_0", "objective_1", "$x$ costs_$")
    returns = np.zeros((k, 3))
    returns[:, 2] = differing * np.arange(k)
    draw_front(front_of(returns, names, episodes=1), tmp_path)


def test_importance_is_0_for_the_worst_and_1_for_the_best_and_unknown_where_policies_do_not_differ() -> None:
    np.testing.assert_array_equal(importance([[0.0, -20.0], [4.0, -10.0], [1.0, -30.0]]).T, [[0, 1, 0.25], [0.5, 1, 0]])
    found = importance([[1.0, 2.0, 0.1 + 0.2], [3.0, 2.0, 0.3]])
    np.testing.assert_array_equal(found[:, 0], [0, 1])
    assert np.isnan(found[:, 1:]).all(), "a rounding error is no difference"


def test_components_point_where_the_variance_is() -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(size=(40, 4)) @ np.diag([3.0, 1.0, 0.5, 0.1]) @ np.linalg.qr(rng.normal(size=(4, 4)))[0]
    found = principal_components(values)
    variances, directions = np.linalg.eigh(np.cov(values.T))
    for k in (0, 1):
        expected = directions[:, -1 - k]
        expected = expected if expected[np.abs(expected).argmax()] > 0 else -expected
        np.testing.assert_allclose(found.loadings[:, k], expected, atol=1e-9)
        assert found.explained[k] == pytest.approx(variances[-1 - k] / variances.sum())
        for point, value in zip(found.points, values, strict=True):
            assert point[k] == pytest.approx(sum(expected * (value - values.mean(axis=0))))
