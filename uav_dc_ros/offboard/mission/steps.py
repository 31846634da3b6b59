"""Take-off and steps: arrival at the goal, steps that are late, and faults on the way to the goal."""

import math

from uav_dc_ros.messages import FaultKind, Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import Fault, SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.mission.landing import Decision, finish
from uav_dc_ros.offboard.mission.progress import MissionProgress
from uav_dc_ros.offboard.mission.timeouts_and_retries import ProgressTimer
from uav_dc_ros.offboard.vehicle import TakeOff, Telemetry

REACHED = "cell reached"
NEARER_M = 1.0  # minimum progress towards the goal
TARGET_M = 1.0  # permitted difference of the autopilot's target and the setpoint, beyond `tolerance_m`


class StepControl:
    """Decides whether the start or the goal of a step is reached, and detects faults on the way."""

    def __init__(self, progress: MissionProgress, settings: SafetySettings, fence: Geofence) -> None:
        self._progress, self._settings, self._fence = progress, settings, fence
        self.resumes_move = progress.checkpoint.goal is not None  # the move that an earlier bridge began
        self._setpoint: Enu | None = None
        self._sent_s = 0.0  # steady clock: first time of the current setpoint
        self._timer = ProgressTimer(NEARER_M)
        self.reset()

    def reset(self) -> None:
        """Start another phase."""
        self._is_late = False  # the time of the step is over: from then on progress is required
        self._dwells_since_s: float | None = None  # vehicle time: the vehicle is at the goal
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

    # Arrival.

    def take_off(self, telemetry: Telemetry, reason: str, setpoint: Enu | None, has_flown: bool) -> Decision:
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
            # Among obstacles it flies on: with its speed, the next move would leave the straight way.
            may_end = not self._fence.obstacles and self._progress.may_end_at(position, self._settings)
            if may_end:
                result = f"cell not reached after {step_s:g} s, {away_m:.0f} m away"
                return self._complete(result, setpoint, reached=False)
            if not self._is_late:
                self._is_late = True
                reason = f"{reason}: {away_m:.0f} m away after {step_s:g} s, flies on"
        return Decision(Phase.MOVING, reason, setpoint)

    def _dwells(self, telemetry: Telemetry) -> bool:
        """Whether the vehicle has been at the goal for `dwell_s`."""
        position, settings = telemetry.position, self._settings
        if position is None or self._progress.distance_m(position) > settings.tolerance_m:
            self._dwells_since_s = None
            return False
        if self._dwells_since_s is None:
            self._dwells_since_s = telemetry.vehicle_s
        return telemetry.vehicle_s - self._dwells_since_s >= settings.dwell_s

    def _complete(self, result: str, setpoint: Enu | None, *, reached: bool = True) -> Decision:
        self._progress.complete_step(reached)
        if self._progress.is_done:
            return finish(self._progress, self._settings, result, setpoint)
        return Decision(Phase.READY, f"step {self._progress.step}: {result}", setpoint)

    # Faults.

    def fault(self, telemetry: Telemetry, moves: bool) -> Fault | None:
        """A target that deviates from the setpoint, or, while the vehicle `moves`, missing progress."""
        target_fault = self.target_fault(telemetry, self._settings.target_timeout_s)
        return target_fault or (self._progress_fault(telemetry) if moves else None)

    def target_fault(self, telemetry: Telemetry, timeout_s: float) -> Fault | None:
        """A target that has deviated from the setpoint for longer than `timeout_s`."""
        target, target_s, setpoint = telemetry.target, telemetry.target_s, self._setpoint
        off_m = 0.0
        if target is not None and target_s is not None and setpoint is not None and target_s > self._sent_s:
            off_m = math.dist(target, setpoint)
        if off_m <= self._settings.tolerance_m + TARGET_M:
            self._deviates_since_s = None
            return None
        if self._deviates_since_s is None:
            self._deviates_since_s = telemetry.vehicle_s
        if telemetry.vehicle_s - self._deviates_since_s <= timeout_s:
            return None
        text = f"the autopilot does not accept the setpoint: its target is {off_m:.0f} m away from it"
        return Fault(FaultKind.TARGET, text)

    def _progress_fault(self, telemetry: Telemetry) -> Fault | None:
        if telemetry.position is None or telemetry.position_s == self._position_s:
            return self._stall
        self._position_s, self._stall = telemetry.position_s, None
        away_m, limit_s = self._progress.distance_m(telemetry.position), self._settings.progress_timeout_s
        stalled_s = self._timer.update(away_m, telemetry.vehicle_s)
        if self._is_late and stalled_s > limit_s:
            text = f"no nearer to cell {self._progress.goal} for {limit_s:g} s, {away_m:.0f} m away from it"
            self._stall = Fault(FaultKind.PROGRESS, text)
        return self._stall
