"""Bootstrap intervals of means. The resampling is seeded: equal samples give equal intervals.

From 50 values on the interval is the percentile bootstrap. Of fewer values it is too narrow, so theirs is the
studentised bootstrap, also named bootstrap-t (Efron and Tibshirani, An Introduction to the Bootstrap, chapter
12). `benchmarks/intervals.py` measures how often the intervals cover the true value.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array

FEW = 50  # below it, intervals are studentised
_ENDS = [(1 - 0.95) / 2, (1 + 0.95) / 2]  # quantiles at the ends of a 95% interval
_RESAMPLES = 10_000
_BAND_RESAMPLES = 2_000  # of whole curves: an interval's ends for each of many points
_BLOCK = 1_000_000  # values resampled at a time: a large sample needs no memory for all of its resamples
# Least standard error of a resample, relative to that of the sample. A resample of equal values has none, so
# without a floor a sample with a single different value has an infinite interval.
_LEAST_ERROR = 1 / 3


class Interval(NamedTuple):
    """A mean with its 95% interval."""

    mean: float
    low: float
    high: float

    def within(self, least: float, greatest: float) -> "Interval":
        """The interval without what lies outside the range of possible values, such as 0 to 1 of a share."""
        return Interval(self.mean, max(self.low, least), min(self.high, greatest))


def _means(means: Array) -> Array:
    return means


def interval(values: Array, statistic: Callable[[Array], Array] = _means) -> Interval:
    """The mean of a sample `[n, ...]`, or a statistic (`[R, ...]` to `[R]`) of means, with its interval.

    Values are finite, n >= 1. Without a difference between values the interval has no width.
    """
    values = np.asarray(values, np.float64)
    if 1 < len(values) < FEW:
        return Interval(*map(float, studentised(values, statistic, _RESAMPLES)))
    low, high = np.quantile(statistic(_resampled_means(values)), _ENDS)
    return Interval(float(statistic(values.mean(axis=0)[None])[0]), float(low), float(high))


def band(curves: Array) -> tuple[Array, Array, Array]:
    """The mean of curves `[n, T]`, and both ends of its interval at each point, `[T]` each.

    Whole curves are resampled, since the points of one are dependent.
    """
    curves = np.asarray(curves, np.float64)
    n = len(curves)
    if 1 < n < FEW:
        return studentised(curves, _means, _BAND_RESAMPLES)
    drawn = np.random.default_rng(0).multinomial(n, np.full(n, 1.0 / n), _BAND_RESAMPLES)
    low, high = np.quantile(drawn / n @ curves, _ENDS, axis=0)
    return curves.mean(axis=0), low, high


def studentised(
    values: Array, statistic: Callable[[Array], Array], n_resamples: int
) -> tuple[Array, Array, Array]:
    """A statistic (`[R, ...]` to `[R, T]` or `[R]`) of the means of `[n, ...]`, and both ends, `[T]` or `[]`.

    The errors of resamples, as multiples of their own standard errors by the jackknife, are taken for those
    of the sample. Of a statistic with kinks, such as the best of several means, the jackknife may find no
    error, so the sample's standard error is at least that of the bootstrap.
    """
    n = len(values)
    draws = np.vstack([np.arange(n), _draws(n)[:n_resamples]])  # the sample itself comes first
    means = sum(values[draw] for draw in draws.T) / n
    found = statistic(means)
    total, squares = np.zeros_like(found), np.zeros_like(found)
    for draw in draws.T:
        change = statistic(means + (means - values[draw]) / (n - 1)) - found  # without one of the values
        total += change
        squares += change**2
    errors = np.sqrt((n - 1) * np.maximum(squares / n - (total / n) ** 2, 0.0))
    error = np.maximum(errors[0], found[1:].std(axis=0))
    errors = np.maximum(errors[1:], _LEAST_ERROR * error)
    deviation = found[1:] - found[0]
    multiples = np.divide(deviation, errors, out=np.zeros_like(deviation), where=errors > 0)
    least, greatest = np.quantile(multiples, _ENDS, axis=0)
    return found[0], found[0] - greatest * error, found[0] - least * error


def _resampled_means(values: Array) -> Array:
    n = len(values)
    if n * _RESAMPLES <= _BLOCK:
        return values.take(_draws(n), axis=0).mean(axis=1)
    rng, block = np.random.default_rng(0), max(1, _BLOCK // n)
    sizes = [min(block, _RESAMPLES - done) for done in range(0, _RESAMPLES, block)]
    return np.concatenate([values[rng.integers(0, n, (size, n))].mean(axis=1) for size in sizes])


@lru_cache(maxsize=4)
def _draws(n: int) -> Array:
    """Indices of all resamples of a small sample: drawing them takes longer than everything else."""
    return np.random.default_rng(0).integers(0, n, (_RESAMPLES, n))
