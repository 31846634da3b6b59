"""Which messages of a vehicle are new: by MAVLink's sequence numbers, the vehicle's time, or ROS stamps.

A datagram may arrive late, twice, or with an impossible time. A single such message is discarded, with its
reason. Several messages that agree are accepted: the vehicle restarted, or more was lost than numbers show.
"""

import math
from enum import StrEnum

SILENT_S = 0.5  # after this time without a message any number is accepted, steady clock
NEW_COUNT = 16  # messages in a row behind the newest that start another count of the same sender
NUMBERS = 256  # of MAVLink's messages, which then wrap around
REORDERED = 16  # a message at most this many numbers behind is accepted, if it is the newest of its name

LAG_S = 1.0  # a message that is further behind the newest is late, vehicle time
LEAP_S = 1.0  # further ahead, a message needs others to confirm it, and a stamp is impossible
CONFIRMED = 3  # messages that agree on a time further ahead
RESTARTED = 5  # messages that agree on a time further back,
RESTARTED_S = 1.0  # for this long, while none has a time of before, steady clock
MAX_SPEED = 100.0  # of a simulator's time, times the clock
RESYNC_S = 1.0  # time without an accepted message after which any stamp is accepted: reboot, clock change


class Discard(StrEnum):
    """Why a message was discarded."""

    REPEATED = "repeated"
    LATE = "late"
    ZEROED = "zeroed"  # stamped 0, at which no vehicle sends
    IMPOSSIBLE = "impossible"


class Sequence:
    """MAVLink's sequence numbers of one sender: 0 to 255, wrapping around."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._newest_s, self._checksum = 0.0, 0
        self._count = 0  # number of the newest, without wrap-around
        self._count_of: dict[str, int] = {}  # the same, by message name
        self._behind: int | None = None  # number of the last discarded message,
        self._in_a_row = 0  # and how many consecutive ones ended with it

    def check(self, name: str, number: int, checksum: int, now_s: float) -> Discard | None:
        """Why a message received at a steady time is discarded; None: it is new.

        Different messages with the same number in a row are accepted: some routers do not count. So is a
        message that a few messages of other names overtook.
        """
        ahead = 0 if self._newest is None else (number - self._newest) % NUMBERS
        behind = (NUMBERS - ahead) % NUMBERS
        new = 0 < ahead < NUMBERS // 2 or (ahead == 0 and checksum != self._checksum)
        new = new or self._newest is None or now_s - self._newest_s > SILENT_S
        if not new:
            count = self._count - behind
            if 0 < behind <= REORDERED and count > self._count_of.get(name, -NUMBERS):
                self._count_of[name] = count
                return None
            follows = self._behind is not None and 0 < (number - self._behind) % NUMBERS < NEW_COUNT
            self._in_a_row = self._in_a_row + 1 if follows else 1
            self._behind = number
            if self._in_a_row < NEW_COUNT:
                return Discard.LATE if ahead else Discard.REPEATED
        self._newest, self._newest_s, self._checksum = number, now_s, checksum
        self._count += ahead or NUMBERS
        self._count_of[name] = self._count
        self._behind, self._in_a_row = None, 0
        return None


class VehicleClock:
    """The vehicle's time, from `time_boot_ms` of its messages."""

    def __init__(self) -> None:
        self.vehicle_s = 0.0  # seconds; monotonic, also across restarts of the vehicle
        self.restarts = 0  # number of them
        self._boot_s: float | None = None  # newest time of all messages,
        self._received_s = 0.0  # and when it was received, steady clock
        self._newest_ms: dict[str, int] = {}  # newest time by message name
        self._outliers: list[tuple[float, float]] = []  # times that agree on another time, and when received

    def check(self, name: str, boot_ms: int, now_s: float) -> Discard | None:
        """Why a message of this name and time is discarded; None: it is new."""
        if boot_ms == 0:
            return Discard.ZEROED
        boot_s = boot_ms / 1e3
        if self._boot_s is None:
            self.vehicle_s = self._boot_s = boot_s
        ahead_s = boot_s - self._boot_s
        if not -LAG_S <= ahead_s <= LEAP_S:
            return self._check_outlier(name, boot_ms, now_s, ahead_s)
        self._outliers.clear()
        newest_ms = self._newest_ms.get(name, 0)
        if boot_ms <= newest_ms:
            return Discard.REPEATED if boot_ms == newest_ms else Discard.LATE
        self._advance(name, boot_ms, now_s, ahead_s)
        return None

    def lag_s(self, boot_ms: int) -> float:
        """How far a message's time is behind the newest of all, vehicle time."""
        return max(0.0, (self._boot_s or 0.0) - boot_ms / 1e3)

    def _check_outlier(self, name: str, boot_ms: int, now_s: float, ahead_s: float) -> Discard | None:
        boot_s, outliers = boot_ms / 1e3, self._outliers
        if outliers and not -LAG_S <= boot_s - outliers[-1][0] <= LEAP_S:
            outliers.clear()
        outliers.append((boot_s, now_s))
        if ahead_s > 0.0:
            if len(outliers) < CONFIRMED:
                return Discard.IMPOSSIBLE
            ahead_s = min(ahead_s, LEAP_S + MAX_SPEED * (now_s - self._received_s))
        else:
            if len(outliers) < RESTARTED or now_s - outliers[0][1] < RESTARTED_S:
                return Discard.LATE
            self.restarts += 1
            ahead_s = boot_s - outliers[0][0]
        outliers.clear()
        self._newest_ms.clear()
        self._boot_s = boot_s
        self._advance(name, boot_ms, now_s, ahead_s)
        return None

    def _advance(self, name: str, boot_ms: int, now_s: float, passed_s: float) -> None:
        self.vehicle_s += max(0.0, passed_s)
        self._newest_ms[name] = boot_ms
        self._boot_s = max(self._boot_s or 0.0, boot_ms / 1e3)
        self._received_s = now_s


class StampOrder:
    """Order of the messages of one stream, by the sender's stamps. Unstamped streams are accepted."""

    def __init__(self) -> None:
        self._stamp_s, self._accepted_s = 0.0, -math.inf  # stamp and arrival of the last accepted message

    def check(self, stamp_s: float, now_s: float) -> Discard | None:
        """Why a message received at a steady time is discarded; None: it is new."""
        if self._stamp_s:
            passed_s, advance_s = now_s - self._accepted_s, stamp_s - self._stamp_s
            if not advance_s:
                return Discard.REPEATED
            if passed_s <= RESYNC_S:
                if not stamp_s:
                    return Discard.ZEROED
                if advance_s < 0:
                    return Discard.LATE
                if advance_s > LEAP_S + MAX_SPEED * passed_s:
                    return Discard.IMPOSSIBLE
        self._stamp_s, self._accepted_s = stamp_s, now_s
        return None
