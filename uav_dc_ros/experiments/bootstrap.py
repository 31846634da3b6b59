"""Intervals by the bootstrap: how far a mean could be off, from the sample itself."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array

_RESAMPLES = 10_000
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
