"""Which messages of a vehicle are news: by their numbers on the link, and by the vehicle's own time.

A datagram may come late, twice, or with a time that makes no sense. One such message is discarded, with its
reason; only what several messages say alike is believed: that the vehicle was started anew, or that more
was lost than numbers tell.
"""

from enum import StrEnum

SILENT_S = 0.5  # after so long without a message any number is news, steady clock
SAME_COUNT = 16  # messages in a row, behind the newest, that make another count of the same sender
NUMBERS = 256  # of MAVLink's messages, which then begin anew
REORDERED = 16  # a message that many numbers behind the newest is news, if it is the newest of its name

LAG_S = 1.0  # a message that is further behind the newest is late, vehicle time
LEAP_S = 1.0  # a message that is further ahead needs others to confirm it, vehicle time
CONFIRMED = 3  # messages that agree on a time further ahead
RESTARTED = 5  # messages that agree on a time further back,
RESTARTED_S = 1.0  # for so long, while none comes of the time before, steady clock
FASTEST = 100.0  # times as fast as the clock: no simulator's time is faster


class Discard(StrEnum):
    """Why a message was ignored."""

    REPEATED = "repeated"
    LATE = "late"
    ZEROED = "zeroed"  # at time 0, at which no vehicle sends anything
    IMPOSSIBLE = "impossible"


class Sequence:
    """MAVLink's numbers of one sender's messages: 0 to 255, and again."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._newest_s, self._checksum = 0.0, 0
        self._count = 0  # of the newest: its number, but ever on
        self._count_of: dict[str, int] = {}  # of the newest by name
        self._behind: int | None = None  # the last number that was not news,
        self._in_a_row = 0  # and how many before it make one count with it

    def take(self, name: str, number: int, checksum: int, now_s: float) -> Discard | None:
        """Is a message with this name and number, at a steady time, no news, and why; None: it is news.

        Other messages with the same number, one after the other, are those of a router that does not count.
        One that was overtaken by a few of other names is news.
        """
        ahead = 0 if self._newest is None else (number - self._newest) % NUMBERS
        behind = (NUMBERS - ahead) % NUMBERS
        news = 0 < ahead < NUMBERS // 2 or (ahead == 0 and checksum != self._checksum)
        news = news or self._newest is None or now_s - self._newest_s > SILENT_S
        if not news:
            count = self._count - behind
            if 0 < behind <= REORDERED and count > self._count_of.get(name, -NUMBERS):
                self._count_of[name] = count
                return None
            follows = self._behind is not None and 0 < (number - self._behind) % NUMBERS < SAME_COUNT
            self._in_a_row = self._in_a_row + 1 if follows else 1
            self._behind = number
        if not news and self._in_a_row < SAME_COUNT:
            return Discard.LATE if ahead else Discard.REPEATED
        self._newest, self._newest_s, self._checksum = number, now_s, checksum
        self._count += ahead or NUMBERS
        self._count_of[name] = self._count
        self._behind, self._in_a_row = None, 0
        return None


class VehicleClock:
    """The vehicle's time, from `time_boot_ms` of its messages.

    Attributes:
        vehicle_s: seconds, which only ever go on, also where the vehicle is started anew.
        restarts: how often it was.
    """

    def __init__(self) -> None:
        self.vehicle_s, self.restarts = 0.0, 0
        self._boot_s: float | None = None  # the newest time of all messages,
        self._came_s = 0.0  # and when it came, steady clock
        self._newest_ms: dict[str, int] = {}  # of each kind of message
        self._others: list[tuple[float, float]] = []  # times that agree on another time, and when they came

    def take(self, name: str, boot_ms: int, now_s: float) -> Discard | None:
        """Is a message of this name and time no news, and why; None: it is news."""
        if boot_ms == 0:
            return Discard.ZEROED
        boot_s = boot_ms / 1e3
        if self._boot_s is None:
            self.vehicle_s = self._boot_s = boot_s
        ahead_s = boot_s - self._boot_s
        if not -LAG_S <= ahead_s <= LEAP_S:
            return self._doubt(name, boot_ms, now_s)
        self._others.clear()
        newest_ms = self._newest_ms.get(name, 0)
        if boot_ms <= newest_ms:
            return Discard.REPEATED if boot_ms == newest_ms else Discard.LATE
        self._go_on(name, boot_ms, now_s, max(0.0, ahead_s))
        return None

    def lag_s(self, boot_ms: int) -> float:
        """How far a message's time is behind the newest of all, vehicle time."""
        return max(0.0, (self._boot_s or 0.0) - boot_ms / 1e3)

    def _doubt(self, name: str, boot_ms: int, now_s: float) -> Discard | None:
        """Take in a time that is none of the vehicle's, unless others confirm it."""
        assert self._boot_s is not None, "there is a time to be far from"
        boot_s = boot_ms / 1e3
        if self._others and not -LAG_S <= boot_s - self._others[-1][0] <= LEAP_S:
            self._others.clear()
        self._others.append((boot_s, now_s))
        ahead_s = boot_s - self._boot_s
        if ahead_s > 0.0:
            if len(self._others) < CONFIRMED:
                return Discard.IMPOSSIBLE
            passed_s = now_s - self._came_s
            ahead_s = min(ahead_s, LEAP_S + FASTEST * passed_s)
        else:
            if len(self._others) < RESTARTED or now_s - self._others[0][1] < RESTARTED_S:
                return Discard.LATE
            self.restarts += 1
            ahead_s = boot_s - self._others[0][0]
        self._others.clear()
        self._newest_ms.clear()
        self._boot_s = boot_s
        self._go_on(name, boot_ms, now_s, max(0.0, ahead_s))
        return None

    def _go_on(self, name: str, boot_ms: int, now_s: float, passed_s: float) -> None:
        self.vehicle_s += passed_s
        self._newest_ms[name] = boot_ms
        self._boot_s = max(self._boot_s or 0.0, boot_ms / 1e3)
        self._came_s = now_s
