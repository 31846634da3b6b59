"""Whether an aircraft does not fly any more, though it should: fallen over, falling, or on the ground."""

import math

from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Telemetry


class CrashDetector:
    """Looks at one phase of a flight after the other.

    Args:
        settings: limits, and how long it may be beyond one.

    Attributes:
        flies: was it seen in the air, or does its phase say so?
    """

    def __init__(self, settings: SafetySettings) -> None:
        self._settings = settings
        self._since_s: dict[str, float] = {}  # vehicle time, by what is wrong
        self.begin(flies=False)

    def begin(self, flies: bool) -> None:
        """Begin another phase, in which it flies from the beginning, or may not."""
        self.flies = flies
        self._lowest_m, self._highest_m = math.inf, -math.inf  # setpoint, position
        self._since_s.clear()

    def look(self, known: Telemetry, setpoint: Enu | None) -> str | None:
        """What has gone wrong for `crash_timeout_s`; None: nothing, or it is not reported."""
        settings, position = self._settings, known.position
        self.flies |= known.on_ground is False
        wrong: dict[str, str] = {}
        if known.tilt_rad is not None and math.degrees(known.tilt_rad) > settings.max_tilt_deg:
            wrong["tilt"] = (
                f"tilted by {math.degrees(known.tilt_rad):.0f} degrees; expected at most "
                f"{settings.max_tilt_deg:g}"
            )
        if self.flies and known.on_ground:
            wrong["ground"] = "on the ground, where it should fly"
        if self.flies and position is not None and setpoint is not None:
            self._lowest_m = min(self._lowest_m, setpoint.up_m)
            self._highest_m = max(self._highest_m, position.up_m)
            low_m = min(self._lowest_m, self._highest_m) - position.up_m
            if low_m > settings.max_sink_m:
                wrong["sinks"] = (
                    f"at {position.up_m:.0f} m, {low_m:.0f} m too low; expected at most "
                    f"{settings.max_sink_m:g} m"
                )
        self._since_s = {what: self._since_s.get(what, known.vehicle_s) for what in wrong}
        for what, why in wrong.items():
            if known.vehicle_s - self._since_s[what] > settings.crash_timeout_s:
                return why
        return None
