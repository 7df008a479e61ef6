"""Scores against keys: what is binned, which axes are logarithmic, which runs are off the axis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from algorithms.reporting import curves
from algorithms.reporting.curves import (
    VariedScores,
    effect_of_numbers,
    effect_of_words,
    is_logarithmic,
    plot_effects,
    score_limits,
)
from algorithms.reporting.style import ALGORITHM_COLOURS


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([1e-4, 1e-3, 1e-2], True),
        ([16, 32, 64], True),
        ([0.001, 0.003], False),
        ([1, 2, 3], False),
        ([0.9, 0.95, 0.99], False),
        ([0, 10, 1000], False),
        (np.linspace(0.1, 1.0, 50), False),
        (np.geomspace(0.1, 10.0, 50), True),
    ],
)
def test_numbers_that_grow_by_factors_are_on_logarithmic_axes(numbers: Any, expected: bool) -> None:
    assert is_logarithmic(np.asarray(numbers, dtype=np.float64)) is expected


def test_every_value_has_a_mean_and_many_values_are_binned() -> None:
    scores = np.arange(60.0)
    few = effect_of_numbers(np.repeat([8.0, 16.0, 32.0], 20), scores)
    assert [each.value for each in few.means] == [9.5, 29.5, 49.5]
    assert [*few.ticks.values()] == ["8", "16", "32"]
    many = effect_of_numbers(np.linspace(0.9, 1.0, 60), scores)
    assert many.ticks is None
    assert [len(part) for part in many.parts] == [8, 8, 8, 8, 7, 7, 7, 7]
    words = effect_of_words(["b", "a", "b"] * 20, scores)
    assert list(words.ticks.values()) == ["b", "a"]
    assert not words.slanted
    assert effect_of_words([f"a rather long word {i}" for i in range(60)], scores).slanted


def test_a_few_outliers_do_not_flatten_the_other_runs() -> None:
    words = ["a"] * 50 + ["b"] * 50
    scores = np.linspace(0.0, 1.0, 100)
    whole = score_limits(scores, [effect_of_words(words, scores)])
    assert whole == pytest.approx((-0.06, 1.06))
    scores[-1] = -1e6
    effect = effect_of_words(words, scores)
    assert effect.means[1].value < -1e4
    low, high = score_limits(scores, [effect])
    assert -0.5 < low < 0.0
    assert 0.9 < high < 1.5
    scores[-20:] = -1e6  # no longer a few
    assert score_limits(scores, [effect_of_words(words, scores)])[0] < -1e6
    mostly_equal = np.array([1.0] * 99 + [0.0])
    low, high = score_limits(mostly_equal, [effect := effect_of_words(words, mostly_equal)])
    assert low < effect.means[1].value < 1.0 < high


def test_scores_are_drawn_against_what_was_varied(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rates, names = 10.0 ** rng.uniform(-4, -2, 40), ["one", "another, rather long", "a third, even longer"] * 20
    keys: dict[str, Any] = {"rate": rates, "name": names[:40], "steps": np.repeat([8.0, 16.0], 20)}
    first = VariedScores(
        "environment, utility [1]", "greedy utility", rng.normal(size=40), ("a2c", "mo_a2c") * 20, keys
    )
    second = VariedScores(
        "another",
        "$hypervolume_",
        np.full(40, 3.0),
        ("pcn",) * 40,
        {f"{key}_{i}": keys[key] for key in keys for i in "ab"},
    )
    plot_effects([first, second], tmp_path / "scores.png", "title", "a remark")
    assert (tmp_path / "scores.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="xyz"):
        plot_effects([first], tmp_path / "scores.xyz", "title")


def test_runs_have_the_colours_of_their_algorithms() -> None:
    axis = Figure().subplots()
    scores = np.array([1.0, 2.0, 3.0, 4.0])
    colours = [ALGORITHM_COLOURS[name] for name in ("a2c", "mo_a2c", "mo_a2c", "a2c")]
    curves._draw_effect(axis, effect_of_words(["x", "x", "y", "y"], scores), scores, colours, (0.0, 5.0))
    dots = axis.collections[0]
    assert [to_hex(colour).upper() for colour in dots.get_facecolors()] == colours


def test_means_of_two_runs_have_no_interval_and_scores_are_not_magnified() -> None:
    scores = np.array([10.0, 10.001, 10.002, 10.003, 10.0])
    effect = effect_of_words(["x", "x", "y", "y", "y"], scores)
    assert [mean.low is None for mean in effect.means] == [True, False]
    low, high = score_limits(scores, [effect])
    assert high - low >= 1.0
