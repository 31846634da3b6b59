"""The missions that the page shows, and what of them each page has not received yet."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import msgspec

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Mission
from uav_dc_ros.nodes.view.web.mission_history import MissionHistory

MISSIONS_MAX = 8  # of a namespace that the page can go back to


@dataclass
class _Sent:
    """What a page has of a mission."""

    version: int = -1
    step: int = -1
    event: int = 0
    path_factor: int = 1
    path_points: int = 0


class Cursor:
    """What one page has received."""

    def __init__(self) -> None:
        self.version = -1  # of the feed
        self.sent: dict[int, _Sent] = {}  # by key of the mission


class Feed:
    """Missions by namespace, run and number. One thread changes them, others send them to pages."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._version = 0
        self._missions: dict[tuple[str, str, int], MissionHistory] = {}
        self._n_missions = 0

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Change missions, and wake the threads that wait for it."""
        with self._condition:
            yield
            self._version += 1
            self._condition.notify_all()

    def find(self, namespace: str, run: str, mission: int) -> MissionHistory | None:
        """A mission that the page shows."""
        return self._missions.get((namespace, run, mission))

    def begin(self, namespace: str, first: Mission, scenario: Scenario | None) -> MissionHistory:
        """Add a mission; the oldest of its namespace is dropped where there are too many."""
        self._n_missions += 1
        history = MissionHistory(self._n_missions, namespace, first, scenario)
        self._missions[namespace, first.run, first.mission] = history
        of_namespace = [key for key in self._missions if key[0] == namespace]
        for key in of_namespace[:-MISSIONS_MAX]:
            del self._missions[key]
        return history

    def wait(self, cursor: Cursor, timeout_s: float) -> bool:
        """Wait for a change that a page has not received; false after the timeout."""
        with self._condition:
            return self._condition.wait_for(lambda: self._version != cursor.version, timeout_s)

    def news(self, cursor: Cursor) -> bytes:
        """What a page has not received, as JSON; it counts as received from now on."""
        with self._condition:
            cursor.version = self._version
            missions = list(self._missions.values())
            news = [
                _news(one, cursor.sent.setdefault(one.key, _Sent()))
                for one in missions
                if one.key not in cursor.sent or cursor.sent[one.key].version != one.version
            ]
            keys = [one.key for one in missions]
            for key in cursor.sent.keys() - set(keys):
                del cursor.sent[key]
            return msgspec.json.encode({"keys": keys, "missions": news})


def _news(one: MissionHistory, sent: _Sent) -> dict[str, object]:
    """What a page lacks of a mission. It drops steps that `stride` does not divide, but not the last."""
    news: dict[str, object] = {"key": one.key, "stride": one.stride, "now": one.now()}
    if sent.version < 0:
        news["head"] = one.head()
    steps = [(number, step) for number, step in one.steps if number > sent.step]
    if steps:
        news["steps"] = [step for _, step in steps]
        sent.step = steps[-1][0]
    if events := [event for number, event in one.events if number > sent.event]:
        news["events"] = events
        sent.event = one.events[-1][0]
    path = one.path
    begin = sent.path_points if path.factor == sent.path_factor else 0
    if len(path.kept) > begin or begin == 0:
        news |= {
            "path_from": begin,
            "path": [[round(value, 2) for value in point] for point in path.kept[begin:]],
        }
    sent.path_factor, sent.path_points, sent.version = path.factor, len(path.kept), one.version
    return news
