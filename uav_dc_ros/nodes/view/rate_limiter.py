"""A limit on how often something is done, that does the last of it in any case."""

import time
from collections.abc import Callable


class RateLimiter:
    """Calls `act` with a name at most `rate_hz` times a second for each name; `clock_s` is the time, seconds.

    A name that comes too soon waits for a later one, or for `flush`. With a rate of 0 it never calls.
    """

    def __init__(
        self, rate_hz: float, act: Callable[[str], None], clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._period_s = 1.0 / rate_hz if rate_hz else None
        self._act, self._clock_s = act, clock_s
        self._due_s: dict[str, float] = {}
        self._waiting: dict[str, None] = {}  # a set, in order

    def request(self, name: str) -> None:
        """Act now if that is not too soon, or else later."""
        if self._period_s is None:
            return
        now_s = self._clock_s()
        if now_s < self._due_s.get(name, now_s):
            self._waiting[name] = None
            return
        self._due_s[name] = now_s + self._period_s
        self._waiting.pop(name, None)
        self._act(name)

    def flush(self, *, at_once: bool = False) -> None:
        """Act on what waits and is due; on all of it if `at_once`."""
        if at_once:
            self._due_s.clear()
        for name in list(self._waiting):
            self.request(name)
