"""Obstacles as triangles, for pictures."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.obstacles.polygons import Polygon
from uav_dc_ros.core.obstacles.prisms import Obstacle


def triangles(polygon_m: Polygon) -> list[tuple[int, int, int]]:
    """Corners of the triangles that fill a simple polygon, by ear clipping (de Berg et al., chapter 3)."""
    corners = polygon_m if _area2(polygon_m) > 0.0 else polygon_m[::-1]
    left = list(range(len(corners)))
    found = []
    while len(left) > 3:
        ears = [i for i in range(len(left)) if _is_ear(corners, left, i)]
        # Rounding may leave none of a nearly flat rest.
        i = ears[0] if ears else 0
        found.append((left[i - 1], left[i], left[(i + 1) % len(left)]))
        del left[i]
    found.append((left[0], left[1], left[2]))
    if corners is polygon_m:
        return found
    last = len(corners) - 1
    return [(last - a, last - b, last - c) for a, b, c in found]


@lru_cache(maxsize=256)
def faces_m(obstacle: Obstacle, ceiling_m: float) -> Array:
    """The triangles of an obstacle's walls and top, metres, `[T, 3, 3]`; it is drawn up to the ceiling."""
    base_m, top_m = obstacle.base_m, max(min(obstacle.top_m, ceiling_m), obstacle.base_m)
    low, high = ([(x, y, z) for x, y in obstacle.polygon_m] for z in (base_m, top_m))
    faces = [tuple(high[i] for i in corners) for corners in triangles(obstacle.polygon_m)]
    for i, corner in enumerate(low):
        after = (i + 1) % len(low)
        faces += [(corner, low[after], high[after]), (corner, high[after], high[i])]
    return np.asarray(faces)


def _area2(polygon_m: Sequence[tuple[float, float]]) -> float:
    """Twice the signed area: positive where the corners run counterclockwise."""
    ends = (*polygon_m[1:], polygon_m[0])
    return math.fsum(a[0] * b[1] - a[1] * b[0] for a, b in zip(polygon_m, ends, strict=True))


def _is_ear(corners: Polygon, left: list[int], i: int) -> bool:
    """Whether a corner can be cut off: it is convex, and no other corner lies in its triangle."""
    three = [corners[left[i - 1]], corners[left[i]], corners[left[(i + 1) % len(left)]]]
    if _area2(three) <= 0.0:
        return False
    others = (corners[j] for j in left if corners[j] not in three)
    edges = ((0, 1), (1, 2), (2, 0))
    return not any(all(_area2([three[a], three[b], point]) >= 0.0 for a, b in edges) for point in others)
