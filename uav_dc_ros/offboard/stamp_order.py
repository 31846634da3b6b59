"""Which messages of a stream are news, by the stamps that their sender gave them. No input or output."""

import math

LEAP_S = 1.0  # further ahead than its pace explains
FASTEST = 100.0  # a simulated vehicle's time, times as fast as the clock
RESYNC_S = 1.0  # without news, after which another order is believed: clocks are set, and vehicles boot


class StampOrder:
    """The order of one stream: a message that is late, repeated or of an impossible time is to be ignored.

    A sender that never stamps is taken as it comes.
    """

    def __init__(self) -> None:
        self._stamp_s, self._news_s = 0.0, -math.inf  # of the last news: its stamp, and when it came

    def refusal(self, stamp_s: float, now_s: float) -> str | None:
        """Why a message with a stamp, that came at a steady time, is to be ignored; None: it is news."""
        why = None
        if self._stamp_s:
            passed_s, advance_s = now_s - self._news_s, stamp_s - self._stamp_s
            if not advance_s:
                return "repeated"
            if not stamp_s:
                why = "zeroed"
            elif advance_s < 0:
                why = "late"
            elif advance_s > LEAP_S + FASTEST * passed_s:
                why = "impossible"
            if passed_s > RESYNC_S:
                why = None
        if why is None:
            self._stamp_s, self._news_s = stamp_s, now_s
        return why
