"""The time of a bag during playback: faster or slower than the wall clock, or paused."""

import math
import time
from collections.abc import Callable

CLOCK_TOPIC = "/clock"
RATE_MIN, RATE_MAX = 1e-3, 1e6


class PlaybackClock:
    """Maps log times of a bag to the steady clock, from one reference: a late message delays no other."""

    def __init__(
        self, rate: float, *, paused: bool = False, now: Callable[[], float] = time.monotonic
    ) -> None:
        self.paused = paused
        self.limit_ns = 0  # log time of the next message, upper bound of the bag's time
        self._now, self._rate = now, rate
        self._reference_ns, self._reference_s = 0, now()

    @property
    def rate(self) -> float:
        """Seconds of the bag per second; infinite: no message waits for its time."""
        return self._rate

    @rate.setter
    def rate(self, rate: float) -> None:
        """Change the rate from the current position on."""
        self.jump(self.position_ns())
        self._rate = rate

    def jump(self, to_ns: int) -> None:
        """Set the bag's time."""
        self._reference_ns, self._reference_s = to_ns, self._now()

    def position_ns(self) -> int:
        """The bag's time, nanoseconds since the epoch, as published on `/clock`."""
        if self.paused or math.isinf(self._rate):
            return self._reference_ns
        passed_ns = round((self._now() - self._reference_s) * self._rate * 1e9)
        return max(self._reference_ns, min(self._reference_ns + passed_ns, self.limit_ns))

    def due_s(self, log_time_ns: int) -> float:
        """Time at which to publish a message, on the steady clock; infinite during a pause."""
        if self.paused:
            return math.inf
        return self._reference_s + (log_time_ns - self._reference_ns) * 1e-9 / self._rate

    def toggle_pause(self) -> None:
        """Pause, or resume."""
        self.jump(self.position_ns())
        self.paused = not self.paused

    def delay(self, seconds: float) -> None:
        """Shift the schedule, after a wait for subscribers or a suspended process."""
        self._reference_s += seconds

    def follow(self, log_time_ns: int) -> None:
        """Advance to a message that was published without a schedule: single step, or infinite rate."""
        if self.paused or math.isinf(self._rate):
            self.jump(log_time_ns)
