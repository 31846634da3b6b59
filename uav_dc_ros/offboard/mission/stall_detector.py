"""Whether a vehicle comes nearer to where it is to go, and goes where it is sent."""

import math

from uav_dc_ros.messages import FaultKind
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import Fault, SafetySettings
from uav_dc_ros.offboard.mission.progress import MissionProgress
from uav_dc_ros.offboard.vehicle import Telemetry

NEARER_M = 1.0  # by what a vehicle has to come nearer to count as doing so
TARGET_M = 1.0  # by what a target that the autopilot reports may differ from the setpoint, beyond tolerance


class Approach:
    """Of a distance, which has to fall.

    Args:
        least_m: by how much less than ever before counts.
    """

    def __init__(self, least_m: float) -> None:
        self._least_m = least_m
        self.begin()

    def begin(self) -> None:
        """Forget what was."""
        self._nearest_m: float | None = None
        self._since_s = self._seen_s = 0.0
        self._pauses = False

    def pause(self) -> None:
        """Do not count the time until the next look."""
        self._pauses = True

    def stalled_s(self, distance_m: float, vehicle_s: float) -> float:
        """Time since it fell last, vehicle time. To be asked often."""
        if self._pauses:
            self._since_s += vehicle_s - self._seen_s
        if self._nearest_m is None or distance_m <= self._nearest_m - self._least_m:
            self._nearest_m, self._since_s = distance_m, vehicle_s
        self._seen_s, self._pauses = vehicle_s, False
        return vehicle_s - self._since_s


class StallDetector:
    """How the vehicle follows its setpoint, and comes nearer to the goal.

    Args:
        course: of the mission.
        settings: how long it may not.

    Attributes:
        is_late: is the time of the step that it flies over? Then it has to come nearer.
    """

    def __init__(self, course: MissionProgress, settings: SafetySettings) -> None:
        self._course, self._settings = course, settings
        self._setpoint: Enu | None = None
        self._sent_s = 0.0  # steady clock: since when it is that
        self._progress = Approach(NEARER_M)
        self.begin()

    def begin(self) -> None:
        """Begin another phase."""
        self.is_late = False
        self._elsewhere_since_s: float | None = None  # vehicle time: the autopilot reports another target
        self.resume()

    def resume(self) -> None:
        """Fly to the goal again, after it was stopped on the way."""
        self._progress.begin()
        self._stall: Fault | None = None  # as of the newest position
        self._position_s: float | None = None

    def send(self, setpoint: Enu | None, now_s: float) -> None:
        """Note the setpoint that is streamed."""
        if setpoint != self._setpoint:
            self._setpoint, self._sent_s = setpoint, now_s

    def fault(self, known: Telemetry, moves: bool) -> Fault | None:
        """Does it not fly to where it is sent, or, while it `moves`, come no nearer."""
        return self._ignored(known) or (self._stalled(known) if moves else None)

    def _ignored(self, known: Telemetry) -> Fault | None:
        """Has the autopilot reported another target than the setpoint for too long."""
        target, target_s, setpoint = known.target, known.target_s, self._setpoint
        off_m = 0.0
        if target is not None and target_s is not None and setpoint is not None and target_s > self._sent_s:
            off_m = math.dist(target, setpoint)
        if off_m <= self._settings.tolerance_m + TARGET_M:
            self._elsewhere_since_s = None
            return None
        if self._elsewhere_since_s is None:
            self._elsewhere_since_s = known.vehicle_s
        if known.vehicle_s - self._elsewhere_since_s <= self._settings.target_timeout_s:
            return None
        why = f"the autopilot does not take its target: it reports one {off_m:.0f} m from the setpoint"
        return Fault(FaultKind.TARGET, why)

    def _stalled(self, known: Telemetry) -> Fault | None:
        """Does a vehicle that is late come no nearer to the goal. To be asked often while it moves."""
        if known.position is None or known.position_s == self._position_s:
            return self._stall
        self._position_s = known.position_s
        away_m, limit_s = self._course.distance_m(known.position), self._settings.progress_timeout_s
        if self._progress.stalled_s(away_m, known.vehicle_s) <= limit_s or not self.is_late:
            self._stall = None
            return None
        why = f"no nearer to cell {self._course.goal} for {limit_s:g} s, {away_m:.0f} m away from it"
        self._stall = Fault(FaultKind.PROGRESS, why)
        return self._stall
