"""Is the battery low: by what the autopilot counts, and by what its voltage and its monitor say against that.

ArduPilot counts charge down from 100 % at power-on, against a capacity (BATT_CAPACITY) that somebody has to
have entered. So a count may be too low: its own simulator counts a battery empty within seven minutes of
flight that never gets weaker. And it may be too high: a battery that was put in half empty counts from 100 %.
"""

import math

from uav_dc_ros.offboard.vehicle import Telemetry

FULL = 0.93  # of the voltage at rest; a lithium cell under load is below it long before it has 20 % left
EMPTY = 0.8  # of the voltage at rest, under load, whatever is counted: 3.36 V of a cell that was full
SMOOTH_S = 10.0  # gusts and climbs pull the voltage down for less than that
FAILS_S = 5.0  # for so long the autopilot has to find it low, or broken: a message may be wrong


class Battery:
    """Judges one battery.

    Args:
        least: charge at which it is low, 0 to 1.
        at_rest_v: as below, from before a bridge was killed.

    Attributes:
        at_rest_v: its voltage on the ground, motors off, smoothed; None: it was not seen so.
    """

    def __init__(self, least: float, at_rest_v: float | None = None) -> None:
        self.least, self.at_rest_v = least, at_rest_v
        self._smooth_v: float | None = None
        self._seen_s = 0.0  # vehicle time
        self._fails_since_s: float | None = None  # vehicle time

    def low(self, known: Telemetry) -> str | None:
        """What is wrong with it; None: nothing, or the vehicle does not tell. To be asked often."""
        self._see(known)
        volts = "" if known.battery_v is None else f" at {known.battery_v:.1f} V"
        charge = "battery" if known.battery is None else f"battery {known.battery:.0%}"
        rest = "" if self.at_rest_v is None else f", {self.at_rest_v:.1f} V at rest"
        if known.battery is not None and known.battery < self.least:
            if known.armed and not known.battery_fails and self._is_at_least(FULL):
                return None
            return f"{charge}{volts}; expected at least {self.least:.0%}"
        if self._fails_since_s is not None and known.vehicle_s - self._fails_since_s >= FAILS_S:
            return f"{charge}{volts}{rest}: the autopilot finds it low or broken"
        if known.armed and self._smooth_v is not None and self.at_rest_v and not self._is_at_least(EMPTY):
            return f"{charge} at {self._smooth_v:.1f} V under load{rest}; expected {EMPTY:.0%} of that"
        return None

    def _see(self, known: Telemetry) -> None:
        if not known.battery_fails:
            self._fails_since_s = None
        elif self._fails_since_s is None:
            self._fails_since_s = known.vehicle_s
        if known.battery_v is None:
            return
        passed_s = max(0.0, known.vehicle_s - self._seen_s)
        before_v = known.battery_v if self._smooth_v is None else self._smooth_v
        self._smooth_v = known.battery_v + (before_v - known.battery_v) * math.exp(-passed_s / SMOOTH_S)
        self._seen_s = known.vehicle_s
        if not known.armed:
            self.at_rest_v = self._smooth_v

    def _is_at_least(self, share: float) -> bool:
        """Is its voltage this share of that at rest. Nobody knows who never saw it at rest."""
        if self.at_rest_v is None or self._smooth_v is None:
            return False
        return self._smooth_v >= share * self.at_rest_v
