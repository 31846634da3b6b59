"""An obstacle is a prism: a polygon on the ground, from an altitude `base_m` to an altitude `height_m`."""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.obstacles import polygons

NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]


class Obstacle(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, dict=True):
    """A building, or a zone that the UAV may not fly in."""

    name: Annotated[str, Meta(max_length=64)] = ""  # in errors and pictures
    kind: Literal["building", "no_fly"] = "building"  # a building also cuts lines of sight, see `sight`
    # Corners x, y of the ground plan, metres, in either direction; see `polygons.problem`
    polygon_m: Annotated[tuple[tuple[float, float], ...], Meta(min_length=3, max_length=1000)]
    # Altitude of the top above the users, metres. A no-fly zone without one has no upper limit.
    height_m: Annotated[float, Meta(gt=0)] | None = None
    base_m: NotNegative = 0.0  # altitude of the bottom, metres
    clearance_m: NotNegative = 0.0  # distance that the UAV keeps, horizontally and vertically, metres

    @property
    def top_m(self) -> float:
        """Altitude of the top, metres; infinity without an upper limit."""
        return math.inf if self.height_m is None else self.height_m

    def title(self, index: int) -> str:
        """The obstacle in words: `obstacles[2] 'tower'`."""
        return f"obstacles[{index}]" + (f" {self.name!r}" if self.name else "")

    @cached_property
    def _bounds_m(self) -> tuple[tuple[float, float], ...]:
        """Minimum and maximum of x, y and altitude, metres."""
        columns = zip(*self.polygon_m, strict=True)
        return *((min(values), max(values)) for values in columns), (self.base_m, self.top_m)

    def is_near(self, start_m: Sequence[float], end_m: Sequence[float], margin_m: float) -> bool:
        """Whether a straight path may meet the obstacle, by its bounds: a quick test before `meets`."""
        ways = zip(start_m, end_m, self._bounds_m, strict=True)
        return all(max(a, b) >= low - margin_m and min(a, b) <= high + margin_m for a, b, (low, high) in ways)

    def meets(self, starts_m: Array, ends_m: Array, margin_m: float) -> Array:
        """Whether straight paths come nearer to the obstacle than a margin, bool `[...]`.

        The paths lead from `starts_m` to `ends_m`, `[..., 3]` each, metres. A path is near where it is both
        horizontally and vertically nearer than the margin. A path that touches the obstacle meets it also
        without a margin.
        """
        low_m, high_m = self.base_m - margin_m, self.top_m + margin_m
        z_m, rise_m = starts_m[..., 2], ends_m[..., 2] - starts_m[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):  # a level path has no rise
            entry, exit = (low_m - z_m) / rise_m, (high_m - z_m) / rise_m
        level = rise_m == 0.0
        first = np.where(level, 0.0, np.clip(np.minimum(entry, exit), 0.0, 1.0))
        last = np.where(level, 1.0, np.clip(np.maximum(entry, exit), 0.0, 1.0))
        bottom_m, top_m = np.minimum(z_m, ends_m[..., 2]), np.maximum(z_m, ends_m[..., 2])
        if margin_m > 0.0:
            overlaps = (bottom_m < high_m) & (top_m > low_m)
        else:
            overlaps = (bottom_m <= high_m) & (top_m >= low_m)
        along_m = ends_m[..., :2] - starts_m[..., :2]
        distance_m = polygons.distance_m(
            self.polygon_m,
            starts_m[..., :2] + first[..., None] * along_m,
            starts_m[..., :2] + last[..., None] * along_m,
        )
        return overlaps & ((distance_m < margin_m) | (distance_m == 0.0))


def blocks(obstacles: tuple[Obstacle, ...], start_m: Any, end_m: Any) -> str | None:
    """The obstacle that a straight path between two points x, y, altitude meets, in words; None: none."""
    starts_m, ends_m = np.asarray(start_m, np.float64), np.asarray(end_m, np.float64)
    for i, obstacle in enumerate(obstacles):
        if obstacle.meets(starts_m, ends_m, obstacle.clearance_m):
            return obstacle.title(i)
    return None
