"""Values that users give: NumPy's numbers and arrays count as Python's, and whether something is a finite number."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

T = TypeVar("T")


def plain(value: Any) -> Any:
    """``value`` with Python's numbers, strings and lists for NumPy's, also within lists, tuples and dicts."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.longdouble):
        return float(value)
    if isinstance(value, np.generic):
        return value.item()
    if type(value) in (list, tuple):
        return type(value)(map(plain, value))
    if type(value) is dict:
        return {plain(key): plain(entry) for key, entry in value.items()}
    return value


def with_plain_fields(row: T) -> T:
    """The dataclass ``row`` with :func:`plain` fields."""
    changes = {field.name: plain(getattr(row, field.name)) for field in dataclasses.fields(row)}  # type: ignore[arg-type]
    return dataclasses.replace(row, **changes)  # type: ignore[type-var]


def finite_numbers(value: Any) -> NDArray[np.float64] | None:
    """A number, or nested sequences or an array of them, as an array; None if anything else is in it.

    Truth values and strings are not numbers here; nor is what is not finite as a float64.
    """
    try:
        array = np.asarray(value, dtype=object)
        if any(isinstance(each, bool) or not isinstance(each, (int, float)) for each in map(plain, array.flat)):
            return None
        numbers = array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers if np.isfinite(numbers).all() else None


def is_finite(value: Any) -> bool:
    """Whether ``value`` is a finite number."""
    numbers = finite_numbers(value)
    return numbers is not None and numbers.ndim == 0


def whole_number(name: str, value: Any, low: int, high: float = np.inf, allowed: str = "") -> int:
    """``value`` as an integer from ``low`` to ``high``, or a ValueError that names it and what is allowed."""
    number = plain(value)
    if isinstance(number, bool) or not isinstance(number, int) or not low <= number <= high:
        raise ValueError(f"{name} = {value!r} must be {allowed}")
    return number
