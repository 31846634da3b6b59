"""What a node reports about itself once a second: rates, latencies, what it rejected, restarts.

Values of a node's status, beside those of its own (`MissionNode.diagnose`), by key; TOPIC is a topic's name:

state                                   of the life cycle
restarts                                how often run_all has started it again
process id                              of its process, which others may share
cpu [%]                                 of one core, over the last period, the whole process
TOPIC said [Hz]                         messages published
TOPIC heard [Hz]                        messages handled
TOPIC transport latency p50, p99 [ms]   from publishing a message to its receipt by this node's middleware
TOPIC handling latency p50, p99 [ms]    from publishing a message to the end of its handling in this node
TOPIC rejected: REASON                  messages refused since the start

Latencies are those of the last period; between hosts they hold as far as their clocks agree. Older bags have
one `TOPIC latency p50 [ms]`: until the end of the handling, but until the receipt where a node keeps messages
as bytes (recorder, visualizer, live view).
"""

import os
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

PERIOD_S = 1.0
LATENCIES = ("transport", "handling")  # from publishing to the receipt, and to the end of the handling
LATENCIES_KEPT = 4096  # of one topic and period: the last ones


class MessageStatistics:
    """Counts what a node hears and says, and how long messages took.

    Attributes:
        rejected: refused messages since the start, by topic and reason.
    """

    def __init__(self) -> None:
        self.rejected: Counter[tuple[str, str]] = Counter()
        self._heard: Counter[str] = Counter()
        self._said: Counter[str] = Counter()
        self._latencies_ns: dict[str, deque[tuple[int, int]]] = {}  # in the order of LATENCIES
        self._since_s = time.monotonic()
        self._cpu_s = time.process_time()
        self._rejected_before = 0

    def heard(self, topic: str, info: Mapping[str, int]) -> None:
        """Note a message that was handled just now; `info` came with it."""
        self._heard[topic] += 1
        if topic not in self._latencies_ns:
            self._latencies_ns[topic] = deque(maxlen=LATENCIES_KEPT)
        published_ns = info["source_timestamp"]
        latencies_ns = info["received_timestamp"] - published_ns, time.time_ns() - published_ns
        self._latencies_ns[topic].append(latencies_ns)

    def said(self, topic: str) -> None:
        """Note a message that was published."""
        self._said[topic] += 1

    def report(self) -> tuple[bool, dict[str, str]]:
        """Was anything rejected since the last report, and the values; begins a new period."""
        now_s, cpu_s = time.monotonic(), time.process_time()
        period_s = max(now_s - self._since_s, 1e-9)
        # Nodes that share a process tell the same of it.
        values = {"process id": str(os.getpid()), "cpu [%]": f"{100 * (cpu_s - self._cpu_s) / period_s:.1f}"}
        for topic, count in self._said.items():
            values[f"{topic} said [Hz]"] = f"{count / period_s:.1f}"
        for topic, count in self._heard.items():
            values[f"{topic} heard [Hz]"] = f"{count / period_s:.1f}"
            if latencies_ns := self._latencies_ns[topic]:
                percentiles_ms = np.percentile(np.asarray(latencies_ns), (50, 99), axis=0) * 1e-6
                for name, (p50, p99) in zip(LATENCIES, percentiles_ms.T, strict=True):
                    values[f"{topic} {name} latency p50 [ms]"] = f"{p50:.3f}"
                    values[f"{topic} {name} latency p99 [ms]"] = f"{p99:.3f}"
                latencies_ns.clear()
        for (topic, reason), count in self.rejected.items():
            values[f"{topic} rejected: {reason}"] = str(count)
        rejected = self.rejected.total()
        news, self._rejected_before = rejected > self._rejected_before, rejected
        self._since_s, self._cpu_s = now_s, cpu_s
        for counts in (self._heard, self._said):
            for topic in counts:
                counts[topic] = 0
        return news, values


def status(name: str, warnings: Iterable[str], told: str, values: Mapping[str, str]) -> DiagnosticStatus:
    """A node's status: a warning if there is any, else OK with what is told."""
    warned = "; ".join(warnings)
    return DiagnosticStatus(
        level=DiagnosticStatus.WARN if warned else DiagnosticStatus.OK,
        name=name,
        message=warned or told,
        hardware_id="uav_dc_ros",
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
