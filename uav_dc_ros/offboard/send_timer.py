"""The beat of heartbeats and of a stream of setpoints: the same for every way to a vehicle.

A simulated vehicle's time may run faster than the clock, and its failsafes count that: what has to come
often enough follows whichever is faster.
"""

import math

STREAM_S = 0.05
STREAM_VEHICLE_S = 0.2  # of a simulated vehicle whose time runs faster; PX4 wants more than 2 Hz of that
HEARTBEAT_S, HEARTBEAT_LEAST_S = 1.0, 0.02  # of either time; never more often than that, steady time
LIFE_S = 1.0  # a stream ends so long after the last sign of life of those who decide


def following(due_s: float, period_s: float, now_s: float) -> float:
    """When something is due again: on the beat, and without catching up on beats that were missed."""
    return due_s + period_s if now_s < due_s + period_s else now_s + period_s


class Heartbeat:
    """When the next heartbeat is due: at once on a new link, then once a second, on either clock."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """A link was opened."""
        self._due_s = self._sent_s = self._sent_vehicle_s = -math.inf

    def is_due(self, now_s: float, vehicle_s: float) -> bool:
        """Is it due at a steady time and a vehicle's."""
        ahead = vehicle_s - self._sent_vehicle_s >= HEARTBEAT_S
        return now_s >= self._due_s or (ahead and now_s - self._sent_s >= HEARTBEAT_LEAST_S)

    def sent(self, now_s: float, vehicle_s: float) -> None:
        """It went out."""
        self._due_s = following(self._due_s, HEARTBEAT_S, now_s)
        self._sent_s, self._sent_vehicle_s = now_s, vehicle_s
