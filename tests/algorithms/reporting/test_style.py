"""The colours that all figures share."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from algorithms import ALGORITHMS
from algorithms.reporting.style import (
    ALGORITHM_COLOURS,
    OTHER_COLOURS,
    algorithm_colours,
    figure_style,
    save_figure,
)


def test_every_algorithm_has_one_colour_that_no_other_has() -> None:
    assert set(ALGORITHM_COLOURS) == set(ALGORITHMS)
    colours = [*ALGORITHM_COLOURS.values(), *OTHER_COLOURS]
    assert len(set(colours)) == len(colours)
    together = algorithm_colours(["mo_a2c", "my.package:Algorithm", "a2c"])
    for name in together:
        assert algorithm_colours([name]) == {name: together[name]}, "whatever else a figure shows"


def test_figures_do_not_depend_on_a_users_settings(tmp_path: Path) -> None:
    written = []
    for settings in ({}, {"lines.linewidth": 9.0, "savefig.bbox": "tight", "text.usetex": True, "axes.titlesize": 30}):
        with matplotlib.rc_context(settings), figure_style():
            figure = Figure()
            figure.subplots().plot([0, 1])
            save_figure(figure, tmp_path / "figure.png")
        written.append((tmp_path / "figure.png").read_bytes())
    assert written[0] == written[1]
