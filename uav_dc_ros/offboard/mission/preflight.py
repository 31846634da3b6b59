"""Decisions before the first step: while the bridge connects, checks the vehicle and arms it."""

from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.datums import disagreement
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import FaultDetector, SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence, limit_conflict, limit_warnings
from uav_dc_ros.offboard.mission.keep_out import return_conflict
from uav_dc_ros.offboard.mission.landing import LANDING_MODES, Decision, finish
from uav_dc_ros.offboard.mission.progress import MissionProgress
from uav_dc_ros.offboard.vehicle import Arm, Command, Limits, Mode, SetMode, Telemetry

NO_POSITION_S = 5.0  # a vehicle in the air whose grid position is unknown for longer is refused, steady clock

NO_GLOBAL_POSITION = "the scenario has datum_deg, and the vehicle reports no global position; expected one"


class Preflight:
    """Decides for a vehicle that does not fly the mission yet."""

    def __init__(
        self, progress: MissionProgress, settings: SafetySettings, fence: Geofence, detector: FaultDetector
    ) -> None:
        self.progress, self.settings, self.fence, self.detector = progress, settings, fence, detector
        self.checkpoint = progress.checkpoint
        # With `SafetySettings.arm`, the one mode besides the commanded one that is no takeover: that of the
        # moment when the commanded mode was requested, or the commanded mode itself once the vehicle was in
        # it. None: every mode is allowed.
        self.allowed_mode = self.checkpoint.allowed_mode
        # A pilot has armed or disarmed the vehicle; the bridge does not arm it then.
        self.pilot_has_control = self.checkpoint.pilot_has_control
        self._was_armed = False
        self._returns: tuple[object, str | None] | None = None  # see `_on_return`
        self._no_position_since_s: float | None = None  # steady clock, of a vehicle in the air

    def takeover(self, now_s: float, telemetry: Telemetry) -> str | None:
        """A change of the mode that takes the vehicle over; None: there was none.

        Without `SafetySettings.arm` the bridge requests no mode, and a pilot may change it until take-off.
        """
        self.pilot_has_control |= self._was_armed and not telemetry.armed
        self._was_armed = telemetry.armed
        if not self.settings.arm or self.pilot_has_control or self.detector.link_lost(now_s, telemetry):
            return None
        mode = telemetry.mode_text
        if telemetry.mode is Mode.COMMANDED:
            self.allowed_mode = mode
        elif self.allowed_mode not in (None, mode):
            after = "" if telemetry.missing is None else f" (after: {telemetry.missing})"
            return f"mode {mode} before take-off: changed by a pilot or by the autopilot's failsafe{after}"
        return None

    def connect(self, now_s: float, telemetry: Telemetry, waited_s: float) -> Decision:
        """Decide in the phase `connecting`, which has lasted for `waited_s`, steady clock."""
        was_airborne, settings = self.checkpoint.airborne, self.settings
        self.pilot_has_control |= telemetry.armed and telemetry.mode is not Mode.COMMANDED
        if not was_airborne and (refusal := self._refusal(telemetry)) is not None:
            return Decision(Phase.ABORTED, refusal)
        fault, position = self.detector.fault(now_s, telemetry), telemetry.position
        if telemetry.missing is not None or fault is not None or position is None:
            reason = telemetry.missing or (fault.text if fault is not None else "no position yet")
            return self._wait(now_s, telemetry, reason, waited_s)
        if not was_airborne and telemetry.datum is None and self.progress.scenario.datum_deg is not None:
            return self._wait(now_s, telemetry, NO_GLOBAL_POSITION, waited_s)
        breach = self.fence.breach(position)
        if was_airborne and (decision := self._after_restart(telemetry, breach)) is not None:
            return decision
        flies = telemetry.in_the_air and telemetry.mode is Mode.COMMANDED
        if breach is not None:
            reason = f"the vehicle is outside the fence: {breach}"
            if flies:
                reason += " (it flies: the bridge leaves it alone); expected it inside, or another --datum"
            return Decision(Phase.ABORTED if flies else Phase.CONNECTING, reason)
        if flies and settings.flying_at_start == "land":
            reason, mode = "in the air when the bridge started", settings.failsafe_action
            return Decision(Phase.LANDING, reason, position, landing_mode=mode)
        if flies and (blocked := self._way_to_start(telemetry)) is not None:
            reason, mode = f"in the air when the bridge started: {blocked}", settings.failsafe_action
            return Decision(Phase.LANDING, reason, position, landing_mode=mode)
        if flies:
            reason = f"in the air when the bridge started: flies to cell {self.progress.goal}"
            return self._fly_to_start(telemetry, reason)
        # An autopilot may require a setpoint stream before it accepts the commanded mode.
        reason = f"connected to {telemetry.system}" if telemetry.system else "connected"
        return Decision(Phase.PREFLIGHT, reason, setpoint=position)

    def _wait(self, now_s: float, telemetry: Telemetry, reason: str, waited_s: float) -> Decision:
        """Wait for what is missing; a vehicle in the air for a limited time only."""
        lost = self.detector.link_lost(now_s, telemetry)
        no_position = not lost and telemetry.in_the_air and telemetry.position is None
        since_s = self._no_position_since_s = (self._no_position_since_s or now_s) if no_position else None
        if self.checkpoint.airborne:
            if waited_s > self.settings.link_lost_timeout_s:
                reason = f"{reason}; waited {waited_s:.0f} s"
                if lost or not telemetry.armed or self._is_taken_over(telemetry):
                    return Decision(Phase.ABORTED, reason)
                return self._land(telemetry, reason)
        elif since_s is not None and now_s - since_s > NO_POSITION_S:
            reason = f"the vehicle flies, and its position on the grid is not known ({reason}); expected "
            return Decision(Phase.ABORTED, f"{reason}--datum=LAT,LON,ALT, or the vehicle on the ground")
        return Decision(Phase.CONNECTING, reason)

    def _is_taken_over(self, telemetry: Telemetry) -> bool:
        """Whether another controller has the vehicle of a mission that was in the air before a restart."""
        before = self.checkpoint
        if before.released:
            return telemetry.mode not in LANDING_MODES
        return before.landing_confirmed and telemetry.mode is Mode.COMMANDED

    def _land(self, telemetry: Telemetry, reason: str, outcome: Phase = Phase.ABORTED) -> Decision:
        """Continue the landing that an earlier bridge began, or begin one."""
        before = self.checkpoint
        mode = before.landing_mode or self.settings.failsafe_action
        if telemetry.mode in LANDING_MODES:
            mode = telemetry.mode
        sent = before.landing_requested and before.landing_mode is telemetry.mode
        return Decision(Phase.LANDING, reason, landing_mode=mode, outcome=outcome, landing_requested=sent)

    def _after_restart(self, telemetry: Telemetry, breach: str | None) -> Decision | None:
        """Why a mission that was in the air ends, or continues its landing; None: it is resumed."""
        before, mode = self.checkpoint, telemetry.mode
        now = f"in mode {telemetry.mode_text} when the bridge restarted"
        if before.released and not (telemetry.armed and mode in LANDING_MODES):
            return Decision(before.outcome or Phase.ABORTED, before.reason)
        if telemetry.armed and self._is_taken_over(telemetry):
            return Decision(Phase.ABORTED, f"{before.reason}; {now}")
        if before.outcome is not None and (telemetry.armed or before.outcome is Phase.LANDED):
            return self._land(telemetry, before.reason, before.outcome)
        if not telemetry.armed:  # the bridge never arms a second time
            reason = before.reason or "on the ground and disarmed when the bridge restarted"
            return Decision(before.outcome or Phase.ABORTED, reason)
        if mode in LANDING_MODES:
            return Decision(Phase.LANDING, now, landing_mode=mode)
        if mode is not Mode.COMMANDED:
            return Decision(Phase.ABORTED, now)
        if breach is not None:
            reason = f"outside the fence when the bridge restarted: {breach}"
            return Decision(Phase.LANDING, reason, landing_mode=self.settings.failsafe_action)
        return None

    def prepare(self, now_s: float, telemetry: Telemetry) -> Decision:
        """Decide in the phase `preflight`."""
        is_commanded = telemetry.mode is Mode.COMMANDED
        self.pilot_has_control |= telemetry.armed and not is_commanded
        here, fault = telemetry.position, self.detector.fault(now_s, telemetry)
        may_take_off = telemetry.armed and is_commanded
        if not may_take_off:
            if self.checkpoint.airborne and (decision := self._after_restart(telemetry, None)) is not None:
                return decision  # it was armed before
            if (refusal := self._refusal(telemetry)) is not None:
                return Decision(Phase.ABORTED, refusal)
        if telemetry.missing is not None:
            return Decision(Phase.CONNECTING, telemetry.missing)
        if may_take_off:
            return self._take_off(telemetry)
        wrong = None if here is None else self.fence.breach(here)
        if fault is not None:
            wrong = fault.text
        if wrong is not None:
            return Decision(Phase.CONNECTING, wrong)
        command: Command | None = None
        if telemetry.armed:
            reason = f"a pilot flies: mode {telemetry.mode_text}"
        elif (low := self.detector.battery.fault(telemetry)) is not None:
            reason = low
        elif self.pilot_has_control:
            reason = "a pilot had control: waiting for a pilot to set the mode and arm"
        elif not self.settings.arm:
            reason = "waiting for a pilot to set the mode and arm (with --arm the bridge does it)"
        else:
            reason = telemetry.refusal or "sets the mode and arms"
            command = Arm() if is_commanded else SetMode(Mode.COMMANDED)
            self.allowed_mode = self.allowed_mode or telemetry.mode_text
        reason = "; ".join([reason, *self.warnings(telemetry)])
        return Decision(Phase.PREFLIGHT, reason, setpoint=here, command=command)

    def _take_off(self, telemetry: Telemetry) -> Decision:
        """Begin with a vehicle that is armed in the commanded mode."""
        breach, wrong = self.fence.breach(self._above(telemetry)), self._conflict(telemetry)
        if breach is not None:
            wrong = f"the target is outside the fence: {breach}"
        if (wrong := wrong or self._way_to_start(telemetry)) is not None:
            mode = Mode.LAND if telemetry.on_ground else self.settings.failsafe_action
            return Decision(Phase.LANDING, wrong, landing_mode=mode)
        return self._fly_to_start(telemetry, "armed, in the commanded mode")

    def _fly_to_start(self, telemetry: Telemetry, reason: str) -> Decision:
        setpoint = self._above(telemetry)
        if self.progress.is_done:
            return finish(self.progress, self.settings, "when the bridge restarted", setpoint)
        return Decision(Phase.TAKEOFF, reason, setpoint)

    def _way_to_start(self, telemetry: Telemetry) -> str | None:
        """The obstacle on the way up, or down, and across to the goal; None: none."""
        above, target = self._above(telemetry), self.progress.target
        more_m = self.settings.tolerance_m
        for start, end in ((telemetry.position or above, above), (above, target)):
            if (breach := self.fence.path_breach(start, end, more_m)) is not None:
                return f"the way to cell {self.progress.goal} is outside the fence: {breach}"
        return None

    def _above(self, telemetry: Telemetry) -> Enu:
        """The vehicle's position at the goal's altitude: it climbs or descends first, then flies across."""
        here, target = telemetry.position, self.progress.target
        return target if here is None else target._replace(east_m=here.east_m, north_m=here.north_m)

    def warnings(self, telemetry: Telemetry) -> list[str]:
        """Warnings that do not prevent the flight."""
        limits, scenario = telemetry.limits, self.progress.scenario
        found = [] if limits is None else limit_warnings(scenario, self.settings, limits)
        if (other := other_controller(telemetry)) is not None:
            found.append(other)
        return found

    def _refusal(self, telemetry: Telemetry) -> str | None:
        """Why the mission cannot be flown with this vehicle; None: it can."""
        refusal = other_controller(telemetry) or telemetry.fence_refusal or self._elsewhere(telemetry)
        return refusal or self._conflict(telemetry)

    def _elsewhere(self, telemetry: Telemetry) -> str | None:
        """How far the grid lies from where the scenario has it; None: nowhere else."""
        return None if telemetry.datum is None else disagreement(telemetry.datum, self.progress.scenario)

    def _conflict(self, telemetry: Telemetry) -> str | None:
        """The autopilot's limit that excludes a cell. Arming moves home to the vehicle's position."""
        home = telemetry.home if telemetry.armed else telemetry.position or telemetry.home
        if home is None:
            return None
        if self.fence.obstacles and (obstacle := self._on_return(telemetry.limits, home)) is not None:
            return obstacle
        if telemetry.limits is None:
            return None
        return limit_conflict(self.progress.scenario, self.settings, telemetry.limits, home)

    def _on_return(self, limits: Limits | None, home: Enu) -> str | None:
        """The obstacle on a way home or down; checked anew when home has moved by a metre."""
        key = limits, Enu(*map(round, home))
        if self._returns is None or self._returns[0] != key:
            conflict = return_conflict(self.progress.scenario, self.fence, self.settings, limits, home)
            self._returns = key, conflict
        return self._returns[1]


def other_controller(telemetry: Telemetry) -> str | None:
    """Text on another system that commands the vehicle; None: there is none."""
    other = telemetry.other_controller
    return None if other is None else f"another system commands this vehicle: {other}"
