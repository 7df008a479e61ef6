"""The figures of learning curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.reporting.style import ALGORITHM_COLOURS
from algorithms.reproduction.figures import CURVE_FIGURES, draw_curves
from algorithms.reproduction.plan import load_plan
from algorithms.reproduction.results import ReproductionResults
from tests.helpers.figures import curves, legend, saved_figures
from tests.helpers.reproduction import PLAN, evenly_spread, make_results

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def test_a_figure_shows_every_seed_in_the_colours_of_both_algorithms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = load_plan(PLAN)
    scores = {"a2c": {"utility_esr": evenly_spread(5.0, 1.0)}, "mo_a2c": {"utility_esr": evenly_spread(9.0, 1.0)}}
    parts = [make_results(task, scores) for task in CURVE_FIGURES[4].tasks]
    results = ReproductionResults(
        [row for part in parts for row in part.scores], [row for part in parts for row in part.curves]
    )
    assert draw_curves(4, plan, results, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    found = saved_figures(monkeypatch)
    assert draw_curves(4, plan, results, tmp_path / "figure.png")
    orange, blue = ALGORITHM_COLOURS["a2c"], ALGORITHM_COLOURS["mo_a2c"]
    assert legend(found[0]) == {"A2C": orange, "MO-A2C": blue}
    for axis in found[0].axes:
        colours = [colour for colour, _ in curves(axis)]
        assert colours.count(orange) == colours.count(blue) == len(colours) / 2 > 2
    assert not draw_curves(5, plan, results, tmp_path / "nothing.png")
    assert not (tmp_path / "nothing.png").exists()


def test_curves_that_differ_in_the_third_digit_are_not_magnified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = {name: {"utility_esr": evenly_spread(9.25, 0.02)} for name in ("a2c", "mo_a2c")}
    parts = [make_results(task, scores) for task in CURVE_FIGURES[4].tasks]
    results = ReproductionResults(
        [row for part in parts for row in part.scores], [row for part in parts for row in part.curves]
    )
    found = saved_figures(monkeypatch)
    assert draw_curves(4, load_plan(PLAN), results, tmp_path / "figure.png")
    for axis in found[0].axes:
        low, high = axis.get_ylim()
        assert high - low > 0.9
        assert low < 9.2 < 9.3 < high
