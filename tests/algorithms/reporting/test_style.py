"""Colours of algorithms and of groups of runs."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from algorithms import ALGORITHMS
from algorithms.reporting.style import (
    ALGORITHM_COLOURS,
    OTHER_COLOURS,
    algorithm_colour,
    algorithm_order,
    group_colours,
    limits_of_min_span,
)

# Linear RGB as people without green or without red receptors see it (Machado et al. 2009, severity 1).
COLOUR_BLINDNESS = {
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "none": np.eye(3),
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(colour: str, seen: object) -> np.ndarray:
    """CIE L*a*b* of a colour as it is seen; 2.3 is a just noticeable difference."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(TO_XYZ @ np.clip(np.asarray(seen) @ linear, 1e-6, 1.0) / TO_XYZ.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def test_every_algorithm_has_its_own_colour_and_place() -> None:
    assert set(ALGORITHM_COLOURS) == set(ALGORITHMS)
    assert not set(OTHER_COLOURS) & set(ALGORITHM_COLOURS.values())
    names = ["stable_baselines3.a2c", "pcn", "mo_ppo", "my.module:Mine", "ppo", "a2c", "mo_a2c"]
    assert sorted(names, key=algorithm_order) == [
        *("a2c", "mo_a2c", "ppo", "mo_ppo", "pcn"),
        *("my.module:Mine", "stable_baselines3.a2c"),
    ]


@pytest.mark.parametrize("sight", COLOUR_BLINDNESS)
def test_colour_blind_readers_can_tell_algorithms_apart(sight: str) -> None:
    seen = [lab(colour, COLOUR_BLINDNESS[sight]) for colour in ALGORITHM_COLOURS.values()]
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 12


def test_an_algorithm_has_the_same_colour_whatever_else_a_figure_shows() -> None:
    orange, blue = ALGORITHM_COLOURS["a2c"], ALGORITHM_COLOURS["mo_a2c"]
    assert group_colours(["a2c", "mo_a2c"]) == [orange, blue]
    assert group_colours(["mo_a2c", "pcn", "a2c"])[::2] == [blue, orange]
    assert group_colours(["mo_a2c"]) == [blue]
    own = algorithm_colour("my.module:Mine")
    assert own in OTHER_COLOURS
    assert group_colours(["ppo", "my.module:Mine"]) == [ALGORITHM_COLOURS["ppo"], own]


def test_groups_of_one_algorithm_have_different_colours_that_are_no_other_algorithm_s() -> None:
    colours = group_colours(["a2c"] * 4 + ["mo_a2c"] * 4)
    assert len(set(colours)) == 8
    assert (colours[0], colours[4]) == (ALGORITHM_COLOURS["a2c"], ALGORITHM_COLOURS["mo_a2c"])
    assert set(colours[1:4] + colours[5:]) <= set(OTHER_COLOURS)
    assert len(group_colours(["a2c"] * 40)) == 40


def test_algorithms_whose_colours_coincide_differ_within_a_figure() -> None:
    first = "peer_0"
    second = next(name for k in range(1, 99) if algorithm_colour(name := f"peer_{k}") == algorithm_colour(first))
    assert len(set(group_colours([first, second]))) == 2


def test_axes_do_not_zoom_into_noise() -> None:
    assert limits_of_min_span(0.998, 1.0) == pytest.approx((0.949, 1.049))
    assert limits_of_min_span(-1.3e-3, 0.0, scale=10.0) == pytest.approx((-0.50065, 0.49935))
    assert limits_of_min_span(0.0, 10.0, scale=10.0) == (0.0, 10.0)
    assert limits_of_min_span(0.0, 0.0) == (0.0, 0.0)
