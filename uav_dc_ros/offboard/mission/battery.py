"""Battery faults, by the counted charge, the voltage and the autopilot's own report.

ArduPilot counts the charge down from 100 % at power-on, against a capacity (BATT_CAPACITY) that is entered by
hand. The count may be too low: its simulator counts to 0 % within seven minutes at a constant voltage. It may
be too high: a battery that is connected half empty counts from 100 %.
"""

import math

from uav_dc_ros.offboard.vehicle import Telemetry

FULL = 0.93  # of the voltage at rest; a lithium cell under load is below it long before it has 20 % left
EMPTY = 0.8  # of the voltage at rest, under load: 3.36 V of a cell that was full
SMOOTH_S = 10.0  # time constant: gusts and climbs lower the voltage for less
FAILS_S = 5.0  # minimum duration of the autopilot's report: a single message may be wrong


class BatteryMonitor:
    """Monitors one battery."""

    def __init__(self, min_charge: float, at_rest_v: float | None = None) -> None:
        self.min_charge = min_charge  # 0 to 1; 0: nothing is checked
        self.at_rest_v = at_rest_v  # smoothed voltage on the ground with motors off; None: not measured
        self._smooth_v: float | None = None
        self._updated_s = 0.0  # vehicle time
        self._fails_since_s: float | None = None  # vehicle time

    def fault(self, telemetry: Telemetry) -> str | None:
        """Why the battery is low or broken; None: it is neither, or not reported. Called in every tick."""
        if not self.min_charge:
            return None
        self._update(telemetry)
        volts = "" if telemetry.battery_v is None else f" at {telemetry.battery_v:.1f} V"
        charge = "battery" if telemetry.battery is None else f"battery {telemetry.battery:.0%}"
        rest = "" if self.at_rest_v is None else f", {self.at_rest_v:.1f} V at rest"
        if telemetry.battery is not None and telemetry.battery < self.min_charge:
            if telemetry.armed and not telemetry.battery_fails and self._voltage_is_at_least(FULL):
                return None
            return f"{charge}{volts}; expected at least {self.min_charge:.0%}"
        if self._fails_since_s is not None and telemetry.vehicle_s - self._fails_since_s >= FAILS_S:
            return f"{charge}{volts}{rest}: the autopilot reports it low or broken"
        is_measured = self._smooth_v is not None and self.at_rest_v
        if telemetry.armed and is_measured and not self._voltage_is_at_least(EMPTY):
            return f"{charge} at {self._smooth_v:.1f} V under load{rest}; expected {EMPTY:.0%} of that"
        return None

    def _update(self, telemetry: Telemetry) -> None:
        if not telemetry.battery_fails:
            self._fails_since_s = None
        elif self._fails_since_s is None:
            self._fails_since_s = telemetry.vehicle_s
        if telemetry.battery_v is None:
            return
        passed_s = max(0.0, telemetry.vehicle_s - self._updated_s)
        before_v = telemetry.battery_v if self._smooth_v is None else self._smooth_v
        decay = math.exp(-passed_s / SMOOTH_S)
        self._smooth_v = telemetry.battery_v + (before_v - telemetry.battery_v) * decay
        self._updated_s = telemetry.vehicle_s
        if not telemetry.armed:
            self.at_rest_v = self._smooth_v

    def _voltage_is_at_least(self, share: float) -> bool:
        """Whether the voltage is this share of that at rest; False: the latter was not measured."""
        if self.at_rest_v is None or self._smooth_v is None:
            return False
        return self._smooth_v >= share * self.at_rest_v
