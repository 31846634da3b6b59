"""A mission before its first step: what a look at the vehicle leads to, while it is connected and made ready.

Nothing here is done: each look ends in a `Next`, which the bridge carries out.
"""

from dataclasses import dataclass

from uav_dc_ros.autopilot.course import Course
from uav_dc_ros.autopilot.descent import DOWN
from uav_dc_ros.autopilot.fence import Fence
from uav_dc_ros.autopilot.frames import Enu
from uav_dc_ros.autopilot.vehicle import Arm, Mode, SetMode, Telemetry, Wish
from uav_dc_ros.autopilot.watch import Settings, Watch
from uav_dc_ros.messages import Phase


@dataclass(frozen=True, kw_only=True)
class Next:
    """What to do next.

    Attributes:
        phase: to be in; `landing` means to descend, and one that is over to end.
        why: in words.
        setpoint: to stream from now on, in the grid's ENU frame; None: none.
        wish: to utter; None: none.
        down: how to descend.
        outcome: of a mission that descends.
    """

    phase: Phase
    why: str
    setpoint: Enu | None = None
    wish: Wish | None = None
    down: Mode = Mode.LAND
    outcome: Phase = Phase.ABORTED


class Ground:
    """Looks at a vehicle that does not fly the mission yet.

    Args:
        course: of the mission.
        settings: how carefully to fly.
        fence: where it may be.
        watch: finds what is wrong.
    """

    def __init__(self, course: Course, settings: Settings, fence: Fence, watch: Watch) -> None:
        self.course, self.settings, self.fence, self.watch = course, settings, fence, watch
        self._is_a_pilots = False  # somebody else had it armed: who lands it does not want it to start again

    def connect(self, now_s: float, known: Telemetry) -> Next:
        """Look at a vehicle that nothing is known of yet, at a steady time."""
        self._is_a_pilots |= known.armed and known.mode is not Mode.COMMANDED
        fault = self.watch.fault(now_s, known)
        if known.missing is not None or fault is not None or known.position is None:
            return Next(phase=Phase.CONNECTING, why=known.missing or fault or "no position yet")
        breach = self.fence.breach(known.position)
        if self.course.standing.flies and (otherwise := self._left_alone(known, breach)) is not None:
            return otherwise
        if breach is not None:
            return Next(phase=Phase.CONNECTING, why=f"the vehicle is outside the fence: {breach}")
        if known.armed and known.on_ground is False and known.mode is Mode.COMMANDED:
            if self.settings.flying_at_start == "land":
                why = "it flew already when the bridge came"
                return Next(phase=Phase.LANDING, why=why, setpoint=known.position, down=self.settings.then)
            why = "it flies already: to the cell where the mission stands"
            return Next(phase=Phase.TAKEOFF, why=why, setpoint=self.course.target)
        # An autopilot may want to see setpoints before it follows any.
        why = f"connected to {known.system}" if known.system else "connected"
        return Next(phase=Phase.PREFLIGHT, why=why, setpoint=known.position)

    def _left_alone(self, known: Telemetry, breach: str | None) -> Next | None:
        """Why a mission that was in the air is not taken up again, or goes on coming down; None: it is."""
        before = self.course.standing
        if before.outcome is not None and known.armed:
            down = known.mode if known.mode in DOWN else self.settings.then
            return Next(phase=Phase.LANDING, why=before.reason, down=down, outcome=before.outcome)
        if not known.armed:  # it is never armed a second time
            why = before.reason or "on the ground and disarmed when the bridge came back"
            return Next(phase=before.outcome or Phase.ABORTED, why=why)
        if known.mode in DOWN:
            why = f"in mode {known.mode_name or known.mode.value} when the bridge came back"
            return Next(phase=Phase.LANDING, why=why, down=known.mode)
        if known.mode is not Mode.COMMANDED:
            why = f"in mode {known.mode_name or known.mode.value} when the bridge came back"
            return Next(phase=Phase.ABORTED, why=why)
        if breach is not None:
            why = f"outside the fence when the bridge came back: {breach}"
            return Next(phase=Phase.LANDING, why=why, down=self.settings.then)
        return None

    def prepare(self, now_s: float, known: Telemetry, begun: bool) -> Next:
        """Look at a vehicle that is connected.

        Args:
            now_s: steady clock.
            known: of the vehicle.
            begun: was it asked to arm?
        """
        self._is_a_pilots |= known.armed and known.mode is not Mode.COMMANDED
        here = known.position
        fault = self.watch.fault(now_s, known) or (self.fence.breach(here) if here is not None else None)
        ours = known.armed and known.mode is Mode.COMMANDED
        if fault is not None and not ours:
            return Next(phase=Phase.CONNECTING, why=known.missing or fault)
        if ours:
            target = self.course.target
            above = Enu(here.east_m, here.north_m, target.up_m) if here is not None else target
            if (breach := self.fence.breach(above)) is not None:
                why = f"the target is outside the fence: {breach}"
                return Next(phase=Phase.LANDING, why=why, setpoint=above, down=self.settings.then)
            return Next(phase=Phase.TAKEOFF, why="armed, in the commanded mode", setpoint=above)
        mode = known.mode_name or known.mode.value
        if known.armed and begun:
            return Next(phase=Phase.ABORTED, why=f"mode {mode} instead, before it took off: a pilot has it")
        if known.armed:
            why, wish = f"a pilot flies: mode {mode}", None
        elif (low := self.watch.battery_is_low(known)) is not None:
            why, wish = low, None
        elif self._is_a_pilots:
            why, wish = "a pilot had it: waiting for a pilot to set the mode and arm", None
        elif not self.settings.arm:
            why, wish = "waiting for a pilot to set the mode and arm (--arm does it here)", None
        else:
            why = known.refusal or "sets the mode and arms"
            wish = Arm() if known.mode is Mode.COMMANDED else SetMode(Mode.COMMANDED)
        return Next(phase=Phase.PREFLIGHT, why=why, setpoint=here, wish=wish)
