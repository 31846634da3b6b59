"""The time of a bag while it is played: runs faster or slower than that of the world, and may stand still."""

import math
import time
from collections.abc import Callable

CLOCK_TOPIC = "/clock"
RATE_MIN, RATE_MAX = 1e-3, 1e6


class PlaybackClock:
    """Log times of a bag against the steady clock, from one anchor: lateness of a message delays no other.

    Args:
        rate: seconds of the bag in a second; infinite: no message waits for its time.
        paused: does it stand still at first?
        now: the steady clock, seconds.

    Attributes:
        paused: does it stand still?
        limit_ns: log time of the next message: the time of the bag never runs ahead of what has been played.
    """

    def __init__(
        self, rate: float, *, paused: bool = False, now: Callable[[], float] = time.monotonic
    ) -> None:
        self.paused = paused
        self.limit_ns = 0
        self._now = now
        self._rate = rate
        self._at_ns, self._at_s = 0, now()

    @property
    def rate(self) -> float:
        """Seconds of the bag in a second."""
        return self._rate

    @rate.setter
    def rate(self, rate: float) -> None:
        """Run at another rate from here on."""
        self.jump(self.position_ns())
        self._rate = rate

    def jump(self, to_ns: int) -> None:
        """It is `to_ns` now."""
        self._at_ns, self._at_s = to_ns, self._now()

    def position_ns(self) -> int:
        """The time of the bag, nanoseconds since the epoch, as `/clock` tells it."""
        if self.paused or math.isinf(self._rate):
            return self._at_ns
        passed_ns = round((self._now() - self._at_s) * self._rate * 1e9)
        return max(self._at_ns, min(self._at_ns + passed_ns, self.limit_ns))

    def due_s(self, log_time_ns: int) -> float:
        """When a message is to be published, on the steady clock; infinite while the time stands still."""
        if self.paused:
            return math.inf
        return self._at_s + (log_time_ns - self._at_ns) * 1e-9 / self._rate

    def pause(self) -> None:
        """Stand still, or go on."""
        self.jump(self.position_ns())
        self.paused = not self.paused

    def hold(self, seconds: float) -> None:
        """Time stood still for so long: somebody had to be waited for."""
        self._at_s += seconds

    def played(self, log_time_ns: int) -> None:
        """A message was published that no schedule asked for: it is its time now."""
        if self.paused or math.isinf(self._rate):
            self.jump(log_time_ns)
