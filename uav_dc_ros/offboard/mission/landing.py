"""What brings a vehicle down: return or land, requested until it obeys, and then watched until it stands."""

import math
from dataclasses import dataclass

from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import FaultDetector
from uav_dc_ros.offboard.mission.progress import MissionProgress
from uav_dc_ros.offboard.mission.stall_detector import Approach
from uav_dc_ros.offboard.vehicle import Command, Mode, SetMode, Telemetry

DOWN = (Mode.LAND, Mode.RETURN)
HOMELESS = 10.0  # as many times as long is a return waited for whose home is not known
NEARER_M, VERTICAL_M, LOWER_M = 10.0, 5.0, 1.0  # what counts as progress: to home; up or down; of a landing


@dataclass(frozen=True, kw_only=True)
class Next:
    """What to do next.

    Attributes:
        phase: to be in; `landing` means to descend, and one that is over to end.
        why: in words.
        setpoint: to stream from now on, in the grid's ENU frame; None: none.
        command: to send; None: none.
        down: how to descend.
        outcome: of a mission that descends.
        asked: did an earlier bridge request that way down?
    """

    phase: Phase
    why: str
    setpoint: Enu | None = None
    command: Command | None = None
    down: Mode = Mode.LAND
    outcome: Phase = Phase.ABORTED
    asked: bool = False


class Landing:
    """One way down.

    Args:
        course: of the mission, which knows the dock.
        watch: finds what is wrong.
        how: the mode that it is to come down in.
        outcome: of the mission, once the vehicle stands.
        why: it comes down.
        blind_since_s: steady time since when no position came, if it comes down because of that.

    Attributes:
        obeyed: was it seen coming down? From then on it is let alone: who changes the mode now is the pilot.
        tries: how often it was asked.
    """

    def __init__(
        self,
        course: MissionProgress,
        watch: FaultDetector,
        how: Mode,
        outcome: Phase,
        why: str,
        blind_since_s: float | None = None,
    ) -> None:
        self._course, self._watch, self._settings = course, watch, watch.settings
        self.how, self.outcome, self.why = how, outcome, why
        self.obeyed, self.tries = False, 0
        self._blind_since_s = blind_since_s
        self._instead = False  # it is to land, since its return does not come home
        self._mode: Mode | None = None
        self._lost_since_s: float | None = None  # steady time: the link is lost
        self._seen_s: float | None = None  # steady time since when no new position came
        self._position_s: float | None = None  # when the newest came
        self._stood_s: float | None = None  # steady time when it was first seen disarmed
        self._to_home, self._lower = Approach(NEARER_M), Approach(LOWER_M)
        self._upward, self._downward = Approach(VERTICAL_M), Approach(VERTICAL_M)

    def obeys(self, known: Telemetry) -> bool:
        """Does it come down, as it was told or as its own failsafe or a pilot knows better."""
        self.obeyed = self.obeyed or known.mode in DOWN
        self._instead = self._instead and known.mode is not Mode.LAND  # who returns it then is a pilot
        return self.obeyed and not (self._instead and known.mode is Mode.RETURN)

    def is_ours(self, mode: Mode) -> bool:
        """Is a vehicle that shall come down in a mode that nobody else has chosen for something else."""
        return mode in DOWN or (mode is Mode.COMMANDED and not self.obeyed)

    def look(self, now_s: float, known: Telemetry, setpoint: Enu | None, waited_s: float | None) -> Next:
        """Look at a vehicle that is to come down.

        Args:
            now_s: steady clock.
            known: of the vehicle.
            setpoint: that is streamed; until the vehicle obeys, it holds it where it is.
            waited_s: since it was asked to return last, see `Asked`; None: it was not.
        """
        if self._watch.link_is_lost(now_s, known):
            return self._wait_for_link(now_s, known, setpoint)
        self._lost_since_s = None
        if not known.armed:
            return self._stand(now_s, known)
        if self._watch.clock_stands_for_s(now_s) > self._settings.link_lost_timeout_s:
            why = f"{self.why}; its clock has stood still for {self._settings.link_lost_timeout_s:g} s"
            return Next(phase=Phase.ABORTED, why=why)
        if (stall := self._stalls(now_s, known)) is not None:
            returns = known.mode is self.how is Mode.RETURN and self.tries  # as it was asked to
            if not returns:
                return Next(phase=Phase.ABORTED, why=f"{self.why}; {stall}")
            self._land_instead(now_s, f"{stall}: lands")
        if self.obeys(known):
            return Next(phase=Phase.LANDING, why=self.why)
        if self._refuses_to_return(waited_s):
            self.how = Mode.LAND
            self.why += f"; it does not return ({known.refusal or 'no answer'}): lands"
        refused = f"; {known.refusal}" if known.refusal and self.tries else ""
        return Next(
            phase=Phase.LANDING, why=f"{self.why}{refused}", setpoint=setpoint, command=SetMode(self.how)
        )

    def _wait_for_link(self, now_s: float, known: Telemetry, setpoint: Enu | None) -> Next:
        """Wait, for a while: who knows what mode it is in by now."""
        settings, heartbeat_s = self._settings, known.heartbeat_s
        for progress in (self._to_home, self._lower, self._upward, self._downward):
            progress.pause()
        self._seen_s = None
        if self._blind_since_s is not None and (heartbeat_s or 0.0) <= self._blind_since_s:
            # No position came because nothing came.
            self.how, self._blind_since_s = settings.failsafe_action, None
            self.why = f"link lost: no heartbeat for {settings.heartbeat_timeout_s:g} s"
        if self._lost_since_s is None:
            self._lost_since_s = now_s if heartbeat_s is None else min(now_s, heartbeat_s)
        if now_s - self._lost_since_s > settings.link_lost_timeout_s:
            why = f"{self.why}; not heard of for {settings.link_lost_timeout_s:g} s"
            return Next(phase=Phase.ABORTED, why=why)
        return Next(phase=Phase.LANDING, why=self.why, setpoint=setpoint)

    def _stand(self, now_s: float, known: Telemetry) -> Next:
        """Judge a vehicle that is disarmed: it has landed if its position is that of the dock."""
        settings, wrong = self._settings, None
        if self.outcome is not Phase.LANDED:
            return Next(phase=self.outcome, why=self.why)
        if self._stood_s is None:
            self._stood_s = now_s
        here = self._position(now_s, known)
        if (here is None or known.on_ground is False) and now_s - self._stood_s <= settings.fault_timeout_s:
            return Next(phase=Phase.LANDING, why=self.why)  # its other messages come after the heartbeat
        if known.on_ground is False:
            wrong = "disarmed in the air"
        elif here is None:
            wrong = "disarmed, and no position tells where"
        elif (off_m := self._course.dock_distance_m(here)) > settings.landing_radius_m:
            wrong = f"landed {off_m:.0f} m from the dock; expected at most {settings.landing_radius_m:g} m"
        if wrong is None:
            return Next(phase=Phase.LANDED, why=self.why)
        return Next(phase=Phase.ABORTED, why=f"{self.why}; {wrong}")

    def _position(self, now_s: float, known: Telemetry) -> Enu | None:
        """Where it is; None if the last position is too old to tell."""
        fresh = known.position_s is not None and now_s - known.position_s <= self._settings.position_timeout_s
        return known.position if fresh else None

    def _refuses_to_return(self, waited_s: float | None) -> bool:
        settings = self._settings
        answered = waited_s is None or waited_s >= settings.command_retry_s
        return self.how is Mode.RETURN and self.tries >= settings.max_return_attempts and answered

    def _land_instead(self, now_s: float, why: str) -> None:
        self.how, self._instead, self.why = Mode.LAND, True, f"{self.why}; {why}"
        self._lower.begin()
        self._seen_s = now_s

    def _stalls(self, now_s: float, known: Telemetry) -> str | None:
        """Why a vehicle that is armed, and in reach, does not come down; None: it does."""
        settings, here, home, vehicle_s = self._settings, known.position, known.home, known.vehicle_s
        if known.mode is not self._mode:
            self._mode = known.mode
            for progress in (self._to_home, self._lower, self._upward, self._downward):
                progress.begin()
        if here is None or known.position_s == self._position_s:  # nothing new
            self._seen_s = now_s if self._seen_s is None else self._seen_s
            blind = now_s - self._seen_s > settings.link_lost_timeout_s
            return f"no position for {settings.link_lost_timeout_s:g} s" if blind else None
        self._position_s, self._seen_s = known.position_s, now_s
        away_m = math.dist(here[:2], home[:2]) if home is not None else 0.0
        stalled_s = min(
            self._to_home.stalled_s(away_m, vehicle_s),
            self._upward.stalled_s(-here.up_m, vehicle_s),
            self._downward.stalled_s(here.up_m, vehicle_s),
        )
        landing_s = self._lower.stalled_s(here.up_m, vehicle_s)
        if known.mode is Mode.RETURN and not known.on_ground and not self._instead:
            limit_s = settings.return_progress_timeout_s * (1.0 if home is not None else HOMELESS)
            if stalled_s <= limit_s:
                return None
            far = f" ({away_m:.0f} m away)" if home is not None else ""
            return f"it returns, and has come no nearer to home{far} for {limit_s:g} s"
        if landing_s > settings.landing_progress_timeout_s:
            what = "it lands" if known.mode is Mode.LAND else f"mode {known.mode_name or known.mode.value}"
            limit_s = settings.landing_progress_timeout_s
            return f"{what}, and has neither descended nor disarmed for {limit_s:g} s"
        return None
