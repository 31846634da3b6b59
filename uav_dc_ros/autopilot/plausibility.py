"""Telemetry that cannot be true is counted and left out; the mission flies by the rest."""

import dataclasses
import math

from uav_dc_ros.autopilot.frames import Enu
from uav_dc_ros.autopilot.vehicle import Telemetry

AHEAD_S = 1.0  # a position cannot have come later than now, but for the time between two looks at the clock


class Plausibility:
    """Filters the telemetry of one vehicle.

    Args:
        max_speed_mps: no vehicle of this kind flies faster.
        jump_m: how far its estimate may jump besides.

    Attributes:
        discarded: positions that were left out, by reason.
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

    def filter(self, now_s: float, known: Telemetry) -> Telemetry:
        """The telemetry, with the last position that can be true, and a time that never goes back."""
        self._vehicle_s = max(self._vehicle_s, known.vehicle_s)
        if known.position is not None and known.position_s is not None:
            self._judge(now_s, known, known.position, known.position_s)
        last = self._accepted
        return dataclasses.replace(
            known,
            vehicle_s=self._vehicle_s,
            position=last.position if last else None,
            position_s=last.position_s if last else None,
        )

    def _judge(self, now_s: float, known: Telemetry, position: Enu, position_s: float) -> None:
        """Accept a new position, or count why not."""
        if position_s == self._newest_s:
            return
        if position_s < self._newest_s or position_s > now_s + AHEAD_S:
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
        if not all(map(math.isfinite, position)):
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
