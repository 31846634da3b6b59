"""Decisions during take-off and during a step."""

from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.landing import Decision, finish
from uav_dc_ros.offboard.mission.progress import MissionProgress
from uav_dc_ros.offboard.mission.stall_detector import StallDetector
from uav_dc_ros.offboard.vehicle import TakeOff, Telemetry

REACHED = "cell reached"


class StepControl:
    """Detects the arrival at the start or at a step's cell, and steps that are late.

    Attributes:
        resumes_move: whether the vehicle has to complete the move that an earlier bridge began.
    """

    def __init__(self, progress: MissionProgress, settings: SafetySettings, stall: StallDetector) -> None:
        self._progress, self._settings, self._stall = progress, settings, stall
        self.resumes_move = progress.checkpoint.goal is not None
        self._dwell_since_s: float | None = None  # vehicle time

    def reset(self) -> None:
        """Start another phase."""
        self._dwell_since_s = None

    def take_off(
        self, telemetry: Telemetry, reason: str, setpoint: Enu | None, *, has_flown: bool
    ) -> Decision:
        """Decide in the phase `takeoff`, with its current reason and setpoint."""
        progress, position = self._progress, telemetry.position
        start = progress.target
        if position is not None and abs(position.up_m - start.up_m) <= self._settings.tolerance_m:
            setpoint = start  # at its altitude: the vehicle flies across
        if not self._dwells(telemetry):
            stands = telemetry.on_ground is not False and not has_flown
            return Decision(Phase.TAKEOFF, reason, setpoint, TakeOff(start.up_m) if stands else None)
        if self.resumes_move:
            self.resumes_move = False
            return self._complete(REACHED, setpoint)
        progress.cell = progress.goal
        return Decision(Phase.READY, f"at the start, cell {progress.cell}", setpoint)

    def fly(self, telemetry: Telemetry, reason: str, setpoint: Enu | None, since_s: float) -> Decision:
        """Decide in the phase `moving`, which began at `since_s`, with its current reason and setpoint."""
        position, step_s = telemetry.position, self._progress.scenario.mission.step_s
        if self._dwells(telemetry):
            return self._complete(REACHED, setpoint)
        if telemetry.vehicle_s - since_s >= step_s and position is not None:
            away_m = self._progress.distance_m(position)
            if away_m <= self._settings.tolerance_m:
                return self._complete(REACHED, setpoint)
            if self._progress.may_end_at(position, self._settings):
                result = f"cell not reached after {step_s:g} s, {away_m:.0f} m away"
                return self._complete(result, setpoint, reached=False)
            if not self._stall.is_late:
                self._stall.is_late = True
                reason = f"{reason}: {away_m:.0f} m away after {step_s:g} s, flies on"
        return Decision(Phase.MOVING, reason, setpoint)

    def _dwells(self, telemetry: Telemetry) -> bool:
        """Whether the vehicle has been at the goal for `dwell_s`."""
        position, settings = telemetry.position, self._settings
        if position is None or self._progress.distance_m(position) > settings.tolerance_m:
            self._dwell_since_s = None
            return False
        if self._dwell_since_s is None:
            self._dwell_since_s = telemetry.vehicle_s
        return telemetry.vehicle_s - self._dwell_since_s >= settings.dwell_s

    def _complete(self, result: str, setpoint: Enu | None, *, reached: bool = True) -> Decision:
        self._progress.complete_step(reached)
        if self._progress.is_done:
            return finish(self._progress, self._settings, result, setpoint)
        return Decision(Phase.READY, f"step {self._progress.step}: {result}", setpoint)
