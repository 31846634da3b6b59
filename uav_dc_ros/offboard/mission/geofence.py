"""The geofence: a box for all setpoints and positions."""

import math
from dataclasses import dataclass
from typing import Self

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.offboard.frames import Enu

MARGIN_M = 20.0


@dataclass(frozen=True, kw_only=True)
class Geofence:
    """A box in the grid's ENU frame, metres."""

    lower: Enu
    upper: Enu

    @classmethod
    def around(cls, scenario: Scenario, margin_m: float = MARGIN_M) -> Self:
        """The box around a scenario's grid and above it, from the ground up."""
        grid = scenario.grid
        top_m = grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m
        east_m, north_m = (grid.n_x - 1) * grid.cell_m, (grid.n_y - 1) * grid.cell_m
        return cls(
            lower=Enu(-margin_m, -margin_m, -margin_m),
            upper=Enu(east_m + margin_m, north_m + margin_m, top_m + margin_m),
        )

    def breach(self, position: Enu) -> str | None:
        """The coordinate that lies outside; None: the position is inside."""
        axes = zip(("east", "north", "up"), position, self.lower, self.upper, strict=True)
        for axis, value, lower, upper in axes:
            if not lower <= value <= upper:  # also true for NaN
                text = f"{value:.1f}" if math.isfinite(value) else str(value)
                return f"{text} m {axis}; the fence reaches from {lower:g} to {upper:g} m"
        return None
