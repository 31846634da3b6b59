"""What keeps a vehicle from going on: held through for a while, then the end of a mission."""

from typing import Literal

from uav_dc_ros.autopilot.vehicle import Telemetry
from uav_dc_ros.autopilot.watch import Watch


class Hold:
    """A fault that may pass.

    Args:
        watch: finds faults.

    Attributes:
        fault: what is wrong at the moment; None: nothing.
    """

    def __init__(self, watch: Watch) -> None:
        self.watch = watch
        self.fault: str | None = None
        self._since_s = 0.0, 0.0  # steady clock, vehicle time

    def look(self, now_s: float, known: Telemetry) -> Literal["begins", "lasts", "passes", "ends"] | None:
        """What has become of it, at a steady time; None: nothing is wrong, and nothing was.

        `ends` is the end of the mission: it has lasted for `hold_s`, on either clock.
        """
        before, fault = self.fault, self.watch.fault(now_s, known)
        if fault is None:
            self.fault = None
            return None if before is None else "passes"
        if before is None:
            self.fault, self._since_s = fault, (now_s, known.vehicle_s)
            return "begins"
        steady_s, vehicle_s = self._since_s
        lasted_s = max(now_s - steady_s, known.vehicle_s - vehicle_s)
        return "ends" if lasted_s > self.watch.settings.hold_s else "lasts"
