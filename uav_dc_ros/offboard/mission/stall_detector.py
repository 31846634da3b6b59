"""Detects a vehicle that makes no progress, or does not follow its setpoint."""

import math

from uav_dc_ros.messages import FaultKind
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import Fault, SafetySettings
from uav_dc_ros.offboard.mission.progress import MissionProgress
from uav_dc_ros.offboard.mission.timers import ProgressTimer
from uav_dc_ros.offboard.vehicle import Telemetry

NEARER_M = 1.0  # minimum progress towards the goal
TARGET_M = 1.0  # permitted difference of the autopilot's target and the setpoint, beyond `tolerance_m`


class StallDetector:
    """Checks the autopilot's target against the setpoint, and the progress towards the goal.

    Attributes:
        is_late: whether the time of the current step is over; from then on progress is required.
    """

    def __init__(self, progress: MissionProgress, settings: SafetySettings) -> None:
        self._progress, self._settings = progress, settings
        self._setpoint: Enu | None = None
        self._sent_s = 0.0  # steady clock: first time of the current setpoint
        self._timer = ProgressTimer(NEARER_M)
        self.reset()

    def reset(self) -> None:
        """Start another phase."""
        self.is_late = False
        self._deviates_since_s: float | None = None  # vehicle time: the autopilot reports another target
        self.resume()

    def resume(self) -> None:
        """Start anew to the same goal, after a stop on the way."""
        self._timer.reset()
        self._stall: Fault | None = None  # at the newest position
        self._position_s: float | None = None

    def set_setpoint(self, setpoint: Enu | None, now_s: float) -> None:
        """Note the setpoint that is streamed."""
        if setpoint != self._setpoint:
            self._setpoint, self._sent_s = setpoint, now_s

    def fault(self, telemetry: Telemetry, moves: bool) -> Fault | None:
        """A target that deviates from the setpoint, or, while the vehicle `moves`, missing progress."""
        return self._target_fault(telemetry) or (self._progress_fault(telemetry) if moves else None)

    def _target_fault(self, telemetry: Telemetry) -> Fault | None:
        target, target_s, setpoint = telemetry.target, telemetry.target_s, self._setpoint
        off_m = 0.0
        if target is not None and target_s is not None and setpoint is not None and target_s > self._sent_s:
            off_m = math.dist(target, setpoint)
        if off_m <= self._settings.tolerance_m + TARGET_M:
            self._deviates_since_s = None
            return None
        if self._deviates_since_s is None:
            self._deviates_since_s = telemetry.vehicle_s
        if telemetry.vehicle_s - self._deviates_since_s <= self._settings.target_timeout_s:
            return None
        text = f"the autopilot does not accept the setpoint: its target is {off_m:.0f} m away from it"
        return Fault(FaultKind.TARGET, text)

    def _progress_fault(self, telemetry: Telemetry) -> Fault | None:
        if telemetry.position is None or telemetry.position_s == self._position_s:
            return self._stall
        self._position_s = telemetry.position_s
        away_m, limit_s = self._progress.distance_m(telemetry.position), self._settings.progress_timeout_s
        stalled_s = self._timer.update(away_m, telemetry.vehicle_s)
        self._stall = None
        if self.is_late and stalled_s > limit_s:
            text = f"no nearer to cell {self._progress.goal} for {limit_s:g} s, {away_m:.0f} m away from it"
            self._stall = Fault(FaultKind.PROGRESS, text)
        return self._stall
