"""Series in bounded memory: never more than allowed, none of their parts lost."""

import numpy as np
import pytest

from uav_dc_ros.recordings.thinning import EveryNth, SpacedSeries, spread


@pytest.mark.parametrize("n", [0, 1, 10, 11, 20, 21, 1000])
def test_every_nth_keeps_the_first_and_all_parts(n: int) -> None:
    series: EveryNth[int] = EveryNth(10)
    for number in range(n):
        series.add(number, number * number)
        assert len(series.kept) <= 10
    assert series.kept == [number * number for number in range(0, n, series.stride)]
    assert series.stride == 1 or len(series.kept) > 5


def test_a_series_that_starts_late_keeps_its_first() -> None:
    series: EveryNth[int] = EveryNth(4)
    for number in range(7, 30):
        series.add(number, number)
    assert series.kept == [7, 8, 16, 24]


def test_a_full_spaced_series_doubles_its_spacing() -> None:
    way: SpacedSeries[float] = SpacedSeries(10)
    for metre in np.arange(0.0, 1000.0, 0.25):
        if not way.kept or metre - way.kept[-1] >= way.factor:
            way.add(float(metre))
        assert len(way.kept) <= 10
    assert way.factor == 128
    assert way.kept == [128.0 * i for i in range(8)]


@pytest.mark.parametrize(("n", "max_count", "expected"), [(0, 5, 0), (1, 5, 1), (5, 5, 5), (1000, 5, 5)])
def test_indices_are_spread_from_the_first_to_the_last(n: int, max_count: int, expected: int) -> None:
    found = spread(n, max_count).tolist()
    assert len(found) == expected
    assert found[:1] + found[-1:] == ([0, n - 1] if n else [])
