"""The order in which messages were received, also where the recorder's clock was set back meanwhile.

Log times tell it, as long as the clock goes forward: messages of different topics may lie in a file in
another order, since a recorder writes down what waits topic by topic. Those of one topic lie as they were
received; so where their times go back, the clock was set back.
"""

import heapq
from collections.abc import Iterator

from uav_dc_ros.bags.storage import BagMessage

SET_BACK_NS = 250_000_000  # less is no clock: a message that was lost and sent again may look like that
WAITING_BYTES = 16 * 2**20  # of messages that wait for earlier ones
MESSAGE_BYTES = 400  # that a message takes beside its data


def in_order(recorded: Iterator[BagMessage]) -> Iterator[tuple[int, BagMessage]]:
    """Messages in the order of their receipt, each with how often the clock had been set back by then.

    Args:
        recorded: messages as they were recorded, those of each topic in the order of their receipt.
    """
    waiting: list[tuple[int, int, int, BagMessage]] = []  # how often it was set back, log time, number
    waiting_bytes = 0
    ends_ns = [0]  # latest log time between two settings of the clock
    last: dict[str, tuple[int, int]] = {}  # of the last message by topic: how often, log time
    for n, message in enumerate(recorded):
        time_ns = message.log_time_ns
        clock, before_ns = last.get(message.topic, (len(ends_ns) - 1, 0))
        if time_ns < before_ns - SET_BACK_NS:
            clock += 1
            before_ns = 0
        # A topic that was silent meanwhile is told by others.
        while clock < len(ends_ns) - 1 and time_ns > ends_ns[clock]:
            clock += 1
        if clock == len(ends_ns):
            ends_ns.append(0)
        ends_ns[clock] = max(ends_ns[clock], time_ns)
        last[message.topic] = clock, max(time_ns, before_ns)
        heapq.heappush(waiting, (clock, time_ns, n, message))
        waiting_bytes += len(message.data) + MESSAGE_BYTES
        while waiting_bytes > WAITING_BYTES:
            clock, *_, first = heapq.heappop(waiting)
            waiting_bytes -= len(first.data) + MESSAGE_BYTES
            yield clock, first
    while waiting:
        clock, *_, first = heapq.heappop(waiting)
        yield clock, first
