"""metrics.csv: rows are appended, torn rows dropped, and a resumed run writes later rows again."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from algorithms.reporting.training_log import MetricsFile, read_metrics


def test_metrics_are_read_back_to_the_last_bit_but_for_a_torn_row(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    file = MetricsFile(path)
    file.write(0, {"a": 1 / 3})
    file.write(10, {"a": 2, "b/c": np.float32(0.1)})
    file.write(10, {"b/c": float("nan")})
    with path.open("a") as torn:
        torn.write("20,1.0,2.")
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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a,b\n1,2\n", "its columns must be 'step', then different metrics"),
        (b"step,a,a\n0,1,2\n", "its columns must be 'step', then different metrics"),
        (b"step,a\n0,\x80\n", "'utf-8' codec"),
        (b"step,a\n0,x\n", "could not parse `x` as dtype `f64` at column 'a'"),
        (b"step,a\n1.5,1\n", "could not parse `1.5` as dtype `i64` at column 'step'"),
        (b"step,a\n,1\n", "a row has no step"),
    ],
)
def test_a_damaged_file_is_neither_read_nor_continued(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(content)
    whole = re.escape(f"metrics file '{path}' cannot be read: {message}")
    with pytest.raises(ValueError, match=f"^{whole}"):
        read_metrics(path)
    with pytest.raises(ValueError, match=f"^{whole}.*; repair it, or delete it to resume without its rows$"):
        MetricsFile(path, after=10)
    assert path.read_bytes() == content
