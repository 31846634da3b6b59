"""The order in which messages were received, also if the recorder's clock was set back meanwhile.

While the clock goes forward, it is the order of log times: a recorder writes waiting messages topic by topic,
so the order in a file may differ. Messages of one topic are in the order of publishing. If both their times
go back, the clock was set back. If only the log time goes back, a message was lost and resent, unless all
later messages have a shorter latency than any before: then the clock of a recorder on another machine was set
back.
"""

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

from uav_dc_ros.bags.storage import BagMessage, sorted_within

MIN_SET_BACK_NS = 1_000_000
MIN_RECORDER_SET_BACK_NS = 250_000_000  # of the recorder's clock alone
WAITING_BYTES = 16 * 2**20  # of messages that wait for earlier ones


class _Last(NamedTuple):
    """A topic's last message."""

    setting: int  # how often the clock had been set back before it
    log_ns: int
    publish_ns: int
    min_latency_ns: int  # the shortest latency since the clock was last set back


class _Clock:
    """Counts how often the clock had been set back when each message was received."""

    def __init__(self) -> None:
        self.set_back_ns = 0  # the longest step back
        self._ends_ns = [0]  # latest log time by setting
        self._last: dict[str, _Last] = {}

    def setting(self, message: BagMessage) -> int:
        """How often the clock had been set back before the message."""
        _, _, _, log_ns, publish_ns = message
        ends_ns, latency_ns = self._ends_ns, log_ns - publish_ns
        last = self._last.get(message.topic)
        setting, min_latency_ns = len(ends_ns) - 1, latency_ns
        if last is not None:
            setting, min_latency_ns = last.setting, min(last.min_latency_ns, latency_ns)
            back_ns = last.log_ns - log_ns
            both = back_ns > MIN_SET_BACK_NS and publish_ns < last.publish_ns
            shorter_ns = last.min_latency_ns - latency_ns
            if both or min(back_ns, shorter_ns) > MIN_RECORDER_SET_BACK_NS:
                self.set_back_ns = max(self.set_back_ns, back_ns)
                setting, min_latency_ns = setting + 1, latency_ns
        # Other topics went back: a topic without messages meanwhile belongs where its time is closest.
        for end_ns, next_end_ns in pairwise(ends_ns[setting:]):
            if abs(log_ns - next_end_ns) >= abs(log_ns - end_ns):
                break
            setting, min_latency_ns = setting + 1, latency_ns
        if setting == len(ends_ns):
            ends_ns.append(0)
        ends_ns[setting] = max(ends_ns[setting], log_ns)
        self._last[message.topic] = _Last(setting, log_ns, publish_ns, min_latency_ns)
        return setting


def set_back_ns(recorded: Iterable[BagMessage]) -> int:
    """The longest step back of the clock between messages in the order of recording."""
    clock = _Clock()
    for message in recorded:
        clock.setting(message)
    return clock.set_back_ns


def in_order(recorded: Iterable[BagMessage]) -> Iterator[tuple[int, BagMessage]]:
    """Messages in the order of receipt, each with how often the clock had been set back before it.

    Those of one topic are recorded in the order of receipt.
    """
    clock = _Clock()
    keyed = (((clock.setting(message), message.log_time_ns), message) for message in recorded)
    for (setting, _), message in sorted_within(keyed, WAITING_BYTES):
        yield setting, message
