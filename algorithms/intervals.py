"""Confidence intervals of 95%: bootstrap for means and utilities, exact for rates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

RESAMPLES = 2000
LEVEL = 0.95


@dataclass(frozen=True)
class Estimate:
    """A value and its interval; ``low`` and ``high`` are None where the sample gives none."""

    value: float
    low: float | None = None
    high: float | None = None

    def text(self) -> str:
        """``1.23 [1.20, 1.26]``, to two significant digits of the interval's width; the value where it has none."""
        if self.low is None or self.high is None:
            return f"{self.value:.4g}"
        width = self.high - self.low
        if width <= 0.0:
            return f"{self.value:.4g}"
        decimals = int(np.clip(1 - np.floor(np.log10(width)), 0, 4))
        return f"{self.value:.{decimals}f} [{self.low:.{decimals}f}, {self.high:.{decimals}f}]"


def bootstrap(samples: ArrayLike, statistic: Callable[..., Any] = np.mean) -> tuple[NDArray[Any], NDArray[Any]]:
    """Percentile bootstrap over the first axis (scipy.stats.bootstrap), always with the same resamples.

    Args:
        samples: (n, ...).
        statistic: ``statistic(samples, axis=...)``.

    Returns:
        Lower and upper ends, each (...); NaN where n is 1.
    """
    samples = np.asarray(samples, dtype=np.float64)
    if len(samples) < 2:
        nothing = np.full(samples.shape[1:], np.nan)
        return nothing, nothing.copy()
    interval = stats.bootstrap(
        (samples,),
        statistic,
        axis=0,
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=max(1, 2_000_000 // samples.size),
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return np.asarray(interval.low), np.asarray(interval.high)


def mean(samples: NDArray[Any]) -> Estimate:
    """The mean of ``samples`` (n,)."""
    return estimate(samples, np.mean)


def estimate(samples: NDArray[Any], statistic: Callable[..., Any]) -> Estimate:
    """A scalar statistic of ``samples`` (n,)."""
    low, high = bootstrap(samples, statistic)
    value = float(statistic(samples, axis=0))
    return Estimate(value) if np.isnan(low) else Estimate(value, float(low), float(high))


def rate(events: NDArray[np.bool_]) -> Estimate:
    """The share of True in ``events`` (n,) with Wilson's interval."""
    happened, n = int(np.sum(events)), len(events)
    interval = stats.binomtest(happened, n).proportion_ci(LEVEL, method="wilson")
    return Estimate(happened / n, float(interval.low), float(interval.high))


def utility_of_mean(returns: NDArray[np.float64], utility: Callable[[Any], Any]) -> Estimate:
    """SER: ``utility`` of the mean of ``returns`` (n, d)."""
    generator = np.random.default_rng(0)
    value = float(utility(returns.mean(axis=0)))
    n = len(returns)
    if n < 2:
        return Estimate(value)
    # Resampled means through the counts of each episode, which is a matrix product.
    counts = generator.multinomial(n, np.full(n, 1.0 / n), size=RESAMPLES)
    values = np.asarray(utility(counts @ returns / n))
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(values, [tail, 1.0 - tail])
    return Estimate(value, float(low), float(high))
