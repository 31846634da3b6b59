"""Removes impossible values from telemetry, and counts them."""

import math
from collections import Counter

from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.vehicle import Telemetry

SLACK_S = 1.0  # between arrival times that are taken in different threads, steady clock


class PlausibilityFilter:
    """Filters the telemetry of one vehicle; a position beyond both limits together has jumped."""

    def __init__(self, max_speed_mps: float, max_jump_m: float) -> None:
        self._max_speed_mps, self._max_jump_m = max_speed_mps, max_jump_m
        self.discarded: Counter[str] = Counter()  # number of values by reason
        self.jump: str | None = None  # why the newest position was discarded; None: it was accepted
        self.accepted_s = 0.0  # vehicle time of the last accepted position
        self._accepted: tuple[Enu, float] | None = None  # position, and its arrival
        self._newest_s = -math.inf  # steady clock: arrival of the newest position, accepted or not
        self._vehicle_s = 0.0
        self._last: Telemetry | None = None  # as returned

    def filter(self, now_s: float, telemetry: Telemetry) -> Telemetry:
        """The telemetry with the last accepted position and a vehicle time that never decreases.

        Telemetry whose last heartbeat is older than before is discarded: the previous one is returned.
        """
        last = self._last
        if last is not None and (telemetry.heartbeat_s or 0.0) < (last.heartbeat_s or 0.0) - SLACK_S:
            self.discarded["out of order"] += 1
            return last
        if math.isfinite(telemetry.vehicle_s):
            self._vehicle_s = max(self._vehicle_s, telemetry.vehicle_s)
        if telemetry.position is not None and telemetry.position_s is not None:
            self._check(now_s, telemetry.position, telemetry.position_s)
        position, position_s = self._accepted or (None, None)
        self._last = telemetry.replace(
            vehicle_s=self._vehicle_s,
            position=position,
            position_s=position_s,
            home=telemetry.home if telemetry.home and telemetry.home.is_finite else None,
            target=telemetry.target if telemetry.target and telemetry.target.is_finite else None,
        )
        return self._last

    def _check(self, now_s: float, position: Enu, position_s: float) -> None:
        """Accept a new position, or count why not."""
        if position_s == self._newest_s:
            return
        if position_s < self._newest_s or position_s > now_s + SLACK_S:
            self.discarded["out of order"] += 1
            return
        self._newest_s, self.jump = position_s, None
        if not position.is_finite:
            self.jump = "the position is not a number"
        elif self._accepted is not None:
            moved_m, passed_s = math.dist(position, self._accepted[0]), self._vehicle_s - self.accepted_s
            if moved_m > self._max_jump_m + self._max_speed_mps * passed_s:
                self.jump = f"the position jumped by {moved_m:.0f} m"
        if self.jump is None:
            self._accepted, self.accepted_s = (position, position_s), self._vehicle_s
        else:
            self.discarded["impossible position"] += 1
