"""An autopilot's own limits: which parameters hold them, how they are asked for, what they mean."""

import math
import struct
from collections.abc import Mapping
from typing import Any

from uav_dc_ros.offboard.vehicle import Limits

ASKED, AGAIN_S = 3, 0.7  # times that a parameter is asked for, and the pause, steady clock
INTEGERS = frozenset(range(1, 9))  # MAV_PARAM_TYPE
CEILING, CIRCLE, POLYGON, FLOOR = 1, 2, 4, 8  # bits of FENCE_TYPE
ACTS = 2  # GF_ACTION: hold; below it only warns

# A parameter may have another name in another version: the first that is answered counts.
Names = tuple[tuple[str, ...], ...]
ARDUCOPTER: Names = (
    *[("FENCE_ENABLE",), ("FENCE_AUTOENABLE",), ("FENCE_TYPE",), ("FENCE_RADIUS",)],
    *[("FENCE_ALT_MAX",), ("FENCE_ALT_MIN",), ("FENCE_TOTAL",)],
    *[("WPNAV_SPEED", "WP_SPD"), ("WPNAV_SPEED_UP", "WP_SPD_UP"), ("WPNAV_SPEED_DN", "WP_SPD_DN")],
)
PX4: Names = (
    *[("GF_ACTION",), ("GF_MAX_HOR_DIST",), ("GF_MAX_VER_DIST",)],
    *[("MPC_XY_VEL_MAX",), ("MPC_Z_VEL_MAX_UP",), ("MPC_Z_VEL_MAX_DN",)],
)


class Parameters:
    """Parameters that are asked for by name, a few times, and no longer than that.

    Attributes:
        values: those that were answered.
    """

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self._asked: dict[str, tuple[int, float]] = {}  # how often, and when last

    def take(self, name: str, value: float) -> None:
        """Take in an answer."""
        if math.isfinite(value):
            self.values[name] = value

    def due(self, names: Names, now_s: float) -> list[str]:
        """Those to ask for now, at a steady time; they count as asked for."""
        due = []
        for name in self._open(names):
            times, last_s = self._asked.get(name, (0, -math.inf))
            if times < ASKED and now_s - last_s >= AGAIN_S:
                self._asked[name] = times + 1, now_s
                due.append(name)
        return due

    def are_waited_for(self, names: Names, now_s: float) -> bool:
        """May one of them still be answered."""
        for name in self._open(names):
            times, last_s = self._asked.get(name, (0, -math.inf))
            if times < ASKED or now_s - last_s < AGAIN_S:
                return True
        return False

    def _open(self, names: Names) -> list[str]:
        """Those that have no answer, under any of their names."""
        return [name for same in names if not self.values.keys() & set(same) for name in same]


def number(message: Any, *, bytewise: bool) -> float:
    """The value of a PARAM_VALUE.

    Args:
        message: of pymavlink's.
        bytewise: has an integer its own bytes in the place of a float's, as with PX4?
    """
    if bytewise and message.param_type in INTEGERS:
        (value,) = struct.unpack("<i", struct.pack("<f", message.param_value))
        return float(value)
    return float(message.param_value)


def of_arducopter(values: Mapping[str, float]) -> Limits:
    """What ArduCopter enforces. It takes targets up to the fence: FENCE_MARGIN does not count there."""
    enabled = values.get("FENCE_ENABLE", 0) or values.get("FENCE_AUTOENABLE", 0)
    fences = int(values.get("FENCE_TYPE", 0)) if enabled else 0

    def speed_mps(name: str) -> float | None:
        cmps = values.get(f"WPNAV_SPEED{name}")
        return values.get(f"WP_SPD{name}") if cmps is None else cmps / 100

    return Limits(
        fence_radius_m=values.get("FENCE_RADIUS") if fences & CIRCLE else None,
        fence_ceiling_m=values.get("FENCE_ALT_MAX") if fences & CEILING else None,
        fence_floor_m=values.get("FENCE_ALT_MIN") if fences & FLOOR else None,
        polygon_fence=bool(fences & POLYGON and values.get("FENCE_TOTAL", 0) > 0),
        speed_mps=speed_mps(""),
        climb_mps=speed_mps("_UP"),
        descent_mps=speed_mps("_DN"),
    )


def of_px4(values: Mapping[str, float]) -> Limits:
    """What PX4 enforces in OFFBOARD; MPC_XY_CRUISE and MPC_Z_V_AUTO_UP are those of its own missions."""
    acts = values.get("GF_ACTION", 0) >= ACTS
    radius_m, ceiling_m = values.get("GF_MAX_HOR_DIST", 0.0), values.get("GF_MAX_VER_DIST", 0.0)
    return Limits(
        fence_radius_m=radius_m if acts and radius_m > 0 else None,
        fence_ceiling_m=ceiling_m if acts and ceiling_m > 0 else None,
        speed_mps=values.get("MPC_XY_VEL_MAX"),
        climb_mps=values.get("MPC_Z_VEL_MAX_UP"),
        descent_mps=values.get("MPC_Z_VEL_MAX_DN"),
    )
