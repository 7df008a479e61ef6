"""Confidence intervals of 95%: bootstrap for means and utilities, Wilson's for rates.

Runs are compared by means and interquartile means, their difference and the probability of improvement, each with a
bootstrap interval over the seeds (Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical
precipice"); scores of the suite by their means, with seeds and scenarios resampled together.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import scipy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import ArrayLike, NDArray

RESAMPLES = 2000
COMPARISON_RESAMPLES = 10_000  # of a comparison of runs, of which there are few
POWER_SAMPLES = 300  # simulated comparisons
LEVEL = 0.95
# The least sample that gets an interval. All that a bootstrap can say of two values is that the mean lies between them,
# which is true of half of all pairs, not of 95%.
MIN_SAMPLES = 3


@dataclass(frozen=True)
class Estimate:
    """A value and its interval; ``low`` and ``high`` are None where the sample is too small for one."""

    value: float
    low: float | None = None
    high: float | None = None

    def text(self, other_width: float = 0.0) -> str:
        """``1.23 [1.20, 1.26]``, to two significant digits of the interval's width, but at most four decimals.

        Of a wider interval of ``other_width``, for another source of error, to that one's digits.
        """
        if self.low is None or self.high is None or not self.high - self.low > 0.0:  # also if both ends are infinite
            return f"{self.value:.4g}"
        width = max(self.high - self.low, other_width)
        decimals = int(np.clip(1 - np.floor(np.log10(width)), 0, 4))
        value, low, high = (with_decimals(number, decimals) for number in (self.value, self.low, self.high))
        return f"{value} [{low}, {high}]"


def with_decimals(value: float, decimals: int) -> str:
    """A number with so many decimals; a zero has no sign."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def of_three(sizes: Iterable[int], what: str = "seeds") -> str:
    """What a note on bootstrap intervals of means must add where a sample has three values of ``what``; else nothing.

    The mean of a resample of three is the lowest of them with probability 1/27, which is more than the 2.5% of a tail.
    """
    return f" (with three {what}: from the lowest to the highest)" if MIN_SAMPLES in sizes else ""


def bootstrap(samples: ArrayLike, statistic: Callable[..., Any] = np.mean) -> tuple[NDArray[Any], NDArray[Any]]:
    """Percentile bootstrap over the first axis of ``samples`` (n, ...), always with the same resamples.

    Called as ``statistic(samples, axis=...)``. Lower and upper ends, each (...); NaN where n is below MIN_SAMPLES.
    """
    samples = np.asarray(samples, dtype=np.float64)
    if len(samples) < MIN_SAMPLES:
        nothing = np.full(samples.shape[1:], np.nan)
        return nothing, nothing.copy()
    interval = scipy.stats.bootstrap(
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
    """The mean of ``samples`` (n,) with its bootstrap interval."""
    return estimate(samples, np.mean)


def means(samples: Sequence[Sequence[float]]) -> list[Estimate]:
    """The mean of each sample with its bootstrap interval.

    Samples of the same size share their resamples, which makes thousands of them fast.
    """
    by_size: dict[int, list[Sequence[float]]] = defaultdict(list)
    for sample in samples:
        by_size[len(sample)].append(sample)
    estimates = {}
    for size, alike in by_size.items():
        together = np.array(alike).T
        estimates[size] = map(_estimate, together.mean(axis=0), *bootstrap(together))
    return [next(estimates[len(sample)]) for sample in samples]


def estimate(samples: NDArray[Any], statistic: Callable[..., Any]) -> Estimate:
    """A scalar statistic of ``samples`` (n,) with its bootstrap interval."""
    return _estimate(statistic(samples, axis=0), *bootstrap(samples, statistic))


def _estimate(value: Any, low: Any, high: Any) -> Estimate:
    return Estimate(float(value)) if np.isnan(low) else Estimate(float(value), float(low), float(high))


def resample(samples: NDArray[Any], statistic: Callable[[NDArray[Any]], float]) -> Estimate:
    """A statistic of the rows of ``samples`` (n, ...), which need not be a mean, with its bootstrap interval."""
    value, n = statistic(samples), len(samples)
    if n < MIN_SAMPLES:
        return Estimate(value)
    draws = np.random.default_rng(0).integers(n, size=(RESAMPLES, n))
    return between_tails(value, [statistic(samples[rows]) for rows in draws])


def between_tails(value: float, resampled: Any) -> Estimate:
    """An estimate with the percentile interval of the statistic's values in resamples."""
    tail = (1.0 - LEVEL) / 2.0
    # Interpolating between two infinite values would give NaN.
    method: Literal["linear", "nearest"] = "linear" if np.isfinite(resampled).all() else "nearest"
    low, high = np.quantile(resampled, [tail, 1.0 - tail], method=method)
    return Estimate(value, float(low), float(high))


def rate(events: NDArray[np.bool_]) -> Estimate:
    """The share of True in ``events`` (n,) with Wilson's interval."""
    happened, n = int(np.sum(events)), len(events)
    interval = scipy.stats.binomtest(happened, n).proportion_ci(LEVEL, method="wilson")
    return Estimate(happened / n, float(interval.low), float(interval.high))


def mean_or_rate(samples: NDArray[Any]) -> Estimate:
    """:func:`rate` of truth values, :func:`mean` of numbers."""
    return rate(samples) if samples.dtype == np.bool_ else mean(samples)


def of_mean(samples: NDArray[Any], function: Callable[[Any], Any]) -> Estimate:
    """A function (...) of the mean (..., k) of ``samples`` (n, k) with its bootstrap interval; of a utility: SER."""
    value, n = float(function(samples.mean(axis=0))), len(samples)
    return between_tails(value, function(shares(n) @ samples)) if n >= MIN_SAMPLES else Estimate(value)


def shares(n: int, drawn: int | None = None, stream: str = "") -> NDArray[np.float64]:
    """(RESAMPLES, n) the share of each of n samples in a resample of ``drawn`` (n by default).

    Resamples are the same whenever n, ``drawn`` and ``stream`` are. The mean of a resample is a product with them.
    """
    drawn = n if drawn is None else drawn
    rows = np.random.default_rng(zlib.crc32(stream.encode())).integers(n, size=(RESAMPLES, drawn))
    counts = np.bincount((rows + n * np.arange(RESAMPLES)[:, None]).ravel(), minlength=RESAMPLES * n)
    return counts.reshape(RESAMPLES, n) / drawn


@dataclass(frozen=True)
class Resampled:
    """A number and its values in resamples, of which intervals, differences and p-values are made."""

    value: float
    resamples: NDArray[np.float64] | None = None  #: (RESAMPLES,); None where there are too few samples

    @classmethod
    def over_seeds(cls, scores: Sequence[tuple[float, ArrayLike]], stream: str) -> Resampled:
        """The mean of scores over seeds, which are resampled, too.

        Of each seed the score and (RESAMPLES,) its values in resamples of the scenarios, the same for all seeds and
        for all that it will be compared with; or one value, where the scenarios are not known. This is the pigeonhole
        bootstrap (Owen 2007, "The pigeonhole bootstrap", Annals of Applied Statistics 1). Of S seeds S - 1 are drawn,
        which makes the variance of their mean the unbiased one (Rao and Wu 1988, "Resampling inference with complex
        survey data", JASA 83).
        """
        n, value = len(scores), float(np.mean([score for score, _ in scores]))
        if n < MIN_SAMPLES:
            return cls(value)
        resampled = np.stack([np.broadcast_to(values, RESAMPLES) for _, values in scores], axis=1)
        return cls(value, (shares(n, n - 1, stream) * resampled).sum(axis=1))

    @classmethod
    def mean(cls, numbers: Sequence[Resampled]) -> Resampled:
        """The mean of independent numbers."""
        resamples = [number.resamples for number in numbers if number.resamples is not None]
        known = np.mean(resamples, axis=0) if len(resamples) == len(numbers) else None
        return cls(float(np.mean([number.value for number in numbers])), known)

    def __sub__(self, other: Resampled) -> Resampled:
        known = self.resamples is not None and other.resamples is not None
        return Resampled(self.value - other.value, self.resamples - other.resamples if known else None)  # type: ignore[operator]

    @property
    def estimate(self) -> Estimate:
        """The number with its interval."""
        return Estimate(self.value) if self.resamples is None else between_tails(self.value, self.resamples)

    @property
    def p(self) -> float:
        """The two-sided p-value of 0; 1 where it is not known."""
        if self.resamples is None:
            return 1.0
        beyond = min((self.resamples <= 0.0).sum(), (self.resamples >= 0.0).sum())
        return min(1.0, 2.0 * (float(beyond) + 1.0) / (RESAMPLES + 1.0))


def holm(p: Sequence[float]) -> list[float]:
    """P-values corrected for the number of comparisons.

    The probability that any of those below a level is there by chance is at most the level (Holm 1979, "A simple
    sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6).
    """
    order = np.argsort(p, kind="stable")
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1)))
    return adjusted.tolist()


def iqm(samples: NDArray[Any]) -> Estimate:
    """The interquartile mean of ``samples`` (n,): the mean without the lowest and the highest quarter."""
    return estimate(samples, interquartile_mean)


def interquartile_mean(samples: NDArray[Any], axis: int = 0) -> Any:
    """The mean of the middle half of ``samples`` (n, ...), as scipy.stats.trim_mean cuts it."""
    return scipy.stats.trim_mean(samples, 0.25, axis=axis)


def probability_of_improvement(first: NDArray[Any], second: NDArray[Any]) -> Estimate:
    """The probability that a run of ``first`` (n,) scores higher than one of ``second`` (m,); ties count half."""
    return _resampled([first, second], _improvement)


def mean_difference(first: NDArray[Any], second: NDArray[Any]) -> Estimate:
    """Mean of ``first`` (n,) minus that of ``second`` (m,)."""
    return _resampled([first, second], lambda x, y: x.mean(axis=-1) - y.mean(axis=-1))


def mann_whitney_p(first: NDArray[Any], second: NDArray[Any]) -> float:
    """The p-value of the two-sided Mann-Whitney test of ``first`` (n,) against ``second`` (m,)."""
    return float(scipy.stats.mannwhitneyu(first, second, alternative="two-sided").pvalue)


def iqm_difference(first: NDArray[Any], second: NDArray[Any]) -> Estimate:
    """Interquartile mean of ``first`` (n,) minus that of ``second`` (m,)."""
    return _resampled([first, second], lambda x, y: interquartile_mean(x, axis=-1) - interquartile_mean(y, axis=-1))


def spread_ratio(first: NDArray[Any], second: NDArray[Any]) -> Estimate:
    """Standard deviation of ``first`` (n,) divided by that of ``second`` (m,); 1 if both are 0."""

    def ratio(x: Any, y: Any) -> Any:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(np.std(x, axis=-1, ddof=1) / np.std(y, axis=-1, ddof=1), nan=1.0, posinf=np.inf)

    return _resampled([first, second], ratio)


@cache
def spread_ratio_power(runs: int, ratio: float) -> float:
    """The power of a test that decides by the interval of :func:`spread_ratio`, of ``runs`` of each algorithm.

    It is the share of POWER_SAMPLES simulated comparisons in which the interval is below 1; the scores are normally
    distributed, and ``ratio`` is the true ratio of their standard deviations.
    """
    generator = np.random.default_rng(0)
    scores = generator.standard_normal((POWER_SAMPLES, 2, runs))
    highs = [spread_ratio(ratio * first, second).high for first, second in scores]
    return float(np.mean([high is not None and high < 1.0 for high in highs]))


def _improvement(x: Any, y: Any) -> Any:
    return (np.sign(x[..., :, None] - y[..., None, :]).mean((-2, -1)) + 1.0) / 2.0


def _resampled(samples: Sequence[NDArray[Any]], statistic: Callable[..., Any]) -> Estimate:
    """``statistic`` of independent samples, which are resampled independently; no interval if one is too small."""
    samples = [np.asarray(sample, dtype=np.float64) for sample in samples]
    value = float(statistic(*samples))
    if min(len(sample) for sample in samples) < MIN_SAMPLES:
        return Estimate(value)
    generator = np.random.default_rng(0)
    resamples = (generator.choice(sample, (COMPARISON_RESAMPLES, len(sample))) for sample in samples)
    return between_tails(value, statistic(*resamples))
