"""Crash detection: tilt, loss of altitude, ground contact."""

import math

from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Telemetry


class CrashDetector:
    """Detects crashes in one phase after the other.

    Attributes:
        flies: whether the vehicle was in the air since the phase began, or its phase implies it.
    """

    def __init__(self, settings: SafetySettings) -> None:
        self._settings = settings
        self._since_s: dict[str, float] = {}  # vehicle time, by symptom
        self.begin(flies=False)

    def begin(self, flies: bool) -> None:
        """Start another phase; `flies`: the vehicle is in the air in all of it."""
        self.flies = flies
        self._min_setpoint_m, self._max_position_m = math.inf, -math.inf
        self._since_s.clear()

    def update(self, telemetry: Telemetry, setpoint: Enu | None) -> str | None:
        """The symptom that has lasted for `crash_timeout_s`; None: there is none, or it is not reported."""
        settings, position = self._settings, telemetry.position
        self.flies |= telemetry.on_ground is False
        symptoms: dict[str, str] = {}
        if telemetry.tilt_rad is not None:
            tilt_deg = math.degrees(telemetry.tilt_rad)
            if tilt_deg > settings.max_tilt_deg:
                symptoms["tilt"] = (
                    f"tilted by {tilt_deg:.0f} degrees; expected at most {settings.max_tilt_deg:g}"
                )
        if self.flies and telemetry.on_ground:
            symptoms["ground"] = "on the ground while it should fly"
        if self.flies and position is not None and setpoint is not None:
            self._min_setpoint_m = min(self._min_setpoint_m, setpoint.up_m)
            self._max_position_m = max(self._max_position_m, position.up_m)
            sink_m = min(self._min_setpoint_m, self._max_position_m) - position.up_m
            if sink_m > settings.max_sink_m:
                symptoms["sink"] = (
                    f"at {position.up_m:.0f} m, {sink_m:.0f} m too low; expected at most "
                    f"{settings.max_sink_m:g} m"
                )
        self._since_s = {name: self._since_s.get(name, telemetry.vehicle_s) for name in symptoms}
        for name, text in symptoms.items():
            if telemetry.vehicle_s - self._since_s[name] > settings.crash_timeout_s:
                return text
        return None
