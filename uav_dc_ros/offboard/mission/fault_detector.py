"""How carefully to fly, and what keeps a vehicle from going on."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

from uav_dc_ros.messages import FaultKind
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.battery import Battery
from uav_dc_ros.offboard.mission.plausibility import Plausibility
from uav_dc_ros.offboard.vehicle import Mode, Telemetry

ESTIMATE_AGE_S = 3.0  # age after which the last report on an estimate says nothing, steady clock
HEARTBEATS_S = 1.5  # a link whose last heartbeat is that much younger than another message is alive
CLOCK_S = 3.0  # steady time for which the vehicle's own may stand still


@dataclass(frozen=True, kw_only=True)
class SafetySettings:
    """How carefully to fly.

    Attributes:
        arm: may the bridge set the mode, and arm? Otherwise it waits for a pilot to do so.
        tolerance_m: distance within which the vehicle is at a cell's centre.
        dwell_s: how long it must be there for a step to be done, vehicle time.
        position_timeout_s: age of the position after which nobody flies by it.
        heartbeat_timeout_s: age of the last heartbeat after which the link is lost.
        policy_timeout_steps: steps' time without a move after which the policy is given up, vehicle time.
        policy_timeout_s: but not before this time, steady clock: the policy does not think faster where a
            simulated vehicle's time does.
        max_speed_mps: no vehicle of this kind flies faster; a position that does has jumped.
        max_position_jump_m: how far a position may jump, metres, as estimates do now and then.
        fault_timeout_s: how long a fault may last before the mission ends, steady or vehicle time.
        link_lost_timeout_s: time without a heartbeat after which nobody waits for the vehicle to land; from
            200 m that takes two and a half minutes.
        min_battery: charge at which the mission ends, 0 to 1; 0: the battery is the autopilot's business.
        failsafe_action: what ends a mission that cannot go on. Without a position, and where the vehicle
            refuses to return, it is to land.
        flying_at_start: what to do with a vehicle that flies already, in the commanded mode.
        command_retry_s: pause before a command that was not executed is sent again, vehicle time.
        max_return_attempts: how often it is asked to return before it is asked to land.
        takeoff_timeout_s: longest time from the first command to take off until the start is reached, vehicle
            time.
        max_offset_cells: how far from the goal's centre, in cells, a step may end whose time is over; with
            0.5 the goal is the nearest cell. A vehicle that is farther away flies on.
        progress_timeout_s: time within which a vehicle that flies on after a step's time has to come nearer.
        target_timeout_s: time for which the autopilot may report another target than the one it was sent.
        landing_radius_m: horizontal distance from the dock within which the vehicle has landed there.
        return_progress_timeout_s: time within which a vehicle that returns has to come nearer to home, climb
            or descend; after it, it is to land.
        landing_progress_timeout_s: time within which a vehicle that lands has to come lower or disarm; after
            it, the mission is over all the same.
        max_tilt_deg: a vehicle that is tilted further does not fly any more.
        max_sink_m: how far it may be below both its setpoint and the altitude that it had on the way there.
        crash_timeout_s: how long it may be beyond one of these two, or on the ground while it should fly.
    """

    arm: bool = False
    tolerance_m: float = 2.0
    dwell_s: float = 0.5
    position_timeout_s: float = 0.5
    heartbeat_timeout_s: float = 3.0
    policy_timeout_steps: float = 2.0
    policy_timeout_s: float = 5.0
    max_speed_mps: float = 20.0
    max_position_jump_m: float = 5.0
    fault_timeout_s: float = 5.0
    link_lost_timeout_s: float = 300.0
    min_battery: float = 0.2
    failsafe_action: Literal[Mode.RETURN, Mode.LAND] = Mode.RETURN
    flying_at_start: Literal["resume", "land"] = "resume"
    command_retry_s: float = 2.0
    max_return_attempts: int = 3
    takeoff_timeout_s: float = 300.0
    max_offset_cells: float = 0.5
    progress_timeout_s: float = 5.0
    target_timeout_s: float = 5.0
    landing_radius_m: float = 5.0
    return_progress_timeout_s: float = 30.0
    landing_progress_timeout_s: float = 120.0
    max_tilt_deg: float = 70.0
    max_sink_m: float = 10.0
    crash_timeout_s: float = 1.0


@dataclass(frozen=True)
class Fault:
    """One that is present, and why, in words."""

    kind: FaultKind
    why: str


class FaultDetector:
    """Finds what is wrong with the telemetry of a vehicle.

    Args:
        settings: what is wrong, and what is not.
        at_rest_v: of the battery, see there.
        home: where the vehicle was armed, if that was before the bridge was started.

    Attributes:
        battery: judges it.
        home: where the vehicle stood last before it was armed; None: not seen.
    """

    def __init__(
        self, settings: SafetySettings, at_rest_v: float | None = None, home: Enu | None = None
    ) -> None:
        self.settings = settings
        self.battery = Battery(settings.min_battery, at_rest_v)
        self.home = home
        self._plausible = Plausibility(settings.max_speed_mps, settings.max_position_jump_m)
        self._heartbeat_s: float | None = None
        self._link_since_s = 0.0  # steady clock: since when heartbeats come without a gap
        self._clock: tuple[float, float] | None = None  # vehicle time, and when it passed last

    @property
    def discarded(self) -> dict[str, int]:
        """Telemetry that was left out, by reason."""
        return self._plausible.discarded

    def see(self, now_s: float, known: Telemetry) -> Telemetry:
        """Take in telemetry, at each tick; what is returned can be true, and has a home if one is known."""
        known = self._plausible.filter(now_s, known)
        if known.heartbeat_s is not None and known.heartbeat_s != self._heartbeat_s:
            last_s, self._heartbeat_s = self._heartbeat_s, known.heartbeat_s
            if last_s is None or known.heartbeat_s - last_s > self.settings.heartbeat_timeout_s:
                self._link_since_s = known.heartbeat_s
        if self._clock is None or known.vehicle_s > self._clock[0]:
            self._clock = known.vehicle_s, now_s
        if not known.armed and known.on_ground is not False and known.position is not None:
            self.home = known.position
        return dataclasses.replace(known, home=known.home or self.home)

    def link_is_lost(self, now_s: float, known: Telemetry) -> bool:
        """Has no heartbeat come lately."""
        return known.heartbeat_s is None or now_s - known.heartbeat_s > self.settings.heartbeat_timeout_s

    def estimate_is_lost(self, now_s: float, known: Telemetry) -> bool:
        """Does the autopilot itself not trust its position. Reports that no link delivers say nothing."""
        if known.estimate_ok or self.link_is_lost(now_s, known) or known.heartbeat_s is None:
            return False
        if known.estimate_s is None or now_s - known.estimate_s <= ESTIMATE_AGE_S:
            return True
        return known.heartbeat_s - max(known.estimate_s, self._link_since_s) > HEARTBEATS_S

    def way_down(self, now_s: float, known: Telemetry) -> Mode:
        """How a mission that cannot go on ends. A vehicle that does not know where it is cannot return."""
        return Mode.LAND if self.estimate_is_lost(now_s, known) else self.settings.failsafe_action

    def clock_stands(self, now_s: float) -> bool:
        """Has its clock stood still for too long to count by it."""
        return self.clock_stands_for_s(now_s) > CLOCK_S

    def clock_stands_for_s(self, now_s: float) -> float:
        """For how long no time has passed on the vehicle, steady clock."""
        return now_s - self._clock[1] if self._clock else 0.0

    def fault(self, now_s: float, known: Telemetry) -> Fault | None:
        """What is wrong; None: nothing."""
        age_s = self.settings.position_timeout_s
        if self.link_is_lost(now_s, known):
            return Fault(
                FaultKind.LINK, f"link lost: no heartbeat for {self.settings.heartbeat_timeout_s:g} s"
            )
        if known.position is not None and self.estimate_is_lost(now_s, known):  # positions may end with it
            return Fault(FaultKind.ESTIMATE, "the autopilot has lost its position estimate")
        jump = self._plausible.jump
        if jump is not None and known.vehicle_s - self._plausible.accepted_s > age_s:
            return Fault(FaultKind.POSITION, jump)
        if known.position is None or known.position_s is None or now_s - known.position_s > age_s:
            return Fault(FaultKind.POSITION, jump or f"no position for {age_s:g} s")
        if self.clock_stands(now_s):
            return Fault(FaultKind.CLOCK, f"the vehicle's clock has stood still for {CLOCK_S:g} s")
        return None

    def battery_is_low(self, known: Telemetry) -> str | None:
        """What is wrong with its charge; None: nothing, or it does not tell."""
        return self.battery.low(known) if self.settings.min_battery > 0 else None
