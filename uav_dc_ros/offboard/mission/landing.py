"""Landing by return or land: requested until the mode changes, then monitored until the vehicle disarms."""

import math
from dataclasses import dataclass

from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import FaultDetector, SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.mission.progress import MissionProgress
from uav_dc_ros.offboard.mission.timeouts_and_retries import ProgressTimer
from uav_dc_ros.offboard.vehicle import Command, Mode, SetMode, Telemetry

LANDING_MODES = (Mode.LAND, Mode.RETURN)
NO_HOME_FACTOR = 10.0  # of the timeout of a return whose home position is not known
NEARER_M, VERTICAL_M, LOWER_M = 10.0, 5.0, 1.0  # minimum progress: to home; up or down; of a landing


@dataclass(frozen=True)
class Decision:
    """Result of a tick: the next phase, and what belongs to it."""

    phase: Phase
    reason: str
    setpoint: Enu | None = None  # to be streamed from now on, in the grid's ENU frame
    command: Command | None = None
    landing_mode: Mode = Mode.LAND  # of a landing that begins
    outcome: Phase = Phase.ABORTED  # of a landing that begins: final phase of the mission
    landing_requested: bool = False  # an earlier bridge has requested that mode


def finish(
    progress: MissionProgress, settings: SafetySettings, result: str, setpoint: Enu | None
) -> Decision:
    """The landing after the last step."""
    if progress.is_at_dock:
        reason = f"step {progress.step}: at the dock ({result})"
        return Decision(Phase.LANDING, reason, setpoint, outcome=Phase.LANDED)
    reason = f"step {progress.step}: out of {progress.used_up} away from the dock ({result})"
    mode = settings.failsafe_action
    return Decision(Phase.LANDING, reason, setpoint, landing_mode=mode, outcome=Phase.TIMEOUT)


class Landing:
    """One landing."""

    def __init__(
        self,
        progress: MissionProgress,
        detector: FaultDetector,
        fence: Geofence,
        mode: Mode,
        outcome: Phase,
        reason: str,
        blind_since_s: float | None = None,
    ) -> None:
        self._progress, self._detector, self._settings = progress, detector, detector.settings
        self._fence = fence
        self.mode, self.reason = mode, reason  # mode to request, reason of the landing
        self.outcome = outcome  # final phase of the mission
        self.confirmed = False  # the vehicle was in a landing mode; any later change of the mode is a pilot's
        self.requests = 0  # number of requests sent
        self._blind_since_s = blind_since_s  # steady clock: start of the position fault that is the reason
        self._replaces_return = False  # land is requested because the return makes no progress
        self._last_mode: Mode | None = None
        self._link_lost_since_s: float | None = None  # steady clock
        self._position_s: float | None = None  # arrival of the newest position
        self._updated_s: float | None = None  # steady time of the last new position
        self._disarmed_s: float | None = None  # steady time of the first disarmed state
        self._to_home, self._lower = ProgressTimer(NEARER_M), ProgressTimer(LOWER_M)
        self._upward, self._downward = ProgressTimer(VERTICAL_M), ProgressTimer(VERTICAL_M)
        self._timers = self._to_home, self._lower, self._upward, self._downward

    def confirm(self, telemetry: Telemetry) -> bool:
        """Whether the vehicle lands: as requested, or by its own failsafe or a pilot."""
        self.confirmed = self.confirmed or telemetry.mode in LANDING_MODES
        # A return after the requested land is a pilot's.
        self._replaces_return = self._replaces_return and telemetry.mode is not Mode.LAND
        return self.confirmed and not (self._replaces_return and telemetry.mode is Mode.RETURN)

    def allows(self, mode: Mode) -> bool:
        """Whether a mode is no takeover: a landing mode, or COMMANDED before the landing is confirmed."""
        return mode in LANDING_MODES or (mode is Mode.COMMANDED and not self.confirmed)

    def update(
        self, now_s: float, telemetry: Telemetry, setpoint: Enu | None, waited_s: float | None
    ) -> Decision:
        """Decide in one tick; the current setpoint is streamed until the landing is confirmed.

        `waited_s` is the time since return was requested last, see `CommandRetry`; None: it was not.
        """
        settings = self._settings
        if self._detector.link_lost(now_s, telemetry):
            return self._wait_for_link(now_s, telemetry, setpoint)
        self._link_lost_since_s = None
        if not telemetry.armed:
            return self._check_disarmed(now_s, telemetry)
        if self._detector.clock_stopped_for_s(now_s) > settings.link_lost_timeout_s:
            return self._abort(f"the vehicle's time has not advanced for {settings.link_lost_timeout_s:g} s")
        if (stall := self._stall(now_s, telemetry)) is not None:
            if not (telemetry.mode is self.mode is Mode.RETURN and self.requests):
                return self._abort(stall)
            self.mode, self._replaces_return = Mode.LAND, True
            self.reason += f"; {stall}: requests land"
            self._lower.reset()
            self._updated_s = now_s
        if self.confirm(telemetry):
            return Decision(Phase.LANDING, self.reason)
        answered = waited_s is None or waited_s >= settings.command_retry_s
        if self.mode is Mode.RETURN and self.requests >= settings.max_return_attempts and answered:
            self.mode = Mode.LAND
            self.reason += f"; return not executed ({telemetry.refusal or 'no answer'}): requests land"
        breach = self._fence.return_breach(settings, telemetry)
        if self.mode is Mode.RETURN and not self.requests and breach is not None:
            self.mode = Mode.LAND
            self.reason += f"; the straight way home comes {breach}: requests land"
        refusal = f"; {telemetry.refusal}" if telemetry.refusal and self.requests else ""
        return Decision(Phase.LANDING, f"{self.reason}{refusal}", setpoint, SetMode(self.mode))

    def _abort(self, text: str) -> Decision:
        return Decision(Phase.ABORTED, f"{self.reason}; {text}")

    def _wait_for_link(self, now_s: float, telemetry: Telemetry, setpoint: Enu | None) -> Decision:
        """Send no request: the current mode is not known."""
        settings, heartbeat_s = self._settings, telemetry.heartbeat_s
        for timer in self._timers:
            timer.pause()
        self._updated_s = None
        if self._blind_since_s is not None and (heartbeat_s or 0.0) <= self._blind_since_s:
            # Positions were missing because the link was lost.
            self.mode, self._blind_since_s = settings.failsafe_action, None
            self.reason = f"link lost: no heartbeat for {settings.heartbeat_timeout_s:g} s"
        if self._link_lost_since_s is None:
            self._link_lost_since_s = now_s if heartbeat_s is None else min(now_s, heartbeat_s)
        if now_s - self._link_lost_since_s > settings.link_lost_timeout_s:
            return self._abort(f"no heartbeat for {settings.link_lost_timeout_s:g} s")
        return Decision(Phase.LANDING, self.reason, setpoint)

    def _check_disarmed(self, now_s: float, telemetry: Telemetry) -> Decision:
        """Compare the position of a disarmed vehicle with the dock."""
        settings = self._settings
        if self.outcome is not Phase.LANDED:
            return Decision(self.outcome, self.reason)
        if self._disarmed_s is None:
            self._disarmed_s = now_s
        here, position_s = telemetry.position, telemetry.position_s
        if position_s is None or now_s - position_s > settings.position_timeout_s:
            here = None
        waits = now_s - self._disarmed_s <= settings.fault_timeout_s
        if waits and (here is None or telemetry.on_ground is False):
            # The other messages arrive after the heartbeat.
            return Decision(Phase.LANDING, self.reason)
        if telemetry.on_ground is False:
            return self._abort("disarmed in the air")
        if here is None:
            return self._abort("disarmed at an unknown position")
        off_m, limit_m = self._progress.dock_distance_m(here), settings.landing_radius_m
        if off_m > limit_m:
            return self._abort(f"landed {off_m:.0f} m from the dock; expected at most {limit_m:g} m")
        return Decision(Phase.LANDED, self.reason)

    def _stall(self, now_s: float, telemetry: Telemetry) -> str | None:
        """Missing progress of an armed vehicle with a link; None: it makes progress."""
        settings, here, home = self._settings, telemetry.position, telemetry.home
        vehicle_s, is_return = telemetry.vehicle_s, telemetry.mode is Mode.RETURN
        if telemetry.mode is not self._last_mode:
            self._last_mode = telemetry.mode
            for timer in self._timers:
                timer.reset()
        if here is None or telemetry.position_s == self._position_s:
            self._updated_s = now_s if self._updated_s is None else self._updated_s
            lost = now_s - self._updated_s > settings.link_lost_timeout_s
            return f"no position for {settings.link_lost_timeout_s:g} s" if lost else None
        self._position_s, self._updated_s = telemetry.position_s, now_s
        away_m = math.dist(here[:2], home[:2]) if home is not None else 0.0
        return_s = min(
            self._to_home.update(away_m, vehicle_s),
            self._upward.update(-here.up_m, vehicle_s),
            self._downward.update(here.up_m, vehicle_s),
        )
        landing_s = self._lower.update(here.up_m, vehicle_s)
        if is_return and not telemetry.on_ground and not self._replaces_return:
            limit_s = settings.return_progress_timeout_s * (1.0 if home is not None else NO_HOME_FACTOR)
            far = f" ({away_m:.0f} m from home)" if home is not None else ""
            return None if return_s <= limit_s else f"return makes no progress for {limit_s:g} s{far}"
        limit_s = settings.landing_progress_timeout_s
        text = f"in mode {telemetry.mode_text} neither descended nor disarmed for {limit_s:g} s"
        return text if landing_s > limit_s else None
