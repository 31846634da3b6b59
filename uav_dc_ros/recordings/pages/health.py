"""State of the system that recorded a bag: latencies, node diagnostics, faults."""

import math
import re
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from uav_dc_ros import topics
from uav_dc_ros.bags.message_definitions import typestore
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.messages import TEXT_MAX, Phase
from uav_dc_ros.recordings.marks import read_marks
from uav_dc_ros.recordings.pages.missions import MissionData
from uav_dc_ros.recordings.recorded_step import UNFINISHED, RecordedStep, mission_name
from uav_dc_ros.recordings.step_reader import STEP_TOPICS, Steps
from uav_dc_ros.recordings.thinning import EveryNth

SAMPLES_MAX = 100_000  # of a latency, for its percentiles
FAULTS_MAX = 300  # rows
NODES_MAX = 100  # more names than any graph of ours has
SERIES_MAX = 400  # points of a curve, and values for a median
COUNTERS = ("restarts", "rejected", "step overruns", "hovered steps")  # values that only increase
# `handling` is missing in older bags, where the latency of some nodes ends at the receipt.
LATENCY = re.compile(r"(?P<topic>\S+)(?: handling)? latency (?P<percentile>p50|p99) \[ms\]")
LATENCIES_MAX = 50  # topics of a node: more than any node of ours has
CHAIN = (("users", "rates"), ("rates", "move"), ("users", "move"))  # publications within a step


class Samples:
    """Numbers, evenly thinned when there are many; `count` and `max` are of all of them."""

    def __init__(self, max_kept: int = SAMPLES_MAX) -> None:
        self.count = 0
        self.max: float | None = None
        self._values: EveryNth[float] = EveryNth(max_kept)

    def add(self, value: float) -> None:
        """Add a number."""
        self._values.add(self.count, value)
        self.count += 1
        self.max = value if self.max is None else max(self.max, value)

    def median(self) -> float | None:
        """Median; None without numbers."""
        return float(np.median(self._values.kept)) if self.count else None

    def row(self) -> dict[str, Any]:
        """Of durations in nanoseconds: count, median, 99th percentile and maximum, milliseconds."""
        if self.max is None:
            return {"count": 0, "p50_ms": None, "p99_ms": None, "max_ms": None}
        p50, p99 = np.percentile(np.asarray(self._values.kept), (50, 99)) * 1e-6
        return {
            "count": self.count,
            "p50_ms": round(float(p50), 3),
            "p99_ms": round(float(p99), 3),
            "max_ms": round(self.max * 1e-6, 3),
        }


@dataclass
class _Topic:
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
        # Both times are equal where a recorder does not record the time of publication.
        if 0 < message.publish_time_ns != now_ns:
            self.latency.add(now_ns - message.publish_time_ns)

    def row(self, name: str) -> dict[str, Any]:
        duration_s = (self.last_ns - self.first_ns) * 1e-9
        return {
            "name": name,
            **self.latency.row(),
            "count": self.gap.count + 1,
            "rate_hz": round(self.gap.count / duration_s, 2) if duration_s > 0 else None,
            "longest_gap_ms": self.gap.row()["max_ms"],
        }


class NodeStatus(NamedTuple):
    """One status of a diagnostic_msgs/DiagnosticArray; levels above 0 are warnings and errors."""

    level: int
    message: str
    values: dict[str, str]


class NodeHistory:
    """The statuses of a node."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._reports = 0
        self._warnings = 0
        self._last = NodeStatus(0, "", {})
        self._cpu = Samples(SERIES_MAX)
        self._cpu_curve: EveryNth[tuple[float, float]] = EveryNth(SERIES_MAX)  # time, load
        self._latencies: dict[str, dict[str, Samples]] = {}

    def add(self, at_s: float, status: NodeStatus) -> list[str]:
        """Add the next status; returns what has become worse, as text."""
        news = self._news(status)
        self._reports += 1
        self._warnings += status.level > 0
        self._last = status
        for key, text in status.values.items():
            value = _number(text)
            latency = LATENCY.fullmatch(key)
            if value is None:
                continue
            if key == "cpu [%]":
                self._cpu_curve.add(self._cpu.count, (round(at_s, 2), value))
                self._cpu.add(value)
            elif latency and (latency["topic"] in self._latencies or len(self._latencies) < LATENCIES_MAX):
                percentiles = self._latencies.setdefault(latency["topic"], {})
                percentiles.setdefault(latency["percentile"], Samples(SERIES_MAX)).add(value)
        return news

    def data(self) -> dict[str, Any]:
        """Page data: last state and counters, median and worst latencies, CPU load over time."""
        values = self._last.values
        return {
            "name": self.name,
            "state": self._last.message,
            "reports": self._reports,
            "warnings": self._warnings,
            "cpu_median": self._cpu.median(),
            "cpu_max": self._cpu.max,
            "cpu": self._cpu_curve.kept,
            "restarts": values.get("restarts"),
            "counters": {key: text for key, text in values.items() if _is_counter(key) and text != "0"},
            "latencies": [
                {
                    "topic": topic,
                    "p50_ms": series["p50"].median() if "p50" in series else None,
                    "p99_ms": series["p99"].max if "p99" in series else None,
                }
                for topic, series in self._latencies.items()
            ],
        }

    def _news(self, status: NodeStatus) -> list[str]:
        news = []
        if status.level > 0 and (status.level, status.message) != self._last[:2]:
            news.append(status.message)
        for key, text in status.values.items():
            before = _number(self._last.values.get(key, "0")) or 0.0
            now = _number(text)
            if _is_counter(key) and now is not None and now > before:
                news.append(f"{key}: {text}" + (f" (+{now - before:.0f})" if before else ""))
        return news


def _is_counter(key: str) -> bool:
    """Whether a key is a counter, such as `restarts`, `restarts of world` or `pose rejected: malformed`."""
    return key.partition(":")[0].partition(" of ")[0].endswith(COUNTERS)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


class Health:
    """State of the recorded system in a namespace."""

    def __init__(self, reader: BagReader, namespace: str) -> None:
        self._reader, self._namespace = reader, namespace
        self._chain = {pair: Samples() for pair in CHAIN}
        self._topics: dict[str, _Topic] = {}
        self._nodes: dict[str, NodeHistory] = {}
        self._bad_diagnostics = 0
        self._faults: list[tuple[int, str, str]] = []  # time since the epoch, source, text
        self._n_faults = 0

    def add_step(self, step: RecordedStep) -> RecordedStep:
        """Add the times between the publications of a step; returns the step."""
        for (before, after), samples in self._chain.items():
            if before in step.publish_ns and after in step.publish_ns:
                samples.add(step.publish_ns[after] - step.publish_ns[before])
        return step

    def add_mission(self, mission: MissionData) -> None:
        """Add the faults of a mission."""
        name = mission_name(mission.index, mission.flight)
        for what, count in mission.faults.items():
            self._fault(mission.last_ns, name, f"{what}: {count}")
        if mission.totals.outcome in (Phase.ABORTED, UNFINISHED):
            end = "aborted" if mission.totals.is_over else "its end is not in the bag"
            why = f": {mission.reason}" if mission.reason else ""
            self._fault(mission.last_ns, name, f"{end}, after step {mission.totals.steps}{why}")
        for step, report in mission.timeline.reports if mission.timeline else ():
            if report.held:
                self._fault(report.log_ns, name, f"step {step}: {report.reason}")

    def read(self, steps: Steps) -> None:
        """Read the bag once more, for message times and diagnostics; add messages that `steps` left out."""
        for (topic, reason), count in steps.rejected.items():
            why = f"unreadable messages ({reason}): {count}: {steps.rejected.first[topic, reason]}"
            self._fault(self._reader.first_ns, topic, why)
        for topic, count in steps.orphans.items():
            self._fault(self._reader.first_ns, topic, f"messages too late for their step: {count}")
        ours = {f"{self._namespace}/{name}" for name in topics.TOPICS}
        diagnostics = f"{self._namespace}/diagnostics"
        if diagnostics not in self._reader.topics:
            diagnostics = "/diagnostics"  # where other tools publish them
        wanted = [name for name in self._reader.topics if name in ours or name == diagnostics]
        for message in self._reader.messages(wanted):
            self._topics.setdefault(message.topic, _Topic()).add(message)
            if message.type == topics.DIAGNOSTICS:
                self._add_diagnostics(message)
        if self._bad_diagnostics:
            self._fault(self._reader.first_ns, "diagnostics", f"unreadable messages: {self._bad_diagnostics}")

    def data(self) -> dict[str, Any]:
        """Page data."""
        start_ns = self._reader.first_ns
        steps = [f"{self._namespace}/{name}" for name in STEP_TOPICS]
        # Topics of a step first, in their order.
        names = [name for name in steps if name in self._topics] + sorted(set(self._topics) - set(steps))
        return {
            "duration_s": (self._reader.last_ns - start_ns) * 1e-9,
            "chain": [{"name": " → ".join(pair)} | samples.row() for pair, samples in self._chain.items()],
            "topics": [self._topics[name].row(name) for name in names],
            "nodes": [node.data() for _, node in sorted(self._nodes.items())],
            "faults": [
                {"s": (at_ns - start_ns) * 1e-9, "source": source, "what": what}
                for at_ns, source, what in sorted(self._faults)
            ],
            "faults_total": self._n_faults,
            "marks": [{"s": mark.s, "text": mark.text} for mark in read_marks(self._reader, self._namespace)],
        }

    def _add_diagnostics(self, message: BagMessage) -> None:
        try:
            array: Any = typestore().deserialize_cdr(message.data, topics.DIAGNOSTICS)
            statuses = [
                (it.name, NodeStatus(it.level, it.message, {pair.key: pair.value for pair in it.values}))
                for it in array.status
            ]
        except Exception:  # of struct, numpy, rosbags: any bytes may be recorded
            self._bad_diagnostics += 1
            return
        at_s = (message.log_time_ns - self._reader.first_ns) * 1e-9
        for name, status in statuses:
            if name not in self._nodes and len(self._nodes) >= NODES_MAX:
                continue
            news = self._nodes.setdefault(name, NodeHistory(name)).add(at_s, status)
            if news:
                self._fault(message.log_time_ns, name, "; ".join(news))

    def _fault(self, at_ns: int, source: str, what: str) -> None:
        self._n_faults += 1
        if len(self._faults) < FAULTS_MAX:
            self._faults.append((at_ns, source[:TEXT_MAX], what[:TEXT_MAX]))
