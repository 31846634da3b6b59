"""Intervals by the bootstrap: how far a mean could be off, from the sample itself."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array

_RESAMPLES = 10_000
_BAND_RESAMPLES = 2_000  # of whole curves: an interval's ends for each of many points
_BLOCK = 1_000_000  # values resampled at a time


class Interval(NamedTuple):
    """A mean with its 95% percentile-bootstrap interval."""

    mean: float
    low: float
    high: float


def interval(
    values: Array, statistic: Callable[[Array], Array] = lambda means: means, level: float = 0.95
) -> Interval:
    """The mean of a sample, or a statistic of means, with its percentile-bootstrap interval.

    The resampling is seeded, so equal samples give equal intervals. Of a handful of values it is
    somewhat too narrow, as every bootstrap is.

    Args:
        values: the sample, finite numbers for each independent unit, `[n, ...]` with n >= 1.
        statistic: from means `[R, ...]` to numbers `[R]`.
        level: probability that the interval is meant to cover.
    """
    values = np.asarray(values, np.float64)
    rng, n = np.random.default_rng(0), len(values)
    # In blocks, so that a large sample needs no memory for all of its resamples at once.
    block = max(1, min(_RESAMPLES, _BLOCK // n))
    means = [
        values[rng.integers(0, n, (min(block, _RESAMPLES - done), n))].mean(axis=1)
        for done in range(0, _RESAMPLES, block)
    ]
    low, high = np.quantile(statistic(np.concatenate(means)), [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(statistic(values.mean(axis=0)[None])[0]), float(low), float(high))


def band(curves: Array, level: float = 0.95) -> tuple[Array, Array, Array]:
    """The mean of curves, and its percentile-bootstrap interval at each point.

    Whole curves are resampled, with a seed, since the points of one belong together.

    Args:
        curves: finite numbers, a curve for each independent unit, `[n, T]` with n >= 1.
        level: probability that the interval is meant to cover at a point.

    Returns:
        Mean, low and high end, `[T]` each.
    """
    curves = np.asarray(curves, np.float64)
    n = len(curves)
    drawn = np.random.default_rng(0).multinomial(n, np.full(n, 1.0 / n), _BAND_RESAMPLES)
    low, high = np.quantile(drawn / n @ curves, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return curves.mean(axis=0), low, high
