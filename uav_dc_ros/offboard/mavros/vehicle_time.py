"""The vehicle's own time, from the stamps of its poses: a simulated one may be faster than any clock here."""

import math

from uav_dc_ros.offboard.stamp_order import FASTEST, LEAP_S

PATIENCE_S = 0.5  # without a stamp, after which time goes on at the clock's pace


class VehicleTime:
    """Seconds that only ever go on: with the stamps; without any, as the steady clock does.

    Stamps of MAVROS are the autopilot's time since boot, plus an offset that MAVROS keeps estimating. They
    may leap when that changes, and they stand at zero where somebody leaves them out.
    """

    def __init__(self) -> None:
        self._time_s, self._told_s = 0.0, 0.0
        self._stamp_s, self._heard_s = math.nan, math.nan

    def hear(self, stamp_s: float, now_s: float) -> None:
        """Take in a stamp that came at a steady time, seconds."""
        if not math.isnan(self._heard_s):
            passed_s, advance_s = now_s - self._heard_s, stamp_s - self._stamp_s
            believable = 0.0 < advance_s <= LEAP_S + FASTEST * passed_s
            self._time_s += advance_s if believable else passed_s
        self._stamp_s, self._heard_s = stamp_s, now_s

    def at(self, now_s: float) -> float:
        """The vehicle's time at a steady time, seconds."""
        silent_s = 0.0 if math.isnan(self._heard_s) else max(0.0, now_s - self._heard_s - PATIENCE_S)
        self._told_s = max(self._told_s, self._time_s + silent_s)
        return self._told_s
