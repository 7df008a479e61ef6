"""Matrix products in compiled code against NumPy's."""

from __future__ import annotations

import subprocess
import sys

import numba
import numpy as np
import pytest
from algorithms.networks.compiled import products
from numpy.typing import NDArray

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")

SIZES = [(1, 1, 1), (1, 7, 1), (5, 1, 3), (1, 4, 6), (6, 4, 1), (22, 64, 256), (64, 300, 31)]
LAYOUTS = [
    ("rows", "rows"),
    ("rows", "columns"),
    ("columns", "rows"),
    ("some rows", "some columns"),
    ("some columns", "some rows"),
]


def laid_out(shape: tuple[int, int], layout: str, rng: np.random.Generator) -> NDArray[np.float32]:
    """A matrix whose rows or columns are contiguous, the whole or a part of a larger one."""
    rows, columns = shape if layout.endswith("rows") else shape[::-1]
    extra = 3 if layout.startswith("some") else 0
    values = rng.standard_normal((rows, columns + extra)).astype(np.float32)[:, :columns]
    return values if layout.endswith("rows") else values.T


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("a_layout", "b_layout"), LAYOUTS)
def test_products_are_numpys(size: tuple[int, int, int], a_layout: str, b_layout: str) -> None:
    rng = np.random.default_rng(0)
    m, k, n = size
    a, b = laid_out((m, k), a_layout, rng), laid_out((k, n), b_layout, rng)
    out = laid_out((m, n), "some rows", rng)
    products.product(a, b, out)
    np.testing.assert_allclose(out, a.astype(np.float64) @ b.astype(np.float64), rtol=1e-5, atol=1e-5)


def test_what_is_beside_the_result_is_left() -> None:
    whole = np.full((4, 9), 7.0, np.float32)
    ones = np.ones((4, 4), np.float32)
    products.product(ones, ones, whole[:, 2:6])
    assert (whole[:, 2:6] == 4.0).all()
    assert (whole[:, :2] == 7.0).all()
    assert (whole[:, 6:] == 7.0).all()


def test_without_numpys_library_numbas_products_are_used() -> None:
    program = """
from threadpoolctl import ThreadpoolController
ThreadpoolController.select = lambda self, **_: type("None", (), {"lib_controllers": []})()
import numpy as np
from algorithms.networks.compiled import products
assert products.numpys_function() is None
out = np.empty((2, 4), np.float32)
products.product(np.ones((2, 3), np.float32), np.ones((3, 4), np.float32), out)
assert (out == 3.0).all(), out
"""
    subprocess.run([sys.executable, "-c", program], check=True)
