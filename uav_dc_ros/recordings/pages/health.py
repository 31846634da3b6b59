"""When a bag's messages came, what nodes told about themselves, and what went wrong."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uav_dc_ros import topics
from uav_dc_ros.bags.message_definitions import typestore
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.messages import TEXT_MAX, Phase
from uav_dc_ros.recordings.mission_totals import UNFINISHED
from uav_dc_ros.recordings.pages.diagnostics import Node, Report
from uav_dc_ros.recordings.pages.missions import Flown
from uav_dc_ros.recordings.recorded_step import RecordedStep
from uav_dc_ros.recordings.step_reader import STEP_TOPICS, Steps
from uav_dc_ros.recordings.thinning import EveryNth

SAMPLES_MAX = 100_000  # of a latency: percentiles need no more
FAULTS_MAX = 300  # rows told one by one
NODES_MAX = 100  # more different names than any graph of ours: somebody else's diagnostics
# What follows what within a step: how long the graph takes from one to the other.
CHAIN = (("users", "rates"), ("rates", "move"), ("users", "move"))


class Samples:
    """Durations, nanoseconds: all of few, evenly thinned out of many; the greatest one is never lost."""

    def __init__(self) -> None:
        self.count = 0
        self.max_ns: int | None = None
        self._values_ns: EveryNth[int] = EveryNth(SAMPLES_MAX)

    def add(self, value_ns: int) -> None:
        """One more."""
        self._values_ns.add(self.count, value_ns)
        self.count += 1
        self.max_ns = value_ns if self.max_ns is None else max(self.max_ns, value_ns)

    def row(self) -> dict[str, Any]:
        """Count, median, 99th percentile and maximum, milliseconds; None without any."""
        if self.max_ns is None:
            return {"count": 0, "p50_ms": None, "p99_ms": None, "max_ms": None}
        p50, p99 = np.percentile(np.asarray(self._values_ns.kept), (50, 99)) * 1e-6
        return {
            "count": self.count,
            "p50_ms": round(float(p50), 3),
            "p99_ms": round(float(p99), 3),
            "max_ms": round(self.max_ns * 1e-6, 3),
        }


@dataclass
class _Topic:
    """Messages of a topic: from publishing to receiving, and from one to the next."""

    latency: Samples = field(default_factory=Samples)
    gap: Samples = field(default_factory=Samples)
    first_ns: int = 0
    last_ns: int = 0

    def add(self, message: BagMessage) -> None:
        now_ns = message.log_time_ns
        if self.last_ns:
            self.gap.add(now_ns - self.last_ns)
        else:
            self.first_ns = now_ns
        self.last_ns = now_ns
        # Equal where a recorder does not tell when a message was published.
        if 0 < message.publish_time_ns != now_ns:
            self.latency.add(now_ns - message.publish_time_ns)


class Health:
    """What a bag tells about the system that recorded it.

    Args:
        reader: of the bag.
        namespace: of the missions, as `steps.namespace` gives it.
    """

    def __init__(self, reader: BagReader, namespace: str) -> None:
        self._reader = reader
        self._namespace = namespace
        self._chain = {f"{before} → {after}": Samples() for before, after in CHAIN}
        self._topics: dict[str, _Topic] = {}
        self._nodes: dict[str, Node] = {}
        self._bad_diagnostics = 0
        self._faults: list[tuple[int, str, str]] = []  # when (since the epoch), who, what
        self._n_faults = 0

    def hear(self, step: RecordedStep) -> None:
        """Note how long the graph took for a step, by the clock of who published."""
        for before, after in CHAIN:
            if before in step.publish_ns and after in step.publish_ns:
                took_ns = step.publish_ns[after] - step.publish_ns[before]
                self._chain[f"{before} → {after}"].add(took_ns)

    def missed(self, flown: Flown) -> None:
        """Note what a mission lacks."""
        name = f"mission {flown.index}" + (f" of flight {flown.flight}" if flown.flight else "")
        for what, count in flown.faults.items():
            self._fault(flown.last_ns, name, f"{what}: {count}")
        if flown.totals.outcome in (Phase.ABORTED, UNFINISHED):
            told = "aborted" if flown.totals.is_over else "its end is not in the bag"
            why = f": {flown.reason}" if flown.reason else ""
            self._fault(flown.last_ns, name, f"{told}, after step {flown.totals.steps}{why}")
        for step, word in flown.journey.words if flown.journey else ():
            if word.held:
                self._fault(word.log_ns, name, f"step {step}: {word.reason}")

    def read(self) -> None:
        """Go through the bag once more, for its times and the nodes' diagnostics."""
        ours = {f"{self._namespace}/{name}" for name in topics.TOPICS}
        diagnostics = f"{self._namespace}/diagnostics"
        if diagnostics not in self._reader.topics:
            diagnostics = "/diagnostics"  # where tools of others tell them
        wanted = [name for name in self._reader.topics if name in ours or name == diagnostics]
        for message in self._reader.messages(wanted):
            self._topics.setdefault(message.topic, _Topic()).add(message)
            if message.type == topics.DIAGNOSTICS:
                self._diagnose(message)
        if self._bad_diagnostics:
            self._fault(self._reader.first_ns, "diagnostics", f"unreadable messages: {self._bad_diagnostics}")

    def count(self, steps: Steps) -> None:
        """Note what could not be read, or came too late to belong to its step."""
        for (topic, reason), count in steps.rejected.items():
            why = steps.rejected.first_error(topic, reason)
            self._fault(self._reader.first_ns, topic, f"unreadable messages ({reason}): {count}: {why}")
        for topic, count in steps.orphans.items():
            self._fault(self._reader.first_ns, topic, f"messages of steps that were over already: {count}")

    def page(self) -> dict[str, Any]:
        """The page's data."""
        return {
            "start_ns": self._reader.first_ns,
            "duration_s": (self._reader.last_ns - self._reader.first_ns) * 1e-9,
            "chain": [{"name": name} | samples.row() for name, samples in self._chain.items()],
            "topics": [self._topic_row(name) for name in self._in_order()],
            "nodes": [node.page() for _, node in sorted(self._nodes.items())],
            "faults": [
                {"s": (at_ns - self._reader.first_ns) * 1e-9, "who": who, "what": what}
                for at_ns, who, what in sorted(self._faults)
            ],
            "faults_total": self._n_faults,
        }

    def _in_order(self) -> list[str]:
        """Topics of a step first, in their order, then the others."""
        known = [f"{self._namespace}/{name}" for name in STEP_TOPICS]
        return [name for name in known if name in self._topics] + sorted(set(self._topics) - set(known))

    def _topic_row(self, name: str) -> dict[str, Any]:
        topic = self._topics[name]
        lasted_s = (topic.last_ns - topic.first_ns) * 1e-9
        gap = topic.gap.row()
        return {
            "name": name,
            **topic.latency.row(),
            "count": topic.gap.count + 1,
            "rate_hz": round(topic.gap.count / lasted_s, 2) if lasted_s > 0 else None,
            "gap_ms": gap["p50_ms"],
            "longest_gap_ms": gap["max_ms"],
        }

    def _diagnose(self, message: BagMessage) -> None:
        try:
            array: Any = typestore().deserialize_cdr(message.data, topics.DIAGNOSTICS)
            told = [
                (it.name, Report(it.level, it.message, {pair.key: pair.value for pair in it.values}))
                for it in array.status
            ]
        except Exception:  # of struct, numpy, rosbags: whatever the bytes make of it
            self._bad_diagnostics += 1
            return
        at_s = (message.log_time_ns - self._reader.first_ns) * 1e-9
        for name, report in told:
            if name not in self._nodes and len(self._nodes) >= NODES_MAX:
                continue
            news = self._nodes.setdefault(name, Node(name)).add(at_s, report)
            if news:
                self._fault(message.log_time_ns, name, "; ".join(news))

    def _fault(self, at_ns: int, who: str, what: str) -> None:
        self._n_faults += 1
        if len(self._faults) < FAULTS_MAX:
            self._faults.append((at_ns, who[:TEXT_MAX], what[:TEXT_MAX]))
