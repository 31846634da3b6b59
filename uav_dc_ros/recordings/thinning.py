"""Series of any length in bounded memory: what is thinned out while it grows, and what is shown of many."""

from typing import Generic, TypeVar

import numpy as np

from uav_dc_ros.core.arrays import Array

T = TypeVar("T")


class EveryNth(Generic[T]):
    """All values of few; of many every second, every fourth, ... and the first.

    Args:
        most: how many are kept.

    Attributes:
        stride: every how many one is kept.
    """

    def __init__(self, most: int) -> None:
        self.stride = 1
        self._most = most
        self._kept: list[tuple[int, T]] = []

    def add(self, number: int, value: T) -> None:
        """The next value; its number, such as that of its step, tells whether it is kept."""
        if self._kept and number % self.stride:
            return
        self._kept.append((number, value))
        if len(self._kept) > self._most:
            self.stride *= 2
            first, *others = self._kept
            self._kept = [first, *(one for one in others if one[0] % self.stride == 0)]

    @property
    def kept(self) -> list[T]:
        """The values, in order."""
        return [value for _, value in self._kept]


class Apart(Generic[T]):
    """Values that lie apart: of too many every second is lost, and the others have to lie twice as far apart.

    Args:
        most: how many are kept.

    Attributes:
        kept: the values, in order.
        factor: by how much farther apart than at first the next one has to lie.
    """

    def __init__(self, most: int) -> None:
        self.kept: list[T] = []
        self.factor = 1
        self._most = most

    def add(self, value: T) -> None:
        """The next one that lies apart."""
        self.kept.append(value)
        if len(self.kept) > self._most:
            self.kept = self.kept[::2]
            self.factor *= 2


def spread(n: int, most: int) -> Array:
    """Indices of at most `most` of `n`, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))
