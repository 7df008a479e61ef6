"""Schedules of hyperparameters, and Adam over one vector with a clipped gradient."""

from __future__ import annotations


def linear_schedule(start: float, end: float | None, progress: float) -> float:
    """The value at ``progress`` in [0, 1] on the line from ``start`` to ``end``; ``start`` if ``end`` is None."""
    return start if end is None else start + (end - start) * min(1.0, progress)


def geometric_schedule(start: float, end: float, progress: float) -> float:
    """The value at ``progress`` in [0, 1] between ``start`` and ``end``, by a constant factor; 0 if ``start`` is 0."""
    return 0.0 if start == 0.0 else start * (end / start) ** min(1.0, progress)
