"""Intervals by the bootstrap: how far a mean could be off, from the sample itself."""

from typing import NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array

_RESAMPLES = 10_000


class Interval(NamedTuple):
    """A mean with its 95% percentile-bootstrap interval."""

    mean: float
    low: float
    high: float


def interval(values: Array, level: float = 0.95) -> Interval:
    """The mean of a sample and its percentile-bootstrap interval.

    The resampling is seeded, so equal samples give equal intervals. Of a handful of values it is
    somewhat too narrow, as every bootstrap is.

    Args:
        values: the sample, one finite number for each independent unit, `[n]` with n >= 1.
        level: probability that the interval is meant to cover.
    """
    values = np.asarray(values, np.float64)
    rows = np.random.default_rng(0).integers(0, len(values), (_RESAMPLES, len(values)))
    low, high = np.quantile(values[rows].mean(axis=-1), [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(values.mean()), float(low), float(high))
