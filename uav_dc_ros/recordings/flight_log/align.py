"""The time of one clock at which another one started, from two recordings of the same path."""

from dataclasses import dataclass

import numpy as np

from uav_dc_ros.core.arrays import Array

STEP_S = 0.1  # resolution of the search; the result is finer
MIN_SPREAD_M = 1.0  # of a path: a vehicle that stands still has no time


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """How a second recording of a path fits the first one."""

    offset_s: float  # time of the first clock at time 0 of the second one
    rms_m: float  # distance between both paths, where they overlap, without a constant one
    explained: float  # share of the first path's variance that the second one explains, at most 1
    overlap_s: float
    shift_m: Array  # constant difference first - second, `[3]`


def align(
    first_s: Array, first_m: Array, second_s: Array, second_m: Array, offset_s: float | None = None
) -> Alignment | None:
    """Align two recordings: times `[N]`, increasing, and positions `[N, 3]` on parallel axes.

    Of all offsets with which half of the shorter recording overlaps, the one that explains most of the first
    path's variance; or that of `offset_s`. None if the first path has no spread.
    """
    if offset_s is not None:
        return _at(first_s, first_m, second_s, second_m, offset_s)
    centre_m = first_m.mean(axis=0), second_m.mean(axis=0)
    one = _resampled(first_s, first_m - centre_m[0])
    other = _resampled(second_s, second_m - centre_m[1])
    lags = np.arange(1 - len(other), len(one))
    starts, ends = np.maximum(0, lags), np.minimum(len(one), len(other) + lags)
    counts = ends - starts
    n_fft = len(one) + len(other)
    spectrum = np.fft.rfft(one, n_fft, axis=0) * np.conj(np.fft.rfft(other, n_fft, axis=0))
    cross = np.fft.irfft(spectrum, n_fft, axis=0).sum(axis=-1)[lags]

    def means(values: Array, start: Array, end: Array) -> Array:
        sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
        return (sums[end] - sums[start]) / counts.reshape(-1, *(1,) * (values.ndim - 1))

    mean, mean_other = means(one, starts, ends), means(other, starts - lags, ends - lags)
    square = means((one**2).sum(axis=-1), starts, ends)
    square_other = means((other**2).sum(axis=-1), starts - lags, ends - lags)
    spread = square - (mean**2).sum(axis=-1)
    residual = square + square_other - 2 * cross / counts - ((mean - mean_other) ** 2).sum(axis=-1)
    usable = (counts * 2 >= min(len(one), len(other))) & (spread >= MIN_SPREAD_M**2)
    if not usable.any():
        return None
    explained = np.where(usable, 1 - residual / np.maximum(spread, MIN_SPREAD_M**2), -np.inf)
    best = int(explained.argmax())
    lag = lags[best] + _vertex(residual, best)
    return _at(first_s, first_m, second_s, second_m, float(lag * STEP_S + first_s[0] - second_s[0]))


def _resampled(times_s: Array, positions_m: Array) -> Array:
    grid_s = np.arange(times_s[0], times_s[-1] + STEP_S / 2, STEP_S)
    return np.stack([np.interp(grid_s, times_s, column) for column in positions_m.T], axis=-1)


def _vertex(values: Array, index: int) -> float:
    """Offset of the minimum of the parabola through a value and its neighbours, -0.5 to 0.5."""
    if not 0 < index < len(values) - 1:
        return 0.0
    before, here, after = values[index - 1 : index + 2]
    curvature = before - 2 * here + after
    return float(np.clip((before - after) / (2 * curvature), -0.5, 0.5)) if curvature > 0 else 0.0


def _at(
    first_s: Array, first_m: Array, second_s: Array, second_m: Array, offset_s: float
) -> Alignment | None:
    """The alignment with an offset, at the times of the first recording; None without an overlap."""
    inside = (first_s >= second_s[0] + offset_s) & (first_s <= second_s[-1] + offset_s)
    if inside.sum() < 2:
        return None
    times_s, here_m = first_s[inside], first_m[inside]
    there_m = np.stack([np.interp(times_s - offset_s, second_s, column) for column in second_m.T], axis=-1)
    shift_m = (here_m - there_m).mean(axis=0)
    residual = float((((here_m - there_m - shift_m) ** 2).sum(axis=-1)).mean())
    spread = float(here_m.var(axis=0).sum())
    return Alignment(
        offset_s=offset_s,
        rms_m=residual**0.5,
        explained=1 - residual / spread if spread else 0.0,
        overlap_s=float(times_s[-1] - times_s[0]),
        shift_m=shift_m,
    )
