"""What a node reports about itself once a second: rates, latencies, rejected messages, restarts.

Keys of a node's status, besides those of its own (`MissionNode.diagnose`); TOPIC is a topic's name:

state                                   of the life cycle
restarts                                how often run_all has restarted it
process id                              of its process, which other nodes may share
cpu [%]                                 of one core, over the last period, the whole process
TOPIC published [Hz]                    messages published
TOPIC received [Hz]                     messages handled
TOPIC transport latency p50, p99 [ms]   from publishing a message to its receipt by this node's middleware
TOPIC handling latency p50, p99 [ms]    from publishing a message to the end of its handling in this node
TOPIC rejected: REASON                  messages rejected since the start

Latencies are those of the last period; between hosts they hold as far as their clocks agree. Older bags have
one `TOPIC latency p50 [ms]`: until the end of the handling, or until the receipt where a node keeps messages
as bytes (recorder, visualizer, live view).
"""

import os
import time
from collections import Counter, deque
from collections.abc import Mapping

import numpy as np

PERIOD_S = 1.0
LATENCIES = ("transport", "handling")
LATENCIES_KEPT = 4096  # the newest of one topic and period


class MessageStatistics:
    """Counts the messages of a node, and measures their latencies."""

    def __init__(self) -> None:
        self.rejected: Counter[tuple[str, str]] = Counter()  # since the start, by topic and reason
        self.published: Counter[str] = Counter()  # in this period, by topic
        self._received: Counter[str] = Counter()
        self._latencies_ns: dict[str, deque[tuple[int, int]]] = {}  # in the order of LATENCIES
        self._since_s = time.monotonic()
        self._cpu_s = time.process_time()
        self._rejected_before = 0

    def count_received(self, topic: str, info: Mapping[str, int]) -> None:
        """Count a message that was just handled; `info` is its rclpy message info."""
        self._received[topic] += 1
        if topic not in self._latencies_ns:
            self._latencies_ns[topic] = deque(maxlen=LATENCIES_KEPT)
        published_ns = info["source_timestamp"]
        latencies_ns = info["received_timestamp"] - published_ns, time.time_ns() - published_ns
        self._latencies_ns[topic].append(latencies_ns)

    def report(self) -> tuple[bool, dict[str, str]]:
        """Whether messages were rejected since the last report, and the values. Begins a new period."""
        now_s, cpu_s = time.monotonic(), time.process_time()
        period_s = max(now_s - self._since_s, 1e-9)
        # Nodes that share a process report the same values for it.
        values = {"process id": str(os.getpid()), "cpu [%]": f"{100 * (cpu_s - self._cpu_s) / period_s:.1f}"}
        for topic, count in self.published.items():
            values[f"{topic} published [Hz]"] = f"{count / period_s:.1f}"
        for topic, count in self._received.items():
            values[f"{topic} received [Hz]"] = f"{count / period_s:.1f}"
            if latencies_ns := self._latencies_ns[topic]:
                percentiles_ms = np.percentile(np.asarray(latencies_ns), (50, 99), axis=0) * 1e-6
                for name, (p50, p99) in zip(LATENCIES, percentiles_ms.T, strict=True):
                    values[f"{topic} {name} latency p50 [ms]"] = f"{p50:.3f}"
                    values[f"{topic} {name} latency p99 [ms]"] = f"{p99:.3f}"
                latencies_ns.clear()
        for (topic, reason), count in self.rejected.items():
            values[f"{topic} rejected: {reason}"] = str(count)
        rejected = self.rejected.total()
        has_rejected, self._rejected_before = rejected > self._rejected_before, rejected
        self._since_s, self._cpu_s = now_s, cpu_s
        for counts in (self._received, self.published):
            for topic in counts:
                counts[topic] = 0
        return has_rejected, values
