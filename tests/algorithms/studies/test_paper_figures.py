"""The figures of learning curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from algorithms.studies.paper_figures import CURVE_FIGURES, draw_curves
from algorithms.studies.paper_plan import load_plan
from algorithms.studies.paper_results import ReproductionResults
from tests.helpers.reproduction import PLAN, evenly_spread, make_results


def test_a_figure_shows_every_seed_in_the_colours_of_both_algorithms(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    scores = {"a2c": {"utility_esr": evenly_spread(5.0, 1.0)}, "mo_a2c": {"utility_esr": evenly_spread(9.0, 1.0)}}
    parts = [make_results(task, scores) for task in CURVE_FIGURES[4].tasks]
    results = ReproductionResults(
        [row for part in parts for row in part.scores], [row for part in parts for row in part.curves]
    )
    assert draw_curves(4, plan, results, tmp_path / "figure.png")
    pixels = np.asarray(Image.open(tmp_path / "figure.png").convert("RGB")).reshape(-1, 3)
    for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):
        assert (np.abs(pixels.astype(int) - colour).max(axis=1) < 8).sum() > 500
    assert not draw_curves(5, plan, results, tmp_path / "nothing.png")
    assert not (tmp_path / "nothing.png").exists()
