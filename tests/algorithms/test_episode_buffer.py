"""PCN's episode buffer against a plain computation of its rule."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from algorithms.pcn import Episode, EpisodeBuffer
from mo_deepdrive.evaluation.pareto import crowding_distances, non_dominated

SCALES = np.array([2.0, 5.0], dtype=np.float32)


def make_episode(returns: Any, length: int = 1, name: int = 0, continuous: bool = False) -> Episode:
    """``length`` decisions, of which the first has ``returns``; observations tell the episode and the decision."""
    t = np.arange(length, dtype=np.float32)
    to_go = np.asarray(returns, dtype=np.float32) - t[:, None]
    actions = np.stack([t, t - name], axis=1) if continuous else 1000 * name + t.astype(np.int64)
    return Episode(np.stack([np.full(length, name, dtype=np.float32), t], axis=1), actions, to_go)


def make_store(points: Any, capacity: int = 1000, crowding: float = 0.2) -> EpisodeBuffer:
    buffer = EpisodeBuffer(capacity, SCALES, crowding)
    buffer.add([make_episode(point, name=i) for i, point in enumerate(points)])
    return buffer


def names(buffer: EpisodeBuffer) -> list[int]:
    return [int(episode.observations[0, 0]) for episode in buffer.episodes]


points_on_a_grid = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=14)


# Returns.


# Who stays.


@given(points_on_a_grid, st.sampled_from([0.0, 0.2, 0.5, 2.0]))
def test_scores_follow_the_documented_rule(points: list[tuple[int, int]], crowding: float) -> None:
    buffer = make_store(points, crowding=crowding)
    scaled = [(x / 2.0, y / 5.0) for x, y in points]
    best = [p for p in scaled if not any(q != p and q[0] >= p[0] and q[1] >= p[1] for q in scaled)]
    crowded = crowding_distances(np.array(scaled)) <= crowding
    expected = []
    for i, (x, y) in enumerate(scaled):
        distance = min(((x - u) ** 2 + (y - w) ** 2) ** 0.5 for u, w in best)
        if (x, y) in scaled[:i]:
            distance += 1e-5
        expected.append(-(2.0 if crowded[i] else 1.0) * distance)
    np.testing.assert_allclose(buffer.scores(), expected, atol=1e-12)


@given(points_on_a_grid, st.integers(2, 14), st.sampled_from([0.0, 0.2]))
def test_the_best_scores_stay_where_the_front_fits(
    points: list[tuple[int, int]], capacity: int, crowding: float
) -> None:
    whole = make_store(points, crowding=crowding)
    buffer = make_store(points, capacity, crowding)
    assert len(buffer) == min(capacity, len(points))
    if len(points) > capacity > len(whole.best()):
        scores = whole.scores()
        best = sorted(range(len(points)), key=lambda i: (-scores[i], i))[:capacity]
        assert sorted(names(buffer)) == sorted(best)


@given(st.lists(points_on_a_grid, min_size=1, max_size=5))
def test_no_non_dominated_return_is_ever_lost_where_the_front_fits(rounds: list[list[tuple[int, int]]]) -> None:
    # On a grid of 7 by 7 at most 7 returns do not dominate one another.
    buffer, seen = EpisodeBuffer(8, SCALES, 0.2), []
    for points in rounds:
        buffer.add([make_episode(point) for point in points])
        seen += points
        everything = np.array(seen, dtype=np.float64)
        front = {tuple(point) for point in everything[non_dominated(everything)].tolist()}
        assert {tuple(point) for point in buffer.returns[buffer.best()].tolist()} == front
        assert len(buffer) == min(8, len(seen))


@given(st.integers(3, 40), st.integers(2, 10), st.integers(0, 2**32 - 1))
def test_the_extremes_are_kept_where_the_front_does_not_fit(n: int, capacity: int, seed: int) -> None:
    x = np.sort(np.random.default_rng(seed).random(n)).astype(np.float32)
    points = np.stack([x, -x], axis=1)
    buffer = make_store(points, capacity)
    assert len(buffer) == min(n, capacity)
    assert buffer.returns[:, 0].min() == x[0]
    assert buffer.returns[:, 0].max() == x[-1]
    assert len(set(names(buffer))) == len(buffer)


def test_bounds_cover_every_time_step_and_follow_additions_and_removals() -> None:
    buffer = EpisodeBuffer(2, SCALES, 0.2)
    buffer.add([make_episode([5.0, 0.0], 4), make_episode([0.0, 5.0], 2)])
    low, high = buffer.bounds()
    np.testing.assert_array_equal(low, [-1.0, -3.0])
    np.testing.assert_array_equal(high, [5.0, 5.0])
    buffer.add([make_episode([6.0, 7.0], 1), make_episode([7.0, 6.0], 1)])
    low, high = buffer.bounds()
    np.testing.assert_array_equal(low, [6.0, 6.0])
    np.testing.assert_array_equal(high, [7.0, 7.0])


# Batches.

LENGTHS = (1, 5, 50)


@pytest.mark.parametrize("continuous", [False, True])
def test_the_columns_of_a_sampled_time_step_belong_together(continuous: bool) -> None:
    buffer = EpisodeBuffer(9, SCALES, 0.2)
    ends = [[9.0, 1.0], [1.0, 9.0], [5.0, 5.0]]
    buffer.add([make_episode(ends[i], n, i, continuous) for i, n in enumerate(LENGTHS)])
    observations, actions, returns, left = buffer.sample(500, torch.Generator().manual_seed(0))
    assert (observations.dtype, returns.dtype, left.dtype) == (np.float32,) * 3
    for row, action, to_go, remaining in zip(observations, actions, returns, left, strict=True):
        name, t = row.astype(int).tolist()
        assert remaining == LENGTHS[name] - t
        np.testing.assert_array_equal(to_go, np.array(ends[name]) - t)
        np.testing.assert_array_equal(action, [t, t - name] if continuous else 1000 * name + t)


def test_episodes_and_their_time_steps_are_sampled_uniformly() -> None:
    buffer = EpisodeBuffer(9, SCALES, 0.2)
    buffer.add([make_episode([i, -i], n, i) for i, n in enumerate(LENGTHS)])
    count = 30_000
    observations, *_ = buffer.sample(count, torch.Generator().manual_seed(1))
    drawn = Counter(tuple(row) for row in observations.astype(int).tolist())
    for name, length in enumerate(LENGTHS):
        for t in range(length):
            p = 1.0 / (len(LENGTHS) * length)
            assert drawn[name, t] == pytest.approx(count * p, abs=4.5 * (count * p * (1.0 - p)) ** 0.5)


# Checkpoints.


@pytest.mark.parametrize("continuous", [False, True])
def test_a_buffer_resumes_exactly(continuous: bool) -> None:
    buffer = EpisodeBuffer(4, SCALES, 0.2)
    rng = np.random.default_rng(0)

    def more(first: int) -> list[Episode]:
        return [make_episode(rng.normal(size=2), int(rng.integers(1, 9)), first + i, continuous) for i in range(6)]

    buffer.add(more(0))
    state = {name: tensor.clone() for name, tensor in buffer.get_state().items()}
    again = EpisodeBuffer(4, SCALES, 0.2)
    again.add(more(100))  # what was there before is forgotten
    again.set_state(state)
    new = more(200)
    for each in (buffer, again):
        each.add(new)
    assert names(again) == names(buffer)
    for mine, theirs in zip(buffer.episodes, again.episodes, strict=True):
        for name in ("observations", "actions", "returns"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
            assert getattr(mine, name).dtype == getattr(theirs, name).dtype
    samples = [each.sample(30, torch.Generator().manual_seed(0)) for each in (buffer, again)]
    for a, b in zip(*samples, strict=True):
        np.testing.assert_array_equal(a, b)
