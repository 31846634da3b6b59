"""Parameters that hold an autopilot's own limits: names, requests, values."""

import math
import struct
from collections.abc import Mapping
from typing import Any

from uav_dc_ros.offboard.vehicle import Limits

MAX_REQUESTS = 3  # of one parameter
REQUEST_PERIOD_S = 0.7  # steady clock
INTEGERS = frozenset(range(1, 9))  # MAV_PARAM_TYPE
CEILING, CIRCLE, POLYGON, FLOOR = 1, 2, 4, 8  # bits of FENCE_TYPE
GF_ACTION_HOLD = 2  # lower values of GF_ACTION only warn

# Names of one parameter in different versions of the autopilot: the first one answered counts.
Names = tuple[tuple[str, ...], ...]
ARDUCOPTER: Names = (
    *[("FENCE_ENABLE",), ("FENCE_AUTOENABLE",), ("FENCE_TYPE",), ("FENCE_RADIUS",)],
    *[("FENCE_ALT_MAX",), ("FENCE_ALT_MIN",), ("FENCE_TOTAL",)],
    ("RTL_ALT", "RTL_ALT_M"),
    *[("WPNAV_SPEED", "WP_SPD"), ("WPNAV_SPEED_UP", "WP_SPD_UP"), ("WPNAV_SPEED_DN", "WP_SPD_DN")],
)
PX4: Names = (
    *[("GF_ACTION",), ("GF_MAX_HOR_DIST",), ("GF_MAX_VER_DIST",)],
    ("RTL_RETURN_ALT",),
    *[("MPC_XY_VEL_MAX",), ("MPC_Z_VEL_MAX_UP",), ("MPC_Z_VEL_MAX_DN",)],
)


class ParameterReader:
    """Reads parameters by name, each with `MAX_REQUESTS` requests at most."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}  # received
        self._requests: dict[str, tuple[int, float]] = {}  # number of requests, time of the last one

    def receive(self, name: str, value: float) -> None:
        """Store a received value; one that is not finite is ignored."""
        if math.isfinite(value):
            self.values[name] = value

    def due(self, names: Names, now_s: float) -> list[str]:
        """Parameters to request now, at a steady time; they count as requested."""
        due = []
        for name in self._unanswered(names):
            times, last_s = self._requests.get(name, (0, -math.inf))
            if times < MAX_REQUESTS and now_s - last_s >= REQUEST_PERIOD_S:
                self._requests[name] = times + 1, now_s
                due.append(name)
        return due

    def are_pending(self, names: Names, now_s: float) -> bool:
        """Whether an answer may still arrive."""
        for name in self._unanswered(names):
            times, last_s = self._requests.get(name, (0, -math.inf))
            if times < MAX_REQUESTS or now_s - last_s < REQUEST_PERIOD_S:
                return True
        return False

    def _unanswered(self, names: Names) -> list[str]:
        return [name for same in names if not self.values.keys() & set(same) for name in same]


def decode(message: Any, *, bytewise: bool) -> float:
    """Value of a PARAM_VALUE; `bytewise`: the float field holds an integer's bytes, as PX4 sends it."""
    if bytewise and message.param_type in INTEGERS:
        (value,) = struct.unpack("<i", struct.pack("<f", message.param_value))
        return float(value)
    return float(message.param_value)


def of_arducopter(values: Mapping[str, float]) -> Limits:
    """ArduCopter's limits. It accepts targets up to the fence itself, without FENCE_MARGIN."""
    enabled = values.get("FENCE_ENABLE", 0) or values.get("FENCE_AUTOENABLE", 0)
    fences = int(values.get("FENCE_TYPE", 0)) if enabled else 0

    def speed_mps(suffix: str) -> float | None:
        cmps = values.get(f"WPNAV_SPEED{suffix}")
        return values.get(f"WP_SPD{suffix}") if cmps is None else cmps / 100

    return_cm = values.get("RTL_ALT")
    return Limits(
        return_altitude_m=values.get("RTL_ALT_M") if return_cm is None else return_cm / 100,
        fence_radius_m=values.get("FENCE_RADIUS") if fences & CIRCLE else None,
        fence_ceiling_m=values.get("FENCE_ALT_MAX") if fences & CEILING else None,
        fence_floor_m=values.get("FENCE_ALT_MIN") if fences & FLOOR else None,
        polygon_fence=bool(fences & POLYGON and values.get("FENCE_TOTAL", 0) > 0),
        speed_mps=speed_mps(""),
        climb_mps=speed_mps("_UP"),
        descent_mps=speed_mps("_DN"),
    )


def of_px4(values: Mapping[str, float]) -> Limits:
    """PX4's limits in OFFBOARD. MPC_XY_CRUISE and MPC_Z_V_AUTO_UP apply to its own missions only."""
    enforced = values.get("GF_ACTION", 0) >= GF_ACTION_HOLD
    radius_m, ceiling_m = values.get("GF_MAX_HOR_DIST", 0.0), values.get("GF_MAX_VER_DIST", 0.0)
    return Limits(
        return_altitude_m=values.get("RTL_RETURN_ALT"),
        fence_radius_m=radius_m if enforced and radius_m > 0 else None,
        fence_ceiling_m=ceiling_m if enforced and ceiling_m > 0 else None,
        speed_mps=values.get("MPC_XY_VEL_MAX"),
        climb_mps=values.get("MPC_Z_VEL_MAX_UP"),
        descent_mps=values.get("MPC_Z_VEL_MAX_DN"),
    )
