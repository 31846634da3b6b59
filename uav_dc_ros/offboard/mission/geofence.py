"""The bridge's geofence, and the autopilot's own limits compared with the field."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from uav_dc_ros.core.obstacles.prisms import Obstacle
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Limits, Telemetry

MARGIN_M = 20.0
UPLOAD_MARGIN_M = 10.0  # of the autopilot's polygon around the bridge's fence, which acts first


@dataclass(frozen=True, kw_only=True)
class Geofence:
    """A box in the grid's ENU frame, without the surroundings of obstacles; metres."""

    lower: Enu
    upper: Enu
    obstacles: tuple[Obstacle, ...] = ()
    margin_m: float = MARGIN_M  # of the obstacles' surroundings

    @classmethod
    def around(cls, scenario: Scenario, margin_m: float = MARGIN_M) -> Self:
        """The box around a scenario's grid and above it, from the ground up."""
        grid = scenario.grid
        top_m = grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m
        east_m, north_m = (grid.n_x - 1) * grid.cell_m, (grid.n_y - 1) * grid.cell_m
        return cls(
            lower=Enu(-margin_m, -margin_m, -margin_m),
            upper=Enu(east_m + margin_m, north_m + margin_m, top_m + margin_m),
            obstacles=scenario.obstacles,
            margin_m=margin_m,
        )

    def outline(self, margin_m: float) -> tuple[Enu, ...]:
        """The corners of the box on the ground, counter-clockwise, with a margin around it."""
        west_m, south_m = self.lower.east_m - margin_m, self.lower.north_m - margin_m
        east_m, north_m = self.upper.east_m + margin_m, self.upper.north_m + margin_m
        corners = (west_m, south_m), (east_m, south_m), (east_m, north_m), (west_m, north_m)
        return tuple(Enu(*corner, 0.0) for corner in corners)

    def breach(self, position: Enu) -> str | None:
        """The coordinate that lies outside, or the obstacle that is near; None: the position is inside."""
        axes = zip(("east", "north", "up"), position, self.lower, self.upper, strict=True)
        for axis, value, lower, upper in axes:
            if not lower <= value <= upper:  # also true for NaN
                text = f"{value:.1f}" if math.isfinite(value) else str(value)
                return f"{text} m {axis}; the fence reaches from {lower:g} to {upper:g} m"
        return self.path_breach(position, position)

    def path_breach(self, start: Enu, end: Enu, more_m: float = 0.0) -> str | None:
        """The obstacle that a straight path comes too near to; None: none.

        The fence keeps `margin_m` from it, and the path `more_m` besides.
        """
        margin_m = self.margin_m + more_m
        for i, obstacle in enumerate(self.obstacles):
            if obstacle.is_near(start, end, margin_m) and obstacle.meets(
                np.asarray(start), np.asarray(end), margin_m
            ):
                return f"nearer than {margin_m:g} m to {obstacle.title(i)}"
        return None

    def return_breach(self, settings: SafetySettings, telemetry: Telemetry) -> str | None:
        """The obstacle because of which the vehicle lands rather than returns; None: it returns.

        Only with `land_if_return_blocked`, and where the vehicle keeps the margin on its way down.
        """
        here, home = telemetry.position, telemetry.home
        if not (settings.land_if_return_blocked and self.obstacles) or here is None or home is None:
            return None
        up_m = max(here.up_m, home.up_m + settings.return_altitude_m)
        ways = pairwise((here, here._replace(up_m=up_m), home._replace(up_m=up_m), home))
        blocked = next((breach for way in ways if (breach := self.path_breach(*way)) is not None), None)
        return blocked if self.path_breach(here, here._replace(up_m=0.0)) is None else None


def limit_conflict(scenario: Scenario, settings: SafetySettings, limits: Limits, home: Enu) -> str | None:
    """The limit that excludes a cell, with `tolerance_m` around its centre; None: there is none.

    Start and dock are cells. The limits are relative to `home`, in the grid's ENU frame.
    """
    grid, margin_m = scenario.grid, settings.tolerance_m
    corners = [(x * grid.cell_m, y * grid.cell_m) for x in (0, grid.n_x - 1) for y in (0, grid.n_y - 1)]
    # No cell is farther away than a corner.
    far_m, far = max((math.dist(home[:2], corner), corner) for corner in corners)
    bottom_m = grid.altitude_min_m - home.up_m
    top_m = bottom_m + (grid.n_z - 1) * grid.altitude_step_m
    radius_m, ceiling_m, floor_m = limits.fence_radius_m, limits.fence_ceiling_m, limits.fence_floor_m
    if radius_m is not None and far_m + margin_m > radius_m:
        return (
            f"the autopilot's circular fence ends {radius_m:g} m from home, and the cell at {far[0]:g} m "
            f"east, {far[1]:g} m north is {far_m:.0f} m from there; expected at least "
            f"{far_m + margin_m:.0f} m (FENCE_RADIUS, GF_MAX_HOR_DIST)"
        )
    if ceiling_m is not None and top_m + margin_m > ceiling_m:
        return (
            f"the autopilot's fence ends {ceiling_m:g} m above home, and the top layer is {top_m:.0f} m "
            f"above it; expected at least {top_m + margin_m:.0f} m (FENCE_ALT_MAX, GF_MAX_VER_DIST)"
        )
    if floor_m is not None and bottom_m - margin_m < floor_m:
        return (
            f"the autopilot's fence begins {floor_m:g} m above home, and the lowest layer is "
            f"{bottom_m:.0f} m above it; expected at most {bottom_m - margin_m:.0f} m (FENCE_ALT_MIN)"
        )
    return None


def limit_warnings(scenario: Scenario, settings: SafetySettings, limits: Limits) -> list[str]:
    """Limits that do not prevent the flight: a fence that is not compared, steps that take too long."""
    grid, found = scenario.grid, []
    if limits.polygon_fence:
        found.append("the autopilot has a fence of another shape, which was not compared with the field")
    layer_m = grid.altitude_step_m if grid.n_z > 1 else 0.0
    ways = (
        ("to the next cell", grid.cell_m if max(grid.n_x, grid.n_y) > 1 else 0.0, limits.speed_mps),
        ("a layer up", layer_m, limits.climb_mps),
        ("a layer down", layer_m, limits.descent_mps),
    )
    slow = [
        f"{name} takes {way_m / speed_mps + settings.dwell_s:.0f} s at {speed_mps:g} m/s"
        for name, way_m, speed_mps in ways
        if speed_mps and way_m / speed_mps + settings.dwell_s > scenario.mission.step_s
    ]
    if slow:
        found.append(f"{', '.join(slow)}, and a step has {scenario.mission.step_s:g} s")
    return found
