"""Percentile-bootstrap intervals of means. The resampling is seeded: equal samples give equal intervals."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array

_ENDS = [(1 - 0.95) / 2, (1 + 0.95) / 2]  # quantiles at the ends of a 95% interval
_RESAMPLES = 10_000
_BAND_RESAMPLES = 2_000  # of whole curves: an interval's ends for each of many points
_BLOCK = 1_000_000  # values resampled at a time: a large sample needs no memory for all of its resamples


class Interval(NamedTuple):
    """A mean with its 95% interval."""

    mean: float
    low: float
    high: float


def interval(values: Array, statistic: Callable[[Array], Array] = lambda means: means) -> Interval:
    """The mean of a sample `[n, ...]`, or a statistic (`[R, ...]` to `[R]`) of means, with its interval.

    Values are finite, n >= 1. For small n the interval is somewhat too narrow.
    """
    values = np.asarray(values, np.float64)
    low, high = np.quantile(statistic(_resampled_means(values)), _ENDS)
    return Interval(float(statistic(values.mean(axis=0)[None])[0]), float(low), float(high))


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


def band(curves: Array) -> tuple[Array, Array, Array]:
    """The mean of curves `[n, T]`, and both ends of its interval at each point, `[T]` each.

    Whole curves are resampled, since the points of one are dependent.
    """
    curves = np.asarray(curves, np.float64)
    n = len(curves)
    drawn = np.random.default_rng(0).multinomial(n, np.full(n, 1.0 / n), _BAND_RESAMPLES)
    low, high = np.quantile(drawn / n @ curves, _ENDS, axis=0)
    return curves.mean(axis=0), low, high
