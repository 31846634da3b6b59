"""What keeps a vehicle from going on: held through for a while, then the end of a mission."""

from typing import Literal

from uav_dc_ros.messages import FaultKind
from uav_dc_ros.offboard.mission.fault_detector import Fault
from uav_dc_ros.offboard.vehicle import Telemetry


class FaultTimer:
    """A fault that may pass.

    Args:
        hold_s: how long it may last.

    Attributes:
        fault: what is wrong at the moment; None: nothing.
        since_s: steady clock, and vehicle time, when it began.
    """

    def __init__(self, hold_s: float) -> None:
        self.hold_s = hold_s
        self.fault: Fault | None = None
        self.since_s = 0.0, 0.0

    def look(
        self, now_s: float, known: Telemetry, fault: Fault | None
    ) -> Literal["begins", "turns", "lasts", "passes", "ends"] | None:
        """What has become of it; None: nothing is wrong, and nothing was.

        A lost link explains all that is missing besides, from before it was noticed until after it is back.
        `turns`: another fault than before is told now. `ends`: it has lasted for `hold_s`, on either clock.

        Args:
            now_s: steady clock.
            known: of the vehicle.
            fault: what is wrong now.
        """
        before, self.fault = self.fault, fault
        if fault is None:
            return None if before is None else "passes"
        if before is None:
            self.since_s = now_s, known.vehicle_s
            return "begins"
        if before.kind in (fault.kind, FaultKind.LINK):
            self.fault = before
        steady_s, vehicle_s = self.since_s
        if max(now_s - steady_s, known.vehicle_s - vehicle_s) > self.hold_s:
            return "ends"
        return "lasts" if self.fault is before else "turns"
