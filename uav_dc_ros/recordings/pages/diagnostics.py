"""Diagnostics of a node over a whole recording, in bounded memory."""

import math
import re
from typing import Any, NamedTuple

import numpy as np

from uav_dc_ros.recordings.thinning import EveryNth

SERIES_MAX = 400  # points of a curve, and values for a median
COUNTERS = ("restarts", "rejected", "step overruns", "hovered steps")  # values that only increase
# `handling` is missing in older bags, where the latency of some nodes ends at the receipt.
LATENCY = re.compile(r"(?P<topic>\S+)(?: handling)? latency (?P<percentile>p50|p99) \[ms\]")
LATENCIES_MAX = 50  # topics of a node: more than any node of ours has


class NodeStatus(NamedTuple):
    """One status of a diagnostic_msgs/DiagnosticArray; levels above 0 are warnings and errors."""

    level: int
    message: str
    values: dict[str, str]


class Series:
    """A curve, evenly thinned when it is long."""

    def __init__(self) -> None:
        self.max = -math.inf
        self._points: EveryNth[tuple[float, float]] = EveryNth(SERIES_MAX)
        self._count = 0

    def add(self, at_s: float, value: float) -> None:
        """Add the next point."""
        self._points.add(self._count, (round(at_s, 2), value))
        self._count += 1
        self.max = max(self.max, value)

    @property
    def points(self) -> list[tuple[float, float]]:
        """Time and value of the points kept."""
        return self._points.kept

    def median(self) -> float:
        """Median of the values kept."""
        return float(np.median([value for _, value in self.points]))


class NodeHistory:
    """The statuses of a node."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._reports = 0
        self._warnings = 0
        self._silence_s = 0.0
        self._last_s = 0.0
        self._last = NodeStatus(0, "", {})
        self._cpu = Series()
        self._latencies: dict[str, dict[str, Series]] = {}

    def add(self, at_s: float, status: NodeStatus) -> list[str]:
        """Add the next status; returns what has become worse, as text."""
        if self._reports:
            self._silence_s = max(self._silence_s, at_s - self._last_s)
        news = self._news(status)
        self._reports += 1
        self._warnings += status.level > 0
        self._last_s, self._last = at_s, status
        for key, text in status.values.items():
            value = _number(text)
            latency = LATENCY.fullmatch(key)
            if value is None:
                continue
            if key == "cpu [%]":
                self._cpu.add(at_s, value)
            elif latency and (latency["topic"] in self._latencies or len(self._latencies) < LATENCIES_MAX):
                percentiles = self._latencies.setdefault(latency["topic"], {})
                percentiles.setdefault(latency["percentile"], Series()).add(at_s, value)
        return news

    def data(self) -> dict[str, Any]:
        """Page data: last state and counters, median and worst latencies, CPU load over time."""
        values = self._last.values
        return {
            "name": self.name,
            "state": self._last.message,
            "reports": self._reports,
            "warnings": self._warnings,
            "longest_silence_s": self._silence_s,
            "cpu_median": self._cpu.median() if self._cpu.points else None,
            "cpu_max": self._cpu.max if self._cpu.points else None,
            "cpu": self._cpu.points,
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
