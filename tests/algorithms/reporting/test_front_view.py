"""What the figures of a front share: importance, components, representatives, and where labels are."""

from __future__ import annotations

import numpy as np
import pytest

from algorithms.reporting.explorer.plots import (
    BARS,
    REPRESENTATIVES,
    FrontView,
    importance,
    number_formatter,
    principal_components,
    separate,
)
from mo_deepdrive.evaluation.pareto import farthest_point_subset
from tests.helpers.fronts import driving, front_of

MINUS = "\N{MINUS SIGN}"


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
    assert set(view.representatives(BARS)) < set(shown), "all figures show the same ones"
    few = FrontView(front.take(range(5)))
    assert sorted(few.representatives()) == list(range(5))


def test_policies_are_ordered_by_distance_or_else_by_the_first_objective() -> None:
    front = front_of([[1.0, 5.0], [2.0, 3.0]], ("jerk", "distance"))
    np.testing.assert_array_equal(FrontView(front).representatives(), [1, 0])
    other = front_of([[2.0, 5.0], [1.0, 6.0]], ("speed", "fuel"))
    np.testing.assert_array_equal(FrontView(other).representatives(), [1, 0])
    assert (FrontView(other).colours[0] != FrontView(other).colours[1]).any()


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
def test_numbers_are_formatted_with_the_digits_that_matter(values: tuple[float, ...], value: float, text: str) -> None:
    assert number_formatter(values, "m")(value) == text
    assert number_formatter(values)(value) == text.removesuffix(" m")


def test_positions_are_separated_by_the_smallest_moves() -> None:
    free = np.array([0.9, 0.1, 0.5])
    np.testing.assert_allclose(separate(free, 0.2, (0.0, 1.0)), free)
    np.testing.assert_allclose(separate([0.5, 0.5], 0.2, (0.0, 1.0)), [0.4, 0.6])
    np.testing.assert_allclose(separate([0.0, 0.0, 0.9], 0.2, (0.0, 1.0)), [0.0, 0.2, 0.9])
    np.testing.assert_allclose(separate([1.0, 0.9, 1.0], 0.2, (0.0, 1.0)), [0.8, 0.6, 1.0])
    np.testing.assert_allclose(separate(np.zeros(11), 0.2, (0.0, 1.0)), np.linspace(0.0, 1.0, 11))
    np.testing.assert_allclose(separate([0.3], 0.2, (0.0, 1.0)), [0.3])
