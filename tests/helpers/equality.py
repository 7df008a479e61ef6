"""What environments return, compared deeply."""

from __future__ import annotations

from typing import Any

import numpy as np


def assert_equal(first: Any, second: Any, what: str = "") -> None:
    """Deep equality, arrays bit for bit."""
    assert type(first) is type(second), what
    if hasattr(first, "numpy"):  # a tensor
        first, second = first.numpy(), second.numpy()
    if isinstance(first, np.ndarray):
        assert (first.dtype, first.shape) == (second.dtype, second.shape), what
        assert first.tolist() == second.tolist() if first.dtype == object else first.tobytes() == second.tobytes(), what
    elif isinstance(first, (tuple, list)):
        assert len(first) == len(second), what
        for k, (one, two) in enumerate(zip(first, second, strict=True)):
            assert_equal(one, two, f"{what}[{k}]")
    elif isinstance(first, dict):
        assert first.keys() == second.keys(), what
        for name in first:
            assert_equal(first[name], second[name], f"{what}.{name}")
    else:
        assert first == second, what
