"""Small operations on arrays of numpy and torch that this package's modules share."""

import math
from typing import Any

from uav_dc_ros.core.arrays import Array, constant


def rows(xp: Any, table: Array, numbers: Array) -> Array:
    """Rows of a table by their numbers `[...]`, `[..., *row]`."""
    return xp.take(table, numbers.reshape((-1,)), axis=0).reshape((*numbers.shape, *table.shape[1:]))


def in_sets(xp: Any, of_members: Array, sets: Array, padding: float) -> Array:
    """Numbers `[..., U]` of the members of N sets, `[..., N, largest size]`.

    `sets` `[N, largest size]` are indices of members; U, which pads sets that are smaller, gives `padding`.
    """
    filler = xp.full_like(of_members[..., :1], padding)
    padded = xp.concat([of_members, filler], axis=-1)
    return xp.take(padded, sets.reshape((-1,)), axis=-1).reshape((*of_members.shape[:-1], *sets.shape))


def picked(xp: Any, values: Array, places: Array) -> Array:
    """Of `[..., K]` the entry at a place, integers `[...]`."""
    n = math.prod(places.shape)
    firsts = constant(range(0, n * values.shape[-1], values.shape[-1]), places)
    return xp.take(values.reshape((-1,)), firsts + places.reshape((-1,)), axis=0).reshape(places.shape)


def squashed(values: Any) -> Any:
    """A number in (-1, 1) for any number."""
    return values / (1.0 + abs(values))
