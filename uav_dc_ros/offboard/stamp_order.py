"""Order of the messages of one stream, by the sender's stamps."""

import math

LEAP_S = 1.0  # advance of the stamp beyond that of the clock
FASTEST = 100.0  # maximum speed of a simulated vehicle's time, times the clock
RESYNC_S = 1.0  # time without an accepted message after which any stamp is accepted: reboot, clock change


class StampOrder:
    """Rejects messages that are late, repeated or of an impossible time. Unstamped streams are accepted."""

    def __init__(self) -> None:
        self._stamp_s, self._accepted_s = 0.0, -math.inf  # stamp and arrival of the last accepted message

    def refusal(self, stamp_s: float, now_s: float) -> str | None:
        """Why a message that arrived at a steady time is to be ignored; None: it is accepted."""
        if self._stamp_s:
            passed_s, advance_s = now_s - self._accepted_s, stamp_s - self._stamp_s
            if not advance_s:
                return "repeated"
            if passed_s <= RESYNC_S:
                if not stamp_s:
                    return "zeroed"
                if advance_s < 0:
                    return "late"
                if advance_s > LEAP_S + FASTEST * passed_s:
                    return "impossible"
        self._stamp_s, self._accepted_s = stamp_s, now_s
        return None
