"""Series of any length in bounded memory."""

from typing import Generic, TypeVar

import numpy as np

from uav_dc_ros.core.arrays import Array

T = TypeVar("T")


class EveryNth(Generic[T]):
    """Keeps at most `max_kept` values: the first, and those whose number `stride` divides."""

    def __init__(self, max_kept: int) -> None:
        self.stride = 1
        self._max_kept = max_kept
        self._numbered: list[tuple[int, T]] = []

    def add(self, number: int, value: T) -> None:
        """Keep the value if the stride divides its number. A full series doubles its stride."""
        if self._numbered and number % self.stride:
            return
        self._numbered.append((number, value))
        if len(self._numbered) > self._max_kept:
            self.stride *= 2
            first, *others = self._numbered
            self._numbered = [first, *(one for one in others if one[0] % self.stride == 0)]

    @property
    def kept(self) -> list[T]:
        """The values, in order."""
        return [value for _, value in self._numbered]


class SpacedSeries(Generic[T]):
    """Keeps at most `max_kept` values. A full series drops every second one and doubles `factor`.

    The caller adds a value that lies `factor` times the initial spacing from the last one kept.
    """

    def __init__(self, max_kept: int) -> None:
        self.kept: list[T] = []
        self.factor = 1
        self._max_kept = max_kept

    def add(self, value: T) -> None:
        """Keep the value."""
        self.kept.append(value)
        if len(self.kept) > self._max_kept:
            self.kept = self.kept[::2]
            self.factor *= 2


def spread(n: int, max_count: int) -> Array:
    """At most `max_count` indices of `n` values, evenly spaced, with the first and the last."""
    return np.unique(np.linspace(0, n - 1, min(n, max_count)).round().astype(int))
