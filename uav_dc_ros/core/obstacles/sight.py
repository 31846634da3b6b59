"""Line of sight between the UAV and users on the ground, among buildings.

A link is the straight segment between a user at altitude 0 and the UAV. A building cuts it where the segment
has a point in the prism. Along the segment the altitude grows in proportion, so the part between bottom and
top of the prism is a part of the segment's ground track. It has a point in the ground plan if it starts in it
or crosses one of its edges: the test is exact, up to the rounding of the coordinates.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.obstacles.prisms import Obstacle

# A vehicle on the ground, or below it by its own estimate, counts as this much above it, metres.
_ALTITUDE_MIN_M = 1e-3
_PAIRS = 32_768  # of links and buildings at a time: they fit into the cache


class _Arrays(NamedTuple):
    """B buildings, metres, `[B, 1]` each but the corners."""

    x_m: Array  # centre of a circle around the ground plan
    y_m: Array
    radius2_m2: Array  # square of its radius
    base_m: Array
    top_m: Array
    corners_x_m: Array  # `[B, E + 1]`: E edges; a polygon with fewer corners repeats its first one
    corners_y_m: Array


class _Part(NamedTuple):
    """The parts of P ground tracks between two shares of their length, `[P, 1]` each."""

    x_m: Array  # start of the track: the user
    y_m: Array
    dx_m: Array  # from there to its end: the UAV
    dy_m: Array
    first: Array
    last: Array


class Buildings:
    """The buildings of a scenario."""

    def __init__(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Those of the obstacles that are buildings."""
        buildings = [one for one in obstacles if one.kind == "building"]
        n_edges = max((len(one.polygon_m) for one in buildings), default=0)
        rings = [
            (*one.polygon_m, *[one.polygon_m[0]] * (n_edges + 1 - len(one.polygon_m))) for one in buildings
        ]
        corners_m = np.asarray(rings, np.float64).reshape(len(buildings), n_edges + 1, 2)
        centre_m = (corners_m.min(axis=1) + corners_m.max(axis=1)) / 2
        radius_m = np.sqrt(((corners_m - centre_m[:, None]) ** 2).sum(axis=-1)).max(axis=1)
        base_m, top_m = (
            np.asarray([getattr(one, name) for one in buildings]) for name in ("base_m", "top_m")
        )
        # The slack covers the rounding of float32: the circle only spares tests of the building.
        radius2_m2 = (radius_m * 1.001 + 0.01) ** 2
        self._arrays = _Arrays(
            x_m=centre_m[:, :1],
            y_m=centre_m[:, 1:],
            radius2_m2=radius2_m2[:, None],
            base_m=base_m[:, None],
            top_m=top_m[:, None],
            corners_x_m=corners_m[..., 0],
            corners_y_m=corners_m[..., 1],
        )

    def __len__(self) -> int:
        """Number of buildings."""
        return len(self._arrays.base_m)

    def cut(self, uav_m: Array, users_m: Array) -> Array:
        """Whether a building cuts the line of sight, bool `[..., U]`.

        The UAV is at `uav_m` `[..., 3]`, and users are on the ground at `users_m` `[..., U, 2]`, metres.
        """
        xp = array_namespace(users_m)
        own = _converted(self, xp, getattr(users_m, "device", None), users_m.dtype)
        along_m = uav_m[..., None, :2] - users_m  # [..., U, 2]
        shape = along_m.shape[:-1]
        altitude_m = xp.broadcast_to(xp.clip(uav_m[..., 2:3], _ALTITUDE_MIN_M, None), shape)
        links = [users_m[..., 0], users_m[..., 1], along_m[..., 0], along_m[..., 1], altitude_m]
        flat = [xp.reshape(values, (-1,)) for values in links]
        n = _PAIRS // max(len(self), 1) if isinstance(users_m, np.ndarray) else flat[0].shape[0]
        parts = [
            _links_cut(own, *(values[i : i + n] for values in flat))
            for i in range(0, flat[0].shape[0], max(n, 1))
        ]
        return xp.reshape(xp.concat(parts), shape)


def _links_cut(own: _Arrays, x_m: Array, y_m: Array, dx_m: Array, dy_m: Array, altitude_m: Array) -> Array:
    """Whether a building cuts links from x, y on the ground by dx, dy to an altitude, bool `[L]`."""
    xp = array_namespace(x_m)
    first, last = own.base_m / altitude_m, xp.clip(own.top_m / altitude_m, None, 1.0)  # [B, L]
    # Pairs of a building and a link that comes near to its circle.
    to_x_m, to_y_m = own.x_m - x_m, own.y_m - y_m
    share = (to_x_m * dx_m + to_y_m * dy_m) / xp.clip(dx_m * dx_m + dy_m * dy_m, 1e-12, None)
    share = xp.minimum(xp.maximum(share, first), last)
    to_x_m, to_y_m = to_x_m - share * dx_m, to_y_m - share * dy_m
    near = (to_x_m * to_x_m + to_y_m * to_y_m <= own.radius2_m2) & (first <= last)
    building, link = xp.nonzero(near)
    near[building, link] = _cut(
        _Part(
            x_m=x_m[link, None],
            y_m=y_m[link, None],
            dx_m=dx_m[link, None],
            dy_m=dy_m[link, None],
            first=first[building, link][:, None],
            last=last[building, link][:, None],
        ),
        own.corners_x_m[building],
        own.corners_y_m[building],
    )
    return xp.any(near, axis=0)


def _cut(part: _Part, corners_x_m: Array, corners_y_m: Array) -> Array:
    """Whether a part of a ground track has a point in a polygon with corners `[P, E + 1]`, bool `[P]`."""
    x_m, y_m, dx_m, dy_m, first, last = part
    xp = array_namespace(x_m)
    above = (dx_m == 0.0) & (dy_m == 0.0)  # the UAV is above the user: the track is a point, in any direction
    dx_m = xp.where(above, xp.ones_like(dx_m), dx_m)
    last = xp.where(above, xp.zeros_like(last), last)
    first = xp.minimum(first, last)
    corners_x_m, corners_y_m = corners_x_m - x_m, corners_y_m - y_m
    side = dx_m * corners_y_m - dy_m * corners_x_m  # of each corner: positive to the left of the track
    left = side > 0.0
    crosses = left[:, :-1] != left[:, 1:]  # an edge crosses the track's line ...
    area = corners_x_m[:, :-1] * corners_y_m[:, 1:] - corners_y_m[:, :-1] * corners_x_m[:, 1:]
    change = side[:, 1:] - side[:, :-1]
    share = area / xp.where(crosses, change, xp.ones_like(change))  # ... at this share of the track
    on_way = crosses & (share >= first) & (share <= last)
    ahead = (crosses & (share > first)).sum(axis=-1)  # odd: the part starts in the polygon
    return xp.any(on_way, axis=-1) | (ahead % 2 == 1)


@lru_cache(maxsize=16)
def _converted(buildings: Buildings, xp: Any, device: Any, dtype: Any) -> _Arrays:
    """The arrays in a library, on a device, converted once."""
    return _Arrays(*(xp.asarray(values, dtype=dtype, device=device) for values in buildings._arrays))
