"""Simple polygons in the plane: validity, and their distance from straight paths.

The inside and the edges belong to a polygon. Corners are x, y in metres, in either direction, without a
repetition of the first one at the end. The tests are signs of cross products (de Berg et al., "Computational
Geometry", 3rd ed., 2008, chapter 1).
"""

from typing import TypeAlias

import numpy as np

from uav_dc_ros.core.arrays import Array

Polygon: TypeAlias = tuple[tuple[float, float], ...]


def problem(polygon_m: Polygon) -> str | None:
    """Why these corners are no simple polygon with an area; None: they are."""
    corners = np.asarray(polygon_m, np.float64)
    n = len(corners)
    ends = np.roll(corners, -1, axis=0)
    if (same := np.flatnonzero((corners == ends).all(axis=-1))).size:
        after = (int(same[0]) + 1) % n
        return (
            f"corner {after} repeats the one before it; expected different corners, the first one only once"
        )
    crossing = _crosses(corners[:, None], ends[:, None], corners, ends)
    first, second = np.triu_indices(n, 2)
    apart = (first + n - second) % n > 1  # neighbouring edges share a corner
    for i, j in zip(first[apart].tolist(), second[apart].tolist(), strict=True):
        if crossing[i, j]:
            return (
                f"the edge after corner {i} crosses that after corner {j}; expected edges that do not cross"
            )
    folded = (_cross(corners, ends, np.roll(corners, -2, axis=0)) == 0.0) & (
        ((ends - corners) * (np.roll(corners, -2, axis=0) - ends)).sum(axis=-1) < 0.0
    )
    if folded.any():
        corner = (int(folded.argmax()) + 1) % n
        return f"the edges at corner {corner} lie on one another; expected a polygon with an area"
    return None


def contains(polygon_m: Polygon, points_m: Array) -> Array:
    """Whether points `[..., 2]` are in a polygon or on its edge, bool `[...]`; by the even-odd rule."""
    corners = np.asarray(polygon_m, np.float64)
    ends, points_m = np.roll(corners, -1, axis=0), np.asarray(points_m)[..., None, :]
    side = _cross(corners, ends, points_m)
    low, high = np.minimum(corners, ends), np.maximum(corners, ends)
    on_edge = (side == 0.0) & ((low <= points_m) & (points_m <= high)).all(axis=-1)
    upward = ends[:, 1] > corners[:, 1]
    passes = (corners[:, 1] > points_m[..., 1]) != (ends[:, 1] > points_m[..., 1])
    left = passes & ((side > 0.0) == upward)  # the edge is to the right of the point
    return (left.sum(axis=-1) % 2 == 1) | on_edge.any(axis=-1)


def distance_m(polygon_m: Polygon, starts_m: Array, ends_m: Array) -> Array:
    """Distance of straight paths from a polygon, metres, `[...]`; 0 where a path touches it.

    The paths lead from `starts_m` to `ends_m`, `[..., 2]` each; a point has equal ends.
    """
    corners = np.asarray(polygon_m, np.float64)
    others = np.roll(corners, -1, axis=0)
    p, q = starts_m[..., None, :], ends_m[..., None, :]
    distance = np.minimum(
        np.minimum(_point_distance(p, corners, others), _point_distance(q, corners, others)),
        _point_distance(corners, p, q),
    ).min(axis=-1)
    touches = _crosses(p, q, corners, others).any(axis=-1) | contains(polygon_m, starts_m)
    return np.where(touches, 0.0, distance)


def _cross(a: Array, b: Array, c: Array) -> Array:
    """Twice the signed area of triangles `[..., 2]`: positive where c is to the left of a to b, `[...]`."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
        c[..., 0] - a[..., 0]
    )


def _crosses(p: Array, q: Array, a: Array, b: Array) -> Array:
    """Whether the segments p to q and a to b have a common point, ends included, bool `[...]`."""
    one_side = np.sign(_cross(p, q, a)) * np.sign(_cross(p, q, b)) <= 0.0
    other_side = np.sign(_cross(a, b, p)) * np.sign(_cross(a, b, q)) <= 0.0
    apart = (np.maximum(p, q) < np.minimum(a, b)) | (np.maximum(a, b) < np.minimum(p, q))  # on one line
    return one_side & other_side & ~apart.any(axis=-1)


def _point_distance(points: Array, a: Array, b: Array) -> Array:
    """Distance of points from segments a to b, `[...]`."""
    along, offset = b - a, points - a
    squared = (along * along).sum(axis=-1)
    share = (offset * along).sum(axis=-1) / np.where(squared > 0.0, squared, 1.0)
    nearest = np.clip(share, 0.0, 1.0)[..., None] * along
    return np.sqrt(((offset - nearest) ** 2).sum(axis=-1))
