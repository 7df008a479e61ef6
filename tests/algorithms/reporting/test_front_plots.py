"""Pictures of a front: the numbers behind them, and that every kind of front can be drawn."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from algorithms.common.pareto import farthest_point_subset
from algorithms.evaluation.front import Front
from algorithms.evaluation.metrics import label
from algorithms.reporting import front_plots
from algorithms.reporting.front_plots import BARS, draw_front
from algorithms.reporting.front_view import (
    REPRESENTATIVES,
    FrontView,
    importance,
    number_formatter,
    place_labels,
    principal_components,
    separate,
)
from algorithms.reporting.style import DPI

FIGURES = ("importance", "reduction", "parallel", "scatter", "bars")
OURS = ("distance", "destination", "g_force", "jerk", "collision", "lane_violation")
MINUS = "\N{MINUS SIGN}"


@pytest.fixture(autouse=True)
def _warnings_are_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def front_of(
    returns: Any, objectives: tuple[str, ...] | None = None, succeeded: Any = None, episodes: int = 3
) -> Front:
    """A front of the mean ``returns`` (K, d); the episodes differ by a tenth."""
    mean = np.asarray(returns, dtype=np.float64)
    k, d = mean.shape
    every = mean[:, None] * np.linspace(0.9, 1.1, episodes)[:, None] if episodes > 1 else mean[:, None]
    reached = None if succeeded is None else np.repeat(np.asarray(succeeded, dtype=bool)[:, None], episodes, axis=1)
    return Front.of_episodes(
        objectives or OURS[:d], every, 0.5 * every, np.full((k, episodes), 10.0), reached, gamma=0.99, seed=0
    )


def driving(k: int, d: int, seed: int = 0) -> Front:
    """``k`` policies that trade distance for comfort and smoothness."""
    rng = np.random.default_rng(seed)
    share = np.linspace(0.0, 1.0, k) if k > 1 else np.ones(1)
    columns = [15.3 * share, share > 0.6, -30 * share, -1500 * share * rng.random(k), -1.0 * (rng.random(k) > 0.8)]
    columns.append(-3 * rng.random(k))
    return front_of(np.stack(columns[:d], axis=1), succeeded=share > 0.6)


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text) if text.get_text()]


# --------------------------------------------------------------------------------------------------- the numbers behind


def test_importance_is_0_for_the_worst_and_1_for_the_best_of_the_front() -> None:
    rng = np.random.default_rng(1)
    returns = rng.normal(size=(7, 3)) * (1, 100, 1e-3)
    found = importance(returns)
    for i in range(3):
        low, high = min(returns[:, i]), max(returns[:, i])
        for k in range(7):
            assert found[k, i] == pytest.approx((returns[k, i] - low) / (high - low))
    np.testing.assert_array_equal(importance([[0.0, -20.0], [4.0, -10.0], [1.0, -30.0]]).T, [[0, 1, 0.25], [0.5, 1, 0]])


def test_importance_is_unknown_where_policies_do_not_differ() -> None:
    found = importance([[1.0, 2.0, 0.1 + 0.2], [3.0, 2.0, 0.3]])
    np.testing.assert_array_equal(found[:, 0], [0, 1])
    assert np.isnan(found[:, 1:]).all(), "a rounding error is no difference"
    assert np.isnan(importance([[1.0, 0.0]])).all()


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


def test_components_of_points_on_a_line_in_one_place_or_turned_round_are_no_accident() -> None:
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


def test_representatives_are_those_that_cover_the_front_by_distance() -> None:
    front = driving(60, 4).take(np.random.default_rng(4).permutation(60))
    view = FrontView(front)
    shown = view.representatives()
    assert len(shown) == REPRESENTATIVES
    assert set(shown) == set(farthest_point_subset(np.nan_to_num(view.importance), REPRESENTATIVES))
    assert (np.diff(front.returns[shown, 0]) >= 0).all()
    for i in range(4):
        assert front.returns[shown, i].max() == front.returns[:, i].max()
    assert set(view.representatives(BARS)) < set(shown), "all pictures show the same ones"
    few = FrontView(front.take(range(5)))
    assert sorted(few.representatives()) == list(range(5))


def test_distance_orders_wherever_it_stands_and_else_the_first_objective() -> None:
    front = front_of([[1.0, 5.0], [2.0, 3.0]], ("jerk", "distance"))
    np.testing.assert_array_equal(FrontView(front).representatives(), [1, 0])
    other = front_of([[2.0, 5.0], [1.0, 6.0]], ("speed", "fuel"))
    np.testing.assert_array_equal(FrontView(other).representatives(), [1, 0])
    assert (FrontView(other).colours[0] != FrontView(other).colours[1]).any()


def test_one_objective_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\['distance'\]; figures of a front need at least two"):
        draw_front(front_of([[1.0]]), Path("nowhere"))


@pytest.mark.parametrize(
    ("values", "value", "text"),
    [
        ((0.0, 15.34), 15.34, "15.3 m"),
        ((-1482.4, -3.0), -1482.4, f"{MINUS}1,482 m"),
        ((0.0, 1.0), 1.0, "1.00 m"),
        ((0.0, 0.0), 0.0, "0.0 m"),
        ((-1500.12, -1500.01), -1500.12, f"{MINUS}1,500.120 m"),
        ((-3.0, 0.0), -0.0001, "0.00 m"),
    ],
)
def test_numbers_are_written_with_the_digits_that_matter(values: tuple[float, ...], value: float, text: str) -> None:
    assert number_formatter(values, "m")(value) == text
    assert number_formatter(values)(value) == text.removesuffix(" m")


def test_labels_say_what_is_summed() -> None:
    assert label("jerk") == "jerk (sum, m/s³)"
    assert label("g_force", "discounted") == "g-force (discounted, g)"
    assert label("destination") == "destination"
    assert label("objective_0") == "objective_0"


def test_what_is_moved_apart_moves_as_little_as_it_can() -> None:
    free = np.array([0.9, 0.1, 0.5])
    np.testing.assert_allclose(separate(free, 0.2, (0.0, 1.0)), free)
    np.testing.assert_allclose(separate([0.5, 0.5], 0.2, (0.0, 1.0)), [0.4, 0.6])
    np.testing.assert_allclose(separate([0.0, 0.0, 0.9], 0.2, (0.0, 1.0)), [0.0, 0.2, 0.9])
    np.testing.assert_allclose(separate([1.0, 0.9, 1.0], 0.2, (0.0, 1.0)), [0.8, 0.6, 1.0])
    np.testing.assert_allclose(separate(np.zeros(11), 0.2, (0.0, 1.0)), np.linspace(0.0, 1.0, 11))
    np.testing.assert_allclose(separate([0.3], 0.2, (0.0, 1.0)), [0.3])


def test_labels_keep_off_points_each_other_and_the_edge() -> None:
    rng = np.random.default_rng(5)
    points = rng.random((60, 2)) * (400, 250)
    size = np.tile((14.0, 9.0), (10, 1))
    centres = place_labels(points[:10], size, points, (0.0, 0.0, 400.0, 250.0))
    for i, centre in enumerate(centres):
        assert np.linalg.norm(centre - points[i]) < 60.0
        assert (centre >= (7.0, 4.5)).all()
        assert (centre <= (393.0, 245.5)).all()
        assert not (np.abs(points - centre) < (7.0, 4.5)).all(axis=1).any()
        for other in centres[:i]:
            assert (np.abs(centre - other) >= (14.0, 9.0)).any()


# --------------------------------------------------------------------------------------------------------- the pictures


@pytest.mark.parametrize(("k", "d"), [(1, 4), (2, 3), (12, 5), (40, 6), (300, 2)])
def test_every_size_of_front_has_its_pictures(tmp_path: Path, k: int, d: int) -> None:
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


@pytest.mark.parametrize(("k", "differing"), [(1, 0.0), (20, 0.0), (2, 1.0)])
def test_fronts_that_hardly_differ_and_do_not_say_who_arrives_can_be_drawn(
    tmp_path: Path, k: int, differing: float
) -> None:
    names = ("objective_0", "objective_1", "$x$ costs_$")
    returns = np.zeros((k, 3))
    returns[:, 2] = differing * np.arange(k)
    draw_front(front_of(returns, names, episodes=1), tmp_path)


def test_pictures_are_the_same_every_time(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    for first, second in zip(*(draw_front(driving(20, 2), tmp_path / name) for name in "ab"), strict=True):
        assert first.read_bytes() == second.read_bytes()


def test_a_reference_front_of_another_width_is_refused(tmp_path: Path) -> None:
    for bad in (np.zeros((3, 3)), np.zeros((0, 2)), np.zeros(2)):
        with pytest.raises(ValueError, match=r"must be \(k, 2\)"):
            draw_front(driving(3, 2), tmp_path, reference_front=bad)
    assert not list(tmp_path.iterdir())


def test_importance_shows_every_number_between_its_ends_in_real_units() -> None:
    front = front_of([[0.0, 1.0, -10.0], [10.0, 1.0, -30.0], [4.0, 1.0, -15.0]], ("distance", "destination", "g_force"))
    figure = front_plots._importance(FrontView(front, "pcn"))
    distance, destination, comfort = figure.axes
    assert [round(bar.get_height(), 2) for bar in distance.patches] == [0.0, 0.4, 1.0]
    assert [round(bar.get_height(), 2) for bar in comfort.patches] == [1.0, 0.75, 0.0]
    assert not destination.patches
    assert "1.00, the same for every policy" in texts(figure)
    assert [tick.get_text() for tick in distance.get_yticklabels()] == ["0.0 m = 0", "10.0 m = 1"]
    assert [tick.get_text() for tick in comfort.get_yticklabels()] == [f"{MINUS}30.0 g = 0", f"{MINUS}10.0 g = 1"]
    assert [tick.get_text() for tick in comfort.get_xticklabels()] == ["0", "2", "1"]
    assert {"comfort: g-force (sum, g)", "pcn: importance of the objectives"} <= set(texts(figure))


def test_scatter_shows_discounted_returns_above_the_reference_front() -> None:
    front, reference = driving(6, 3), driving(4, 3, seed=1).discounted
    figure = front_plots._scatter(FrontView(front), reference)
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


def test_parallel_tells_apart_who_arrives_and_numbers_representatives() -> None:
    front = driving(30, 4)
    figure = front_plots._parallel(FrontView(front))
    lines = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 4]
    assert len(lines) == 30
    assert sum(line.get_linestyle() == "--" for line in lines) == (front.success < 0.5).sum()
    shown = FrontView(front).representatives()
    assert sum(line.get_alpha() == 1.0 for line in lines) == len(shown)
    assert {str(policy) for policy in shown} <= set(texts(figure))
    unknown = replace(front, success=np.full(30, np.nan))
    lines = front_plots._parallel(FrontView(unknown)).axes[0].lines
    assert all(line.get_linestyle() == "-" for line in lines)


def test_bars_show_means_intervals_and_who_arrives() -> None:
    front = driving(12, 4)
    view = FrontView(front)
    shown = view.representatives(BARS)
    figure = front_plots._bars(view)
    for i, axis in enumerate(figure.axes[:4]):
        np.testing.assert_allclose([bar.get_width() for bar in axis.patches], front.returns[shown, i])
    ends = figure.axes[0].collections[0].get_segments()
    for policy, ((low, _), (high, _)) in zip(shown, ends, strict=True):
        np.testing.assert_allclose((low, high), (front.low[policy, 0], front.high[policy, 0]))
    rates = figure.axes[4]
    np.testing.assert_array_equal([bar.get_width() for bar in rates.patches], front.success[shown])
    assert any("95% bootstrap intervals" in text for text in texts(figure))
    alone = front_plots._bars(FrontView(front_of([[1.0, -2.0]], episodes=1)))
    assert not any("bootstrap" in text for text in texts(alone))
