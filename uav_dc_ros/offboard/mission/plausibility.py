"""Telemetry that cannot be true is counted and left out; the mission flies by the rest."""

import dataclasses
import math

from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.vehicle import Telemetry

SLACK_S = 1.0  # between times of arrival that are taken in different threads, steady clock


def is_finite(position: Enu) -> bool:
    """Is a position one at all: three numbers."""
    return all(map(math.isfinite, position))


class Plausibility:
    """Filters the telemetry of one vehicle.

    Args:
        max_speed_mps: no vehicle of this kind flies faster.
        jump_m: how far its estimate may jump besides.

    Attributes:
        discarded: what was left out, by reason.
        jump: why the newest position was left out; None: it was not.
        accepted_s: vehicle time of the last position that was not left out.
    """

    def __init__(self, max_speed_mps: float, jump_m: float) -> None:
        self._max_speed_mps, self._jump_m = max_speed_mps, jump_m
        self.discarded: dict[str, int] = {}
        self.jump: str | None = None
        self.accepted_s = 0.0
        self._newest_s = -math.inf  # steady clock: when the newest position came, accepted or not
        self._accepted: Telemetry | None = None
        self._vehicle_s = 0.0
        self._last: Telemetry | None = None  # as it was returned

    def filter(self, now_s: float, known: Telemetry) -> Telemetry:
        """The telemetry, with the last position that can be true, and a time that never goes back.

        Where its last heartbeat is older than that of telemetry before, the latter is returned.
        """
        last, heartbeat_s = self._last, known.heartbeat_s
        if last is not None and (heartbeat_s or 0.0) < (last.heartbeat_s or 0.0) - SLACK_S:
            self._discard("out of order")
            return last
        if math.isfinite(known.vehicle_s):
            self._vehicle_s = max(self._vehicle_s, known.vehicle_s)
        if known.position is not None and known.position_s is not None:
            self._judge(now_s, known, known.position, known.position_s)
        accepted = self._accepted
        self._last = dataclasses.replace(
            known,
            vehicle_s=self._vehicle_s,
            position=accepted.position if accepted else None,
            position_s=accepted.position_s if accepted else None,
            home=known.home if known.home is not None and is_finite(known.home) else None,
            target=known.target if known.target is not None and is_finite(known.target) else None,
        )
        return self._last

    def _judge(self, now_s: float, known: Telemetry, position: Enu, position_s: float) -> None:
        """Accept a new position, or count why not."""
        if position_s == self._newest_s:
            return
        if position_s < self._newest_s or position_s > now_s + SLACK_S:
            self._discard("out of order")
            return
        self._newest_s = position_s
        self.jump = self._jumped(position)
        if self.jump is None:
            self._accepted, self.accepted_s = known, self._vehicle_s
        else:
            self._discard("impossible position")

    def _jumped(self, position: Enu) -> str | None:
        """Is the vehicle where it cannot have flown since the last position that was accepted."""
        if not is_finite(position):
            return "the position is not a number"
        if self._accepted is None or self._accepted.position is None:
            return None
        moved_m = math.dist(position, self._accepted.position)
        passed_s = self._vehicle_s - self.accepted_s
        if moved_m > self._jump_m + self._max_speed_mps * passed_s:
            return f"the position jumped by {moved_m:.0f} m"
        return None

    def _discard(self, reason: str) -> None:
        self.discarded[reason] = self.discarded.get(reason, 0) + 1
