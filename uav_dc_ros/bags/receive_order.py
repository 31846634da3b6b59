"""The order in which messages were received, also where the recorder's clock was set back meanwhile.

Log times tell it, as long as the clock goes forward: messages of different topics may lie in a file in
another order, since a recorder writes down what waits topic by topic. Those of one topic lie in the order in
which they were published; so where both their times go back, the clock was set back. Where the log time alone
does, a message was lost and sent again, unless all that follow are received sooner than any before: then it
was the clock of a recorder on another machine.
"""

import heapq
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from uav_dc_ros.bags.storage import BagMessage

LEAST_NS = 1_000_000  # by which a clock is set back
LEAST_APART_NS = 250_000_000  # by which that of the recorder alone is
WAITING_BYTES = 16 * 2**20  # of messages that wait for earlier ones
MESSAGE_BYTES = 400  # that a message takes beside its data


class _Last(NamedTuple):
    """The last message of a topic: how often the clock had been set back, and its times, ns.

    `latency_ns` is the shortest between two settings of the clock.
    """

    clock: int
    log_ns: int
    publish_ns: int
    latency_ns: int


class _Clock:
    """Tells of each message how often the clock had been set back when it was received.

    Attributes:
        set_back_ns: by how much it was set back, at most.
    """

    def __init__(self) -> None:
        self.set_back_ns = 0
        self._ends_ns = [0]  # latest log time between two settings
        self._last: dict[str, _Last] = {}

    def setting(self, message: BagMessage) -> int:
        """How often it had been set back by then."""
        _, _, _, log_ns, publish_ns = message
        ends_ns, latency_ns = self._ends_ns, log_ns - publish_ns
        last = self._last.get(message.topic)
        clock, least_ns = len(ends_ns) - 1, latency_ns
        if last is not None:
            clock, least_ns = last.clock, min(last.latency_ns, latency_ns)
            back_ns = last.log_ns - log_ns
            both = back_ns > LEAST_NS and publish_ns < last.publish_ns
            if both or (back_ns > LEAST_APART_NS and latency_ns < last.latency_ns - LEAST_APART_NS):
                self.set_back_ns = max(self.set_back_ns, back_ns)
                clock, least_ns = clock + 1, latency_ns
        # Others saw it set back: a topic that was silent meanwhile is where its time is nearer.
        while clock < len(ends_ns) - 1 and abs(log_ns - ends_ns[clock + 1]) < abs(log_ns - ends_ns[clock]):
            clock, least_ns = clock + 1, latency_ns
        if clock == len(ends_ns):
            ends_ns.append(0)
        ends_ns[clock] = max(ends_ns[clock], log_ns)
        self._last[message.topic] = _Last(clock, log_ns, publish_ns, least_ns)
        return clock


def set_back_ns(recorded: Iterable[BagMessage]) -> int:
    """By how much the clock was set back, at most, between messages in the order of recording; ns."""
    clock = _Clock()
    for message in recorded:
        clock.setting(message)
    return clock.set_back_ns


def in_order(recorded: Iterable[BagMessage]) -> Iterator[tuple[int, BagMessage]]:
    """Messages in the order of their receipt, each with how often the clock had been set back by then.

    Args:
        recorded: messages as they were recorded, those of each topic in the order of their receipt.
    """
    clock = _Clock()
    waiting: list[tuple[int, int, int, BagMessage]] = []  # how often it was set back, log time, number
    waiting_bytes = 0
    for n, message in enumerate(recorded):
        heapq.heappush(waiting, (clock.setting(message), message.log_time_ns, n, message))
        waiting_bytes += len(message.data) + MESSAGE_BYTES
        while waiting_bytes > WAITING_BYTES:
            setting, _, _, first = heapq.heappop(waiting)
            waiting_bytes -= len(first.data) + MESSAGE_BYTES
            yield setting, first
    while waiting:
        setting, _, _, first = heapq.heappop(waiting)
        yield setting, first
