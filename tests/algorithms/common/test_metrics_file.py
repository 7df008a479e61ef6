"""metrics.csv: rows are appended, torn rows dropped, and a resumed run writes later rows again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from algorithms.common.metrics_file import MetricsFile, read_metrics

if TYPE_CHECKING:
    from pathlib import Path


def test_metrics_are_read_back_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    file = MetricsFile(path)
    file.write(0, {"a": 1 / 3})
    file.write(10, {"a": 2, "b/c": np.float32(0.1)})
    file.write(10, {"b/c": float("nan")})
    columns = read_metrics(path)
    np.testing.assert_array_equal(columns["step"], [0, 10, 10])
    np.testing.assert_array_equal(columns["a"], [1 / 3, 2, np.nan])
    np.testing.assert_array_equal(columns["b/c"], [np.nan, np.float32(0.1), np.nan])


def test_metrics_are_continued_after_a_step(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    file = MetricsFile(path)
    for step in (0, 10, 20):
        file.write(step, {"a": step})
    MetricsFile(path, after=10).write(20, {"a": -20, "b": 1})
    np.testing.assert_array_equal(read_metrics(path)["a"], [0, 10, -20])
    MetricsFile(path)
    assert path.read_text() == "step\n"


def test_a_torn_last_row_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("step,a,b\n0,1.0,2.0\n10,1.0,2.")
    np.testing.assert_array_equal(read_metrics(path)["step"], [0])


@pytest.mark.parametrize(("text", "message"), [("a,b\n1,2\n", "no column 'step'"), ("step,a\n0,x\n", "is broken")])
def test_files_that_hold_no_metrics_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "metrics.csv"
    with pytest.raises(ValueError, match="does not exist"):
        read_metrics(path)
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_metrics(path)
