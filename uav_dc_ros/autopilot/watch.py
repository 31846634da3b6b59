"""How carefully to fly, and what keeps a vehicle from going on."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from uav_dc_ros.autopilot.battery import Battery
from uav_dc_ros.autopilot.vehicle import Mode, Telemetry


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How carefully to fly.

    Attributes:
        arm: may the bridge set the mode, and arm? Otherwise it waits for a pilot to do so.
        tolerance_m: distance within which the vehicle is at a cell's centre.
        dwell_s: how long it must be there for a step to be done, vehicle time.
        position_age_s: age of the position after which nobody flies by it.
        link_age_s: age of the last heartbeat after which the link is lost.
        silent_steps: steps' time without a move after which the policy is given up, vehicle time.
        silent_s: but not before this time, steady clock: the policy does not think faster where a simulated
            vehicle's time does.
        fastest_mps: no vehicle of this kind flies faster; a position that does has jumped.
        jump_m: how far a position may jump, metres, as estimates do now and then.
        hold_s: how long a fault may last before the mission ends, steady or vehicle time.
        lost_s: time without a heartbeat after which nobody waits for the vehicle to land; from 200 m that
            takes two and a half minutes.
        least_battery: charge at which the mission ends, 0 to 1; 0: the battery is the autopilot's business.
        then: what ends a mission that cannot go on. Without a position, and where the vehicle refuses to
            return, it is to land.
        flying_at_start: what to do with a vehicle that flies already, in the commanded mode.
        retry_s: pause before a wish that was not fulfilled is uttered again, vehicle time.
        returning_tries: how often it is asked to return before it is asked to land.
        takeoff_s: longest time from the first wish to take off until the start is reached, vehicle time.
    """

    arm: bool = False
    tolerance_m: float = 2.0
    dwell_s: float = 0.5
    position_age_s: float = 0.5
    link_age_s: float = 3.0
    silent_steps: float = 2.0
    silent_s: float = 5.0
    fastest_mps: float = 20.0
    jump_m: float = 5.0
    hold_s: float = 5.0
    lost_s: float = 300.0
    least_battery: float = 0.2
    then: Literal[Mode.RETURN, Mode.LAND] = Mode.RETURN
    flying_at_start: Literal["resume", "land"] = "resume"
    retry_s: float = 2.0
    returning_tries: int = 3
    takeoff_s: float = 300.0


class Watch:
    """Finds what is wrong with what is known of a vehicle.

    Args:
        settings: what is wrong, and what is not.
        at_rest_v: of the battery, see there.

    Attributes:
        battery: judges it.
    """

    def __init__(self, settings: Settings, at_rest_v: float | None = None) -> None:
        self.settings = settings
        self.battery = Battery(settings.least_battery, at_rest_v)
        self._believed: Telemetry | None = None  # the last one whose position could be true

    def link_is_lost(self, now_s: float, known: Telemetry) -> bool:
        """Has no heartbeat come lately."""
        return known.heartbeat_s is None or now_s - known.heartbeat_s > self.settings.link_age_s

    def fault(self, now_s: float, known: Telemetry) -> str | None:
        """What is wrong; None: nothing."""
        settings = self.settings
        if self.link_is_lost(now_s, known):
            return f"no heartbeat for {settings.link_age_s:g} s"
        if known.position_s is None or now_s - known.position_s > settings.position_age_s:
            return f"no position for {settings.position_age_s:g} s"
        if not known.estimate_ok:
            return "the autopilot has lost its position estimate"
        return self._jumped(known)

    def battery_is_low(self, known: Telemetry) -> str | None:
        """What is wrong with its charge; None: nothing, or it does not tell."""
        return self.battery.low(known) if self.settings.least_battery > 0 else None

    def _jumped(self, known: Telemetry) -> str | None:
        """Is the vehicle where it cannot have flown since it was somewhere believable."""
        last = self._believed
        if last is not None and known.position_s == last.position_s:
            return None  # no other position has come; that one is from when it came
        if last is not None and last.position is not None and known.position is not None:
            passed_s = max(0.0, known.vehicle_s - last.vehicle_s)
            moved_m = float(np.linalg.norm(np.subtract(known.position, last.position)))
            if moved_m > self.settings.jump_m + self.settings.fastest_mps * passed_s:
                return f"the position jumped by {moved_m:.0f} m"
        self._believed = known
        return None
