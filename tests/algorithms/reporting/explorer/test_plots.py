"""Figures of a front: what they show, that every kind of front can be drawn, and the numbers that they share."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from algorithms.reporting.explorer import plots
from algorithms.reporting.explorer.plots import (
    REPRESENTATIVES,
    FrontView,
    draw_front,
    importance,
    principal_components,
)
from algorithms.reporting.style import DPI
from mo_deepdrive.evaluation.metrics import joint_objectives
from mo_deepdrive.evaluation.pareto import farthest_point_subset
from tests.helpers.fronts import driving, front_of

FIGURES = ("importance", "reduction", "scatter")


@pytest.fixture(autouse=True)
def _warnings_are_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def texts(figure: Figure) -> list[str]:
    return [text.get_text().strip() for text in figure.findobj(matplotlib.text.Text) if text.get_text()]


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


@pytest.mark.slow
def test_pairs_of_many_objectives_are_not_drawn(tmp_path: Path) -> None:
    names = joint_objectives(("distance", "g_force", "jerk", "collision", "lane_violation"), 2)
    front = front_of(np.random.default_rng(0).normal(size=(3, 10)), names)
    assert [path.stem for path in draw_front(front, tmp_path)] == [name for name in FIGURES if name != "scatter"]
    assert "vehicle 1: g-force (discounted, g)" in texts(plots._importance(FrontView(front)))
    many = joint_objectives(("distance", "jerk", "time"), 8)
    front = front_of(np.random.default_rng(0).normal(size=(3, 24)), many)
    assert [path.stem for path in draw_front(front, tmp_path)] == ["importance"]


def test_what_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\['distance'\]; figures of a front need at least two"):
        draw_front(front_of([[1.0]]), tmp_path)
    for bad in (np.zeros((3, 3)), np.zeros((0, 2)), np.zeros(2)):
        with pytest.raises(ValueError, match=r"must be \(k, 2\)"):
            draw_front(driving(3, 2), tmp_path, reference_front=bad)
    assert not list(tmp_path.iterdir())


def test_importance_shows_numbers_and_their_range_in_real_units() -> None:
    front = front_of([[0.0, 1.0, -10.0], [10.0, 1.0, -30.0], [4.0, 1.0, -15.0]], ("distance", "destination", "g_force"))
    figure = plots._importance(FrontView(front, "pcn"))
    distance, destination, comfort = figure.axes
    assert [round(bar.get_height(), 2) for bar in distance.patches] == [0.0, 0.4, 1.0]
    assert [round(bar.get_height(), 2) for bar in comfort.patches] == [1.0, 0.75, 0.0]
    assert not destination.patches
    assert "0.5, the same for every policy" in texts(figure)
    assert [tick.get_text() for tick in distance.get_yticklabels()] == ["0 m = 0", "5 m = 1"]
    assert [tick.get_text() for tick in comfort.get_yticklabels()] == ["-15 g = 0", "-5 g = 1"]
    assert [tick.get_text() for tick in comfort.get_xticklabels()] == ["0", "2", "1"]
    assert {"comfort: g-force (discounted, g)", "pcn: importance of the objectives"} <= set(texts(figure))


def test_policies_that_differ_in_their_arrival_time_alone_are_spread_over_the_front() -> None:
    arrivals = np.linspace(0.0, 200.0, 90)
    discounted = np.stack([10.0 * 0.99**arrivals, -4.0 * 0.99**arrivals], axis=1)
    front = replace(front_of(np.tile([14.5, -5.5], (90, 1)), ("distance", "g_force")), discounted=discounted)
    distance = plots._importance(FrontView(front)).axes[0]
    heights = [bar.get_height() for bar in distance.patches]
    assert len(heights) == 16
    assert heights == sorted(heights)
    assert max(np.diff(heights)) < 0.15


def test_scatter_shows_discounted_returns_in_front_of_the_reference_front() -> None:
    front, reference = driving(6, 3), driving(4, 3, seed=1).discounted
    figure = plots._scatter(FrontView(front), reference)
    panels = [axis for axis in figure.axes if axis.get_visible() and axis.get_label() != "<colorbar>"]
    for axis, pair in zip(panels, ((0, 1), (0, 2), (1, 2)), strict=True):
        below, above = axis.collections
        np.testing.assert_allclose(below.get_offsets(), reference[:, pair])
        np.testing.assert_allclose(above.get_offsets(), front.discounted[:, pair])
        assert below.zorder < above.zorder
        hollow = (above.get_facecolors()[:, :3] == 1.0).all(axis=1)
        np.testing.assert_array_equal(hollow, front.success < 0.5)
    assert any("gamma 0.99" in text for text in texts(figure))
    assert "best-known front (4 points)" in texts(figure)


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


def test_components_are_defined_for_points_on_a_line_or_in_one_place_and_their_sign_is_fixed() -> None:
    line = principal_components([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0]])
    np.testing.assert_allclose(line.explained, [1.0, 0.0])
    np.testing.assert_allclose(line.loadings[:, 0], np.array([1.0, 2.0]) / np.sqrt(5.0))
    assert not line.loadings[:, 1].any()
    assert not line.points[:, 1].any()
    for same in (np.ones((1, 4)), np.full((3, 2), 0.1)):
        found = principal_components(same)
        assert not found.points.any()
        assert not found.explained.any()
    values = np.random.default_rng(3).normal(size=(9, 3))
    np.testing.assert_allclose(
        principal_components(values).loadings, principal_components(-values).loadings, atol=1e-12
    )


def test_representatives_cover_the_front_and_are_ordered_by_distance() -> None:
    front = driving(60, 4).take(np.random.default_rng(4).permutation(60))
    view = FrontView(front)
    shown = view.representatives()
    assert len(shown) == REPRESENTATIVES
    assert set(shown) == set(farthest_point_subset(np.nan_to_num(view.importance), REPRESENTATIVES))
    assert (np.diff(front.returns[shown, 0]) >= 0).all()
    for i in range(4):
        assert front.returns[shown, i].max() == front.returns[:, i].max()
    few = FrontView(front.take(range(5)))
    assert sorted(few.representatives()) == list(range(5))


def test_policies_are_ordered_by_distance_or_else_by_the_first_objective() -> None:
    front = front_of([[1.0, 5.0], [2.0, 3.0]], ("jerk", "distance"))
    np.testing.assert_array_equal(FrontView(front).representatives(), [1, 0])
    other = front_of([[2.0, 5.0], [1.0, 6.0]], ("speed", "fuel"))
    np.testing.assert_array_equal(FrontView(other).representatives(), [1, 0])
    assert (FrontView(other).colours[0] != FrontView(other).colours[1]).any()
