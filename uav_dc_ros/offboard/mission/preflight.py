"""A mission before its first step: what a look at the vehicle leads to, while it is connected and made ready.

Nothing here is done: each look ends in a `Next`, which the bridge carries out.
"""

from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission import field_check
from uav_dc_ros.offboard.mission.fault_detector import FaultDetector, SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.mission.landing import DOWN, Next
from uav_dc_ros.offboard.mission.progress import MissionProgress
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, Telemetry

UNPLACED_S = 5.0  # after which a vehicle that flies has no place on the grid, though a link has told of it


class Preflight:
    """Looks at a vehicle that does not fly the mission yet.

    Args:
        course: of the mission.
        settings: how carefully to fly.
        fence: where it may be.
        watch: finds what is wrong.

    Attributes:
        allowed_mode: with `Settings.arm`, the one mode besides the commanded one that the vehicle may be in:
            that in which it was when the commanded mode was requested. The commanded mode's name: the vehicle
            was in that already. None: neither has happened yet, and every mode is allowed.
        is_a_pilots: had somebody else it armed, or disarmed it? Then it is not to start again by itself.
    """

    def __init__(
        self, course: MissionProgress, settings: SafetySettings, fence: Geofence, watch: FaultDetector
    ) -> None:
        self.course, self.settings, self.fence, self.watch = course, settings, fence, watch
        self.allowed_mode = course.standing.allowed_mode
        self.is_a_pilots = course.standing.is_a_pilots
        self._was_armed = False
        self._unplaced_since_s: float | None = None  # steady clock: it flies, and nobody knows where

    def takeover(self, now_s: float, known: Telemetry) -> str | None:
        """Why somebody else has a vehicle that is to be armed here; None: nobody has.

        Who chooses another mode after the commanded one was requested, or entered, takes the vehicle back.
        Without `Settings.arm` nothing is requested, and a pilot is free to change modes until take-off.
        """
        self.is_a_pilots |= self._was_armed and not known.armed  # by whoever disarmed it
        self._was_armed = known.armed
        if not self.settings.arm or self.is_a_pilots or self.watch.link_is_lost(now_s, known):
            return None
        mode = _name(known)
        if known.mode is Mode.COMMANDED:
            self.allowed_mode = mode
        elif self.allowed_mode not in (None, mode):
            after = "" if known.missing is None else f" (after: {known.missing})"
            return f"mode {mode} before take-off: changed by a pilot or by the autopilot's failsafe{after}"
        return None

    def refusal(self, known: Telemetry) -> str | None:
        """Why the mission cannot be flown with this vehicle as it is; None: it can."""
        return rival(known) or self._misfit(known)

    def connect(self, now_s: float, known: Telemetry, waited_s: float) -> Next:
        """Look at a vehicle that nothing is known of yet.

        Args:
            now_s: steady clock.
            known: of the vehicle.
            waited_s: for it, until now, steady clock.
        """
        flew, settings = self.course.standing.flies, self.settings
        self.is_a_pilots |= known.armed and known.mode is not Mode.COMMANDED
        if not flew and (why := self.refusal(known)) is not None:
            return Next(phase=Phase.ABORTED, why=why)
        fault = self.watch.fault(now_s, known)
        if known.missing is not None or fault is not None or known.position is None:
            why = known.missing or (fault.why if fault is not None else "no position yet")
            return self._not_yet(now_s, known, why, waited_s)
        breach = self.fence.breach(known.position)
        if flew and (otherwise := self._left_alone(known, breach)) is not None:
            return otherwise
        flies = known.armed and known.on_ground is False and known.mode is Mode.COMMANDED
        if breach is not None:
            why = f"the vehicle is outside the fence: {breach}"
            if flies:
                why = f"{why}. It flies, and is left alone; expected it on the field, or another --datum"
            return Next(phase=Phase.ABORTED if flies else Phase.CONNECTING, why=why)
        if flies:
            if settings.flying_at_start == "land":
                why = "it flew already when the bridge came"
                return Next(
                    phase=Phase.LANDING, why=why, setpoint=known.position, down=settings.failsafe_action
                )
            why = "it flies already: to the cell where the mission stands"
            return Next(phase=Phase.TAKEOFF, why=why, setpoint=self._above(known))
        # An autopilot may want to see setpoints before it follows any.
        why = f"connected to {known.system}" if known.system else "connected"
        return Next(phase=Phase.PREFLIGHT, why=why, setpoint=known.position)

    def _not_yet(self, now_s: float, known: Telemetry, why: str, waited_s: float) -> Next:
        """Wait for what is missing; but a vehicle in the air is not waited for without end."""
        lost = self.watch.link_is_lost(now_s, known)
        unplaced = not lost and known.armed and known.on_ground is False and known.position is None
        since_s = self._unplaced_since_s = (self._unplaced_since_s or now_s) if unplaced else None
        if self.course.standing.flies:
            if waited_s > self.settings.link_lost_timeout_s:
                why = f"{why}; waited {waited_s:.0f} s"
                left_alone = lost or not known.armed or self._is_anothers(known)
                return Next(phase=Phase.ABORTED, why=why) if left_alone else self._down(known, why)
        elif since_s is not None and now_s - since_s > UNPLACED_S:
            why = f"the vehicle flies, and its place on the grid is not known ({why})"
            return Next(phase=Phase.ABORTED, why=f"{why}; expected --datum=LAT,LON,ALT, or it on the ground")
        return Next(phase=Phase.CONNECTING, why=why)

    def _is_anothers(self, known: Telemetry) -> bool:
        """Has somebody else the vehicle of a mission that was in the air, who flies it."""
        before = self.course.standing
        if before.released:
            return known.mode not in DOWN
        return before.obeyed and known.mode is Mode.COMMANDED  # an earlier bridge saw it coming down

    def _down(self, known: Telemetry, why: str, outcome: Phase = Phase.ABORTED) -> Next:
        """Go on coming down as it did before, or as it is told to."""
        before = self.course.standing
        down = known.mode if known.mode in DOWN else before.down or self.settings.failsafe_action
        asked = before.asked and before.down is known.mode
        return Next(phase=Phase.LANDING, why=why, down=down, outcome=outcome, asked=asked)

    def _left_alone(self, known: Telemetry, breach: str | None) -> Next | None:
        """Why a mission that was in the air is not taken up again, or goes on coming down; None: it is."""
        before = self.course.standing
        if before.released and not (known.armed and known.mode in DOWN):
            return Next(phase=before.outcome or Phase.ABORTED, why=before.reason)
        if known.armed and self._is_anothers(known):
            why = f"{before.reason}; in mode {_name(known)} when the bridge came back"
            return Next(phase=Phase.ABORTED, why=why)
        if before.outcome is not None and (known.armed or before.outcome is Phase.LANDED):
            return self._down(known, before.reason, before.outcome)
        if not known.armed:  # it is never armed a second time
            why = before.reason or "on the ground and disarmed when the bridge came back"
            return Next(phase=before.outcome or Phase.ABORTED, why=why)
        if known.mode in DOWN:
            why = f"in mode {_name(known)} when the bridge came back"
            return Next(phase=Phase.LANDING, why=why, down=known.mode)
        if known.mode is not Mode.COMMANDED:
            return Next(phase=Phase.ABORTED, why=f"in mode {_name(known)} when the bridge came back")
        if breach is not None:
            why = f"outside the fence when the bridge came back: {breach}"
            return Next(phase=Phase.LANDING, why=why, down=self.settings.failsafe_action)
        return None

    def prepare(self, now_s: float, known: Telemetry) -> Next:
        """Look at a vehicle that is connected."""
        self.is_a_pilots |= known.armed and known.mode is not Mode.COMMANDED
        here, fault = known.position, self.watch.fault(now_s, known)
        ours = known.armed and known.mode is Mode.COMMANDED
        if not ours and self.course.standing.flies and (left := self._left_alone(known, None)) is not None:
            return left  # it was armed once
        if not ours and (why := self.refusal(known)) is not None:
            return Next(phase=Phase.ABORTED, why=why)
        if known.missing is not None:
            return Next(phase=Phase.CONNECTING, why=known.missing)
        if ours:
            return self._take_it(known)
        wrong = fault.why if fault is not None else self.fence.breach(here) if here is not None else None
        if wrong is not None:
            return Next(phase=Phase.CONNECTING, why=wrong)
        command: Command | None = None
        if known.armed:
            why = f"a pilot flies: mode {_name(known)}"
        elif (low := self.watch.battery_is_low(known)) is not None:
            why = low
        elif self.is_a_pilots:
            why = "a pilot had it: waiting for a pilot to set the mode and arm"
        elif not self.settings.arm:
            why = "waiting for a pilot to set the mode and arm (--arm does it here)"
        else:
            why = known.refusal or "sets the mode and arms"
            command = Arm() if known.mode is Mode.COMMANDED else SetMode(Mode.COMMANDED)
            self.allowed_mode = self.allowed_mode or _name(known)
        why = "; ".join([why, *self.warnings(known)])
        return Next(phase=Phase.PREFLIGHT, why=why, setpoint=here, command=command)

    def _take_it(self, known: Telemetry) -> Next:
        """Begin with a vehicle that is armed, in the commanded mode."""
        above = self._above(known)
        breach = self.fence.breach(above)
        why = f"the target is outside the fence: {breach}" if breach is not None else self._misfit(known)
        if why is not None:
            down = Mode.LAND if known.on_ground else self.settings.failsafe_action
            return Next(phase=Phase.LANDING, why=why, down=down)
        return Next(phase=Phase.TAKEOFF, why="armed, in the commanded mode", setpoint=above)

    def _above(self, known: Telemetry) -> Enu:
        """Straight up or down at the goal's altitude: from there, the vehicle flies across."""
        here, target = known.position, self.course.target
        return target if here is None else target._replace(east_m=here.east_m, north_m=here.north_m)

    def warnings(self, known: Telemetry) -> list[str]:
        """What a user should know, though it is no reason not to fly."""
        limits, scenario = known.limits, self.course.scenario
        found = [] if limits is None else field_check.warnings(scenario, self.settings, limits)
        if (other := rival(known)) is not None:
            found.append(other)
        return found

    def _misfit(self, known: Telemetry) -> str | None:
        """Which of the autopilot's own limits the field does not keep. Arming makes home where it stands."""
        home = known.home if known.armed else known.position or known.home
        if known.limits is None or home is None:
            return None
        return field_check.misfit(self.course.scenario, self.settings, known.limits, home)


def rival(known: Telemetry) -> str | None:
    """Who else commands the vehicle; None: nobody was seen."""
    who = known.other_controller
    return None if who is None else f"another system commands this vehicle: {who}"


def _name(known: Telemetry) -> str:
    """The autopilot's name of its mode."""
    return known.mode_name or known.mode.value
