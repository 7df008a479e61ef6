"""Matrix products in compiled code, by NumPy's BLAS.

Numba's own products are SciPy's BLAS. NumPy's wheels have a newer OpenBLAS, which is up to 1.5 times as fast where few
rows and columns come from many products: in the gradients of layers. Where there is no such library, Numba's products
take its place.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import llvmlite.binding
import numba
import numpy as np
from numba import types

from algorithms.networks.threads import blas_libraries
from mo_deepdrive.simulation.jit import jit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float32]

FUNCTION = "scipy_cblas_sgemm64_"  # as NumPy's wheels call it
NAME = "mo_deepdrive_sgemm"  # as compiled code calls it
ROW_MAJOR, AS_IT_IS, TRANSPOSED = 101, 111, 112  # of CBLAS
ITEM = 4  # bytes of a float32

_int, _long, _float, _pointer = types.int32, types.int64, types.float32, types.CPointer(types.float32)  # type: ignore[no-untyped-call]
SIGNATURE = types.void(
    _int, _int, _int, _long, _long, _long, _float, _pointer, _long, _pointer, _long, _float, _pointer, _long
)  # fmt: skip


def numpys_function() -> int | None:
    """Address of ``cblas_sgemm`` in the OpenBLAS of NumPy's wheel; None without one."""
    for library in blas_libraries:
        found = getattr(library.dynlib, FUNCTION, None)
        if found is not None:
            return ctypes.cast(found, ctypes.c_void_p).value
    return None


def numbas_function() -> Any:
    """The same with Numba's products, where alpha is 1, and beta 0 or 1."""
    array: Any = numba.carray  # type: ignore[attr-defined]  # Numba has no types

    def multiply(
        _order: int, transpose_a: int, transpose_b: int, m: int, n: int, k: int, _alpha: float,
        a: Any, lda: int, b: Any, ldb: int, beta: float, out: Any, ldout: int,
    ) -> None:  # fmt: skip
        if transpose_a == TRANSPOSED:
            left = np.ascontiguousarray(array(a, (k, lda))[:, :m].T)
        else:
            left = np.ascontiguousarray(array(a, (m, lda))[:, :k])
        if transpose_b == TRANSPOSED:
            right = np.ascontiguousarray(array(b, (n, ldb))[:, :k].T)
        else:
            right = np.ascontiguousarray(array(b, (k, ldb))[:, :n])
        result = array(out, (m, ldout))[:, :n]
        if beta == 0.0:
            result[:] = 0.0  # whatever it was
        result += np.dot(left, right)

    return numba.cfunc(SIGNATURE)(multiply)


def _register() -> Any:
    """Let compiled code, which may come from another process's cache, find the function by its name."""
    address, kept = numpys_function(), None
    if address is None:
        kept = numbas_function()
        address = kept.address
    llvmlite.binding.add_symbol(NAME, address)
    return kept


_kept = _register()  # keeps the code alive
_multiply: Any = types.ExternalFunction(NAME, SIGNATURE)


@jit
def _sgemm(a: Array, b: Array, beta: np.float32, out: Array) -> None:
    (m, k), n = a.shape, b.shape[1]
    # A matrix of which the columns are contiguous is the transpose of one of which the rows are.
    columns_a, columns_b = a.strides[1] != ITEM, b.strides[1] != ITEM
    _multiply(
        ROW_MAJOR,
        TRANSPOSED if columns_a else AS_IT_IS,
        TRANSPOSED if columns_b else AS_IT_IS,
        m,
        n,
        k,
        np.float32(1.0),
        a.ctypes,
        max(a.strides[1] // ITEM, m) if columns_a else max(a.strides[0] // ITEM, k),
        b.ctypes,
        max(b.strides[1] // ITEM, k) if columns_b else max(b.strides[0] // ITEM, n),
        beta,
        out.ctypes,
        max(out.strides[0] // ITEM, n),
    )


@jit
def product(a: Array, b: Array, out: Array) -> None:
    """Write a b; rows or columns of ``a`` and of ``b``, and rows of ``out``, are contiguous.

    Args:
        a: (m, k).
        b: (k, n).
        out: (m, n), written.
    """
    _sgemm(a, b, np.float32(0.0), out)


@jit
def add_product(a: Array, b: Array, out: Array) -> None:
    """As :func:`product`, but add a b to ``out``."""
    _sgemm(a, b, np.float32(1.0), out)
