"""What ends a run: numbers that are not finite, and episodes without an end."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


# Magnitude of a reward or an observation: sums of the squares of larger ones, as in errors and deviations, may be
# infinite in single precision.
LARGEST = 1e15


class Fault(ValueError):
    """What an environment, a utility or a learner produced cannot be used; the message, one line, says where."""


class NotFinite(Fault):
    """A number is NaN or infinite, or so large that what is computed from it in single precision would be."""


class EndlessEpisode(Fault):
    """An episode of another library's environment has no end."""


def check_numbers(numbers: Mapping[str, Any]) -> None:
    """Refuse numbers, by name, of which one is not finite."""
    for name, value in numbers.items():
        if not math.isfinite(float(value)):
            raise NotFinite(f"{name} = {float(value)}; it must be finite")


def check_vehicles(what: str, values: Any, env: str, names: Sequence[str] = ()) -> None:
    """Refuse ``values`` (..., N, V, k) of the vehicles of N environments that are not finite or beyond LARGEST.

    NotFinite names the environment, the vehicle and the component, by ``names`` where they are known.
    """
    fine = np.abs(values) <= LARGEST
    if not fine.all():
        *_, n, v, k = np.argwhere(~fine)[0].tolist()
        vehicle = f", vehicle {v}" if values.shape[-2] > 1 else ""
        component = repr(names[k]) if names else f"component {k}"
        raise NotFinite(
            f"{env}, environment {n}{vehicle}: {what} {component} = {values[~fine][0]:g}; it must be a number between "
            f"{-LARGEST:g} and {LARGEST:g}"
        )
