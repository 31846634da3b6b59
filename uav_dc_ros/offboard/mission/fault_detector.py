"""Safety settings; faults of link, position estimate, position, clock and battery; crashes."""

import math
from dataclasses import dataclass
from typing import Literal

from uav_dc_ros.messages import FaultKind
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.battery import BatteryMonitor
from uav_dc_ros.offboard.mission.plausibility import PlausibilityFilter
from uav_dc_ros.offboard.vehicle import Mode, Telemetry

ESTIMATE_AGE_S = 3.0  # maximum age of the last report on the estimate, steady clock
HEARTBEATS_S = 1.5  # a link is alive while its last heartbeat is that much newer than another message
CLOCK_S = 3.0  # steady time for which the vehicle's time may not advance


@dataclass(frozen=True, kw_only=True)
class SafetySettings:
    """ROS parameters of the bridge, of the same names. Times are vehicle time where no clock is named."""

    arm: bool = False  # the bridge sets the mode and arms; otherwise it waits for a pilot to do so
    tolerance_m: float = 2.0  # within it the vehicle is at a cell's centre
    dwell_s: float = 0.5  # time at the centre that completes a step
    position_timeout_s: float = 0.5  # maximum age, steady clock
    heartbeat_timeout_s: float = 3.0  # maximum age, steady clock
    policy_timeout_steps: float = 2.0  # maximum time without a move, in durations of a step
    policy_timeout_s: float = 5.0  # its minimum on the steady clock: simulations may be faster than policies
    max_speed_mps: float = 20.0  # a position that requires a higher speed has jumped
    max_position_jump_m: float = 5.0  # jump that is accepted besides
    fault_timeout_s: float = 5.0  # duration of a fault that ends the mission, on either clock
    link_lost_timeout_s: float = 300.0  # steady clock; a landing from 200 m takes two and a half minutes
    min_battery: float = 0.2  # charge, 0 to 1; 0: only the autopilot monitors the battery
    failsafe_action: Literal[Mode.RETURN, Mode.LAND] = Mode.RETURN  # land if it cannot return
    # Altitude above home at which the autopilot returns, metres; needed among obstacles. 0: not known
    return_altitude_m: float = 0.0
    land_if_return_blocked: bool = False  # where an obstacle is on the straight way home, and none below
    flying_at_start: Literal["resume", "land"] = "resume"  # for a vehicle in the air in the commanded mode
    command_retry_s: float = 2.0  # pause before a command that was not executed is sent again
    max_return_attempts: int = 3  # then the bridge requests land
    takeoff_timeout_s: float = 300.0  # of the phase, until the start is reached
    max_offset_cells: float = 0.5  # a step may end there late; 0.5: the goal is the nearest cell
    progress_timeout_s: float = 5.0  # time to come nearer to the goal, in a step that is late
    target_timeout_s: float = 5.0  # for which the autopilot may report another target than the setpoint
    landing_radius_m: float = 5.0  # horizontal distance from the dock
    return_progress_timeout_s: float = 30.0  # time to come nearer to home, climb or descend; then land
    landing_progress_timeout_s: float = 120.0  # time to descend or disarm; then the mission ends
    max_tilt_deg: float = 70.0
    max_sink_m: float = 10.0  # below both the setpoint and the highest altitude of the phase
    crash_timeout_s: float = 1.0  # duration of tilt, sink or ground contact that is a crash


@dataclass(frozen=True)
class Fault:
    """A current fault, and its description."""

    kind: FaultKind
    text: str


class FaultDetector:
    """Detects faults in the telemetry of one vehicle; `at_rest_v` and `home` are those of the checkpoint."""

    def __init__(
        self, settings: SafetySettings, at_rest_v: float | None = None, home: Enu | None = None
    ) -> None:
        self.settings = settings
        self.battery = BatteryMonitor(settings.min_battery, at_rest_v)
        self.home = home  # position of the vehicle when it was armed; None: not known
        self._filter = PlausibilityFilter(settings.max_speed_mps, settings.max_position_jump_m)
        self.discarded = self._filter.discarded  # number of discarded values by reason
        self._heartbeat_s: float | None = None
        self._link_since_s = 0.0  # steady clock: start of the current sequence of heartbeats without a gap
        self._clock: tuple[float, float] | None = None  # vehicle time, and steady time of its last advance

    def update(self, now_s: float, telemetry: Telemetry) -> Telemetry:
        """Take in the telemetry of a tick; returns it without impossible values, and with a home position."""
        telemetry = self._filter.filter(now_s, telemetry)
        heartbeat_s, last_s = telemetry.heartbeat_s, self._heartbeat_s
        if heartbeat_s is not None and heartbeat_s != last_s:
            self._heartbeat_s = heartbeat_s
            if last_s is None or heartbeat_s - last_s > self.settings.heartbeat_timeout_s:
                self._link_since_s = heartbeat_s
        if self._clock is None or telemetry.vehicle_s > self._clock[0]:
            self._clock = telemetry.vehicle_s, now_s
        if not telemetry.armed and telemetry.on_ground is not False and telemetry.position is not None:
            self.home = telemetry.position
        return telemetry.replace(home=telemetry.home or self.home)

    def link_lost(self, now_s: float, telemetry: Telemetry) -> bool:
        """Whether the last heartbeat is older than `heartbeat_timeout_s`."""
        heartbeat_s = telemetry.heartbeat_s
        return heartbeat_s is None or now_s - heartbeat_s > self.settings.heartbeat_timeout_s

    def estimate_lost(self, now_s: float, telemetry: Telemetry) -> bool:
        """Whether the autopilot has lost its position estimate, or reports none while the link is alive."""
        heartbeat_s, estimate_s = telemetry.heartbeat_s, telemetry.estimate_s
        if telemetry.estimate_ok or self.link_lost(now_s, telemetry) or heartbeat_s is None:
            return False
        if estimate_s is None or now_s - estimate_s <= ESTIMATE_AGE_S:
            return True
        return heartbeat_s - max(estimate_s, self._link_since_s) > HEARTBEATS_S

    def landing_mode(self, now_s: float, telemetry: Telemetry) -> Mode:
        """Mode that ends a mission; without a position estimate the vehicle cannot return."""
        return Mode.LAND if self.estimate_lost(now_s, telemetry) else self.settings.failsafe_action

    def clock_stopped(self, now_s: float) -> bool:
        """Whether the vehicle's time has not advanced for `CLOCK_S`."""
        return self.clock_stopped_for_s(now_s) > CLOCK_S

    def clock_stopped_for_s(self, now_s: float) -> float:
        """Steady time since the vehicle's time advanced last."""
        return now_s - self._clock[1] if self._clock else 0.0

    def fault(self, now_s: float, telemetry: Telemetry) -> Fault | None:
        """The most important fault; None: there is none."""
        max_age_s, jump = self.settings.position_timeout_s, self._filter.jump
        position, position_s = telemetry.position, telemetry.position_s
        if self.link_lost(now_s, telemetry):
            text = f"link lost: no heartbeat for {self.settings.heartbeat_timeout_s:g} s"
            return Fault(FaultKind.LINK, text)
        if position is not None and self.estimate_lost(now_s, telemetry):  # positions may end with it
            return Fault(FaultKind.ESTIMATE, "the autopilot has lost its position estimate")
        if jump is not None and telemetry.vehicle_s - self._filter.accepted_s > max_age_s:
            return Fault(FaultKind.POSITION, jump)
        if position is None or position_s is None or now_s - position_s > max_age_s:
            return Fault(FaultKind.POSITION, jump or f"no position for {max_age_s:g} s")
        if self.clock_stopped(now_s):
            return Fault(FaultKind.CLOCK, f"the vehicle's time has not advanced for {CLOCK_S:g} s")
        return None


class CrashDetector:
    """Detects crashes in one phase after the other, by tilt, loss of altitude and ground contact."""

    def __init__(self, settings: SafetySettings) -> None:
        self._settings = settings
        self._since_s: dict[str, float] = {}  # vehicle time, by symptom
        self.begin(flies=False)

    def begin(self, flies: bool) -> None:
        """Start another phase; `flies`: the vehicle is in the air in all of it."""
        self.flies = flies  # the vehicle was in the air since the phase began, or its phase implies it
        self._min_setpoint_m, self._max_position_m = math.inf, -math.inf
        self._since_s.clear()

    def update(self, telemetry: Telemetry, setpoint: Enu | None) -> str | None:
        """The symptom that has lasted for `crash_timeout_s`; None: there is none, or it is not reported."""
        settings, position = self._settings, telemetry.position
        self.flies |= telemetry.on_ground is False
        symptoms: dict[str, str] = {}
        if telemetry.tilt_rad is not None:
            tilt_deg, limit_deg = math.degrees(telemetry.tilt_rad), settings.max_tilt_deg
            if tilt_deg > limit_deg:
                symptoms["tilt"] = f"tilted by {tilt_deg:.0f} degrees; expected at most {limit_deg:g}"
        if self.flies and telemetry.on_ground:
            symptoms["ground"] = "on the ground while it should fly"
        if self.flies and position is not None and setpoint is not None:
            self._min_setpoint_m = min(self._min_setpoint_m, setpoint.up_m)
            self._max_position_m = max(self._max_position_m, position.up_m)
            up_m, limit_m = position.up_m, settings.max_sink_m
            sink_m = min(self._min_setpoint_m, self._max_position_m) - up_m
            if sink_m > limit_m:
                symptoms["sink"] = f"at {up_m:.0f} m, {sink_m:.0f} m too low; expected at most {limit_m:g} m"
        self._since_s = {name: self._since_s.get(name, telemetry.vehicle_s) for name in symptoms}
        for name, text in symptoms.items():
            if telemetry.vehicle_s - self._since_s[name] > settings.crash_timeout_s:
                return text
        return None
