"""What a node tells about itself once a second, followed over a whole recording in bounded memory."""

import math
import re
from typing import Any, NamedTuple

import numpy as np

from uav_dc_ros.recordings.thinning import EveryNth

SERIES_MAX = 400  # points of a curve, and values of which a median is taken
COUNTERS = ("restarts", "rejected", "step overruns", "hovered steps")  # values that only ever rise
# Until the end of the handling; without a word, as older bags have it, of some nodes until the receipt only.
LATENCY = re.compile(r"(?P<topic>\S+)(?: handling)? latency (?P<percentile>p50|p99) \[ms\]")
LATENCIES_MAX = 50  # topics of a node: more has none of ours


class Report(NamedTuple):
    """One status of a diagnostic_msgs/DiagnosticArray: above level 0 something is wrong."""

    level: int
    message: str
    values: dict[str, str]


class Series:
    """Points in time, evenly thinned out when there are many."""

    def __init__(self) -> None:
        self.max = -math.inf
        self._points: EveryNth[tuple[float, float]] = EveryNth(SERIES_MAX)
        self._seen = 0

    def add(self, at_s: float, value: float) -> None:
        """The next one."""
        self._points.add(self._seen, (round(at_s, 2), value))
        self._seen += 1
        self.max = max(self.max, value)

    @property
    def points(self) -> list[tuple[float, float]]:
        """Those kept: time, value."""
        return self._points.kept

    def median(self) -> float:
        """Of the values kept."""
        return float(np.median([value for _, value in self.points]))


class Node:
    """A node, from report to report.

    Args:
        name: its name.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._reports = 0
        self._warnings = 0
        self._silence_s = 0.0
        self._last_s = 0.0
        self._last = Report(0, "", {})
        self._cpu = Series()
        self._latencies: dict[str, dict[str, Series]] = {}

    def add(self, at_s: float, report: Report) -> list[str]:
        """The next report; returns what in it is worse than before, in words."""
        if self._reports:
            self._silence_s = max(self._silence_s, at_s - self._last_s)
        news = self._news(report)
        self._reports += 1
        self._warnings += report.level > 0
        self._last_s, self._last = at_s, report
        for key, text in report.values.items():
            value = _number(text)
            latency = LATENCY.fullmatch(key)
            if value is None:
                continue
            if key == "cpu [%]":
                self._cpu.add(at_s, value)
            elif latency is not None and self._may_be_new(latency["topic"]):
                percentiles = self._latencies.setdefault(latency["topic"], {})
                percentiles.setdefault(latency["percentile"], Series()).add(at_s, value)
        return news

    def page(self) -> dict[str, Any]:
        """The page's data: the last state and counters, the usual and the worst latencies, CPU over time."""
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
            "heard": [
                {
                    "topic": topic,
                    "p50_ms": series["p50"].median() if "p50" in series else None,
                    "p99_ms": series["p99"].max if "p99" in series else None,
                }
                for topic, series in self._latencies.items()
            ],
        }

    def _may_be_new(self, topic: str) -> bool:
        return topic in self._latencies or len(self._latencies) < LATENCIES_MAX

    def _news(self, report: Report) -> list[str]:
        news = []
        if report.level > 0 and (report.level, report.message) != self._last[:2]:
            news.append(report.message)
        for key, text in report.values.items():
            before = _number(self._last.values.get(key, "0")) or 0.0
            now = _number(text)
            if _is_counter(key) and now is not None and now > before:
                news.append(f"{key}: {text}" + (f" (+{now - before:.0f})" if before else ""))
        return news


def _is_counter(key: str) -> bool:
    """Whether it is a counter, such as `restarts`, `restarts of world` or `pose rejected: malformed`."""
    return key.partition(":")[0].partition(" of ")[0].endswith(COUNTERS)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
