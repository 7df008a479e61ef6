"""Dominance, indicators and selections of points, each against the plainest computation of it."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import product
from typing import Any

import mo_gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mo_deepdrive.evaluation.front import indicators
from mo_deepdrive.evaluation.pareto import (
    additive_epsilon,
    crowding_distances,
    evenly_spaced_weights,
    expected_utility,
    farthest_point_subset,
    hypervolume,
    igd_plus,
    non_dominated,
)

SIZE = 5  # of the grid of whole numbers on which points lie


def grids(least: int = 1, most: int = SIZE, d: tuple[int, int] = (1, 3), n: int = 8) -> st.SearchStrategy[np.ndarray]:
    """(n, d) points of whole numbers, so that equal values and equal points are frequent."""
    return st.integers(*d).flatmap(
        lambda width: st.lists(
            st.lists(st.integers(least, most), min_size=width, max_size=width), min_size=1, max_size=n
        ).map(lambda rows: np.array(rows, dtype=np.float64))
    )


def dominates(a: np.ndarray, b: np.ndarray) -> bool:
    return all(x >= y for x, y in zip(a, b, strict=True)) and any(x > y for x, y in zip(a, b, strict=True))


def front_of(points: np.ndarray) -> list[int]:
    """Indices of the points that no other dominates, the first of equal ones."""
    return [
        i
        for i, point in enumerate(points)
        if not any(dominates(other, point) for other in points)
        and not any((points[j] == point).all() for j in range(i))
    ]


# Dominance.


@given(grids())
def test_non_dominated_points_are_those_of_a_plain_loop(points: np.ndarray) -> None:
    found = non_dominated(points)
    assert found.dtype == np.bool_
    assert np.flatnonzero(found).tolist() == front_of(points)


# Hypervolume.


@given(grids(least=-1))
def test_the_hypervolume_of_points_on_a_grid_is_the_number_of_cells_below_them(points: np.ndarray) -> None:
    d = points.shape[1]
    cells = sum(
        any(all(p > c for p, c in zip(point, cell, strict=True)) for point in points)
        for cell in product(range(SIZE), repeat=d)
    )
    reference = np.zeros(d)
    assert hypervolume(points, reference) == pytest.approx(cells)
    assert indicators(points, reference_point=reference)["hypervolume"] == pytest.approx(cells)


def test_the_hypervolume_of_the_deep_sea_is_the_known_one() -> None:
    front = np.array(mo_gymnasium.make("deep-sea-treasure-v0").unwrapped.pareto_front(0.99))
    assert front.shape == (10, 2)
    assert non_dominated(front).all()
    assert hypervolume(front, (0.0, -25.0)) == pytest.approx(360.40, abs=0.005)
    ordered = front[np.argsort(-front[:, 0])]
    below = [*ordered[1:, 0], 0.0]
    steps = sum((x - y) * (z + 25.0) for (x, z), y in zip(ordered, below, strict=True))
    assert hypervolume(front, (0.0, -25.0)) == pytest.approx(steps)


# The other indicators.

SCALES = [1.0, 0.5, 7.0]


@given(grids(d=(3, 3)), grids(d=(3, 3)))
def test_igd_plus_is_the_mean_shortfall_of_a_plain_loop(points: np.ndarray, front: np.ndarray) -> None:
    def shortfall(goal: np.ndarray, point: np.ndarray) -> float:
        return sum(max(0.0, (g - p) / s) ** 2 for g, p, s in zip(goal, point, SCALES, strict=True)) ** 0.5

    expected = sum(min(shortfall(goal, point) for point in points) for goal in front) / len(front)
    assert igd_plus(points, front, SCALES) == pytest.approx(expected)
    assert igd_plus(points, points) == 0.0


@given(grids(d=(3, 3)), grids(d=(3, 3)))
def test_the_additive_epsilon_is_that_of_a_plain_loop(points: np.ndarray, front: np.ndarray) -> None:
    expected = max(
        min(max((g - p) / s for g, p, s in zip(goal, point, SCALES, strict=True)) for point in points) for goal in front
    )
    found = additive_epsilon(points, front, SCALES)
    assert found == pytest.approx(expected)
    assert additive_epsilon(points, points) == 0.0
    raised = points + (found + 1e-9) * np.array(SCALES)
    assert all(any((point >= goal).all() for point in raised) for goal in front)


@given(grids(d=(3, 3)), grids(least=0, d=(3, 3)))
def test_the_expected_utility_is_that_of_a_plain_loop(points: np.ndarray, weights: np.ndarray) -> None:
    best = [
        max(sum(w * x / s for w, x, s in zip(row, point, SCALES, strict=True)) for point in points) for row in weights
    ]
    assert expected_utility(points, weights, SCALES) == pytest.approx(sum(best) / len(best))
    assert expected_utility(points / SCALES, weights) == pytest.approx(sum(best) / len(best))


@given(grids(d=(2, 3)), st.integers(0, 2**32 - 1))
def test_indicators_are_those_of_the_non_dominated_points(points: np.ndarray, seed: int) -> None:
    d = points.shape[1]
    known, scales = np.random.default_rng(seed).normal(3.0, 1.0, (4, d)), SCALES[:d]
    found = indicators(points, reference_point=np.zeros(d), reference_front=known, scales=scales)
    front = points[front_of(points)]
    assert found == {
        "cardinality": len(front),
        "hypervolume": pytest.approx(hypervolume(front, np.zeros(d))),
        "expected_utility": pytest.approx(expected_utility(front, evenly_spaced_weights(d), scales)),
        "igd_plus": pytest.approx(igd_plus(front, known, scales)),
        "additive_epsilon": pytest.approx(additive_epsilon(front, known, scales)),
    }
    assert all(type(value) is float for value in found.values())


GOOD = [[1.0, 2.0], [2.0, 1.0]]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: non_dominated([]), "returns has shape (0,); it must be (n, d)"),
        (lambda: non_dominated([1.0, 2.0]), "returns has shape (2,); it must be (n, d)"),
        (lambda: non_dominated([[1.0, np.nan]]), "returns must be finite; it has nan"),
        (lambda: hypervolume([[1.0, np.inf]], [0, 0]), "front must be finite; it has inf"),
        (lambda: hypervolume(GOOD, [0]), "reference point = [0] must be 2 finite numbers"),
        (lambda: igd_plus(GOOD, [[1.0, 2.0, 3.0]]), "reference front has 3 objectives; the front has 2"),
        (lambda: igd_plus(GOOD, GOOD, [1.0, 0.0]), "scales = [1.0, 0.0] must be positive"),
        (lambda: additive_epsilon(GOOD, [[1.0]]), "reference front has 1 objectives; the front has 2"),
        (lambda: expected_utility(GOOD, [[1.0]]), "weights has 1 objectives; the front has 2"),
        (lambda: indicators(GOOD, reference_point=[0]), "reference point = [0] must be 2 finite numbers"),
        (lambda: farthest_point_subset([*GOOD, [0.0, 0.0]], 2, [0.0, 1.0]), "scales = [0.0, 1.0] must be positive"),
        (lambda: evenly_spaced_weights(3, 2), "n = 2 weights for d = 3 objectives: n must be at least d"),
    ],
)
def test_invalid_arguments_are_refused_by_name(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


# Weights.


@pytest.mark.parametrize(("d", "n"), [*product([1, 2, 3, 6], [6, 7, 50]), (160, 160)])
def test_weights_sum_to_one_and_include_the_corners(d: int, n: int) -> None:
    weights = evenly_spaced_weights(d, n)
    assert weights.shape == (n, d)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    assert (weights >= 0.0).all()
    assert {tuple(corner) for corner in np.eye(d)} <= {tuple(row) for row in weights.tolist()}
    np.testing.assert_array_equal(weights, evenly_spaced_weights(d, n))
    if d > 1:
        assert len(np.unique(weights, axis=0)) == n


# Crowding and farthest-point subsets.


@given(grids(d=(1, 3), n=9))
def test_crowding_distances_are_those_of_a_plain_loop(points: np.ndarray) -> None:
    n, d = points.shape
    expected = [0.0] * n
    for i in range(d):
        order = sorted(range(n), key=lambda k: (points[k, i], k))
        extent = points[order[-1], i] - points[order[0], i]
        for place, k in enumerate(order):
            if extent == 0.0:
                continue
            if place in (0, n - 1):
                expected[k] += 1.0 / d
            else:
                expected[k] += (points[order[place + 1], i] - points[order[place - 1], i]) / extent / d
    np.testing.assert_allclose(crowding_distances(points), expected, atol=1e-12)


@given(grids(d=(1, 3), n=12), st.integers(1, 12))
def test_spread_takes_the_extremes_and_then_what_is_farthest_from_those_before(points: np.ndarray, count: int) -> None:
    scales = SCALES[: points.shape[1]]
    chosen = farthest_point_subset(points, count, scales).tolist()
    if len(points) <= count:
        assert chosen == list(range(len(points)))
        return
    assert len(chosen) == len(set(chosen)) == count
    extremes = []
    for i in range(points.shape[1]):
        best = points[:, i].tolist().index(points[:, i].max())
        if best not in extremes:
            extremes.append(best)
    assert chosen[: len(extremes)] == extremes[:count]
    scaled = points / scales
    for k in range(len(extremes), count):
        distances = [min(float(np.linalg.norm(point - scaled[before])) for before in chosen[:k]) for point in scaled]
        assert distances[chosen[k]] == pytest.approx(max(d for i, d in enumerate(distances) if i not in chosen[:k]))
