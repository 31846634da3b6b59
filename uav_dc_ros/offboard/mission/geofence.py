"""The geofence: an area and a span of altitude, for every target and every pose."""

import math
from dataclasses import dataclass
from typing import Self

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.offboard.frames import Enu

MARGIN_M = 20.0


@dataclass(frozen=True, kw_only=True)
class Geofence:
    """A box in the grid's ENU frame.

    Attributes:
        least, most: its corners, metres.
    """

    least: Enu
    most: Enu

    @classmethod
    def around(cls, scenario: Scenario, margin_m: float = MARGIN_M) -> Self:
        """The box around a scenario's grid and above it, from the ground up: the vehicle starts and lands."""
        grid = scenario.grid
        top_m = grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m
        return cls(
            least=Enu(-margin_m, -margin_m, -margin_m),
            most=Enu(
                (grid.n_x - 1) * grid.cell_m + margin_m,
                (grid.n_y - 1) * grid.cell_m + margin_m,
                top_m + margin_m,
            ),
        )

    def breach(self, position: Enu) -> str | None:
        """What is wrong with a position; None if it lies inside."""
        for name, value, least, most in zip(
            ("east", "north", "up"), position, self.least, self.most, strict=True
        ):
            if not least <= value <= most:  # also what is no number
                told = f"{value:.1f}" if math.isfinite(value) else str(value)
                return f"{told} m {name}; the fence reaches from {least:g} to {most:g} m"
        return None
