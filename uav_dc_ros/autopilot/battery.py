"""Is the battery low: by what the autopilot counts, unless its voltage says that it counts wrongly.

ArduPilot counts charge down from 100 % at power-on, against a capacity (BATT_CAPACITY) that somebody has to
have entered: its own simulator counts a battery empty within seven minutes of flight that never gets weaker.
"""

import math

from uav_dc_ros.autopilot.vehicle import Telemetry

FULL = 0.93  # of the voltage at rest; a lithium cell under load is below it long before it has 20 % left
SMOOTH_S = 10.0  # gusts and climbs pull the voltage down for less than that


class Battery:
    """Judges one battery.

    Args:
        least: charge at which it is low, 0 to 1.
        at_rest_v: as below, from before a bridge was killed.

    Attributes:
        at_rest_v: the highest voltage that was seen on the ground, motors off; None: none was.
    """

    def __init__(self, least: float, at_rest_v: float | None = None) -> None:
        self.least, self.at_rest_v = least, at_rest_v
        self._smooth_v: float | None = None
        self._seen_s = 0.0  # vehicle time

    def low(self, known: Telemetry) -> str | None:
        """What is wrong with it; None: nothing, or the vehicle does not tell. To be asked often."""
        self._see(known)
        if known.battery is None:
            return "the autopilot finds its battery low" if known.battery_fails else None
        if known.battery >= self.least:
            return None
        if known.armed and not known.battery_fails and self._holds():
            return None
        volts = "" if known.battery_v is None else f" at {known.battery_v:.1f} V"
        return f"battery {known.battery:.0%}{volts}; expected at least {self.least:.0%}"

    def _see(self, known: Telemetry) -> None:
        if known.battery_v is None:
            return
        if not known.armed:
            self.at_rest_v = max(self.at_rest_v or 0.0, known.battery_v)
        passed_s = max(0.0, known.vehicle_s - self._seen_s)
        before_v = known.battery_v if self._smooth_v is None else self._smooth_v
        self._smooth_v = known.battery_v + (before_v - known.battery_v) * math.exp(-passed_s / SMOOTH_S)
        self._seen_s = known.vehicle_s

    def _holds(self) -> bool:
        """Is its voltage that of a battery which is far from empty. Nobody knows who never saw it at rest."""
        if self.at_rest_v is None or self._smooth_v is None:
            return False
        return self._smooth_v >= FULL * self.at_rest_v
