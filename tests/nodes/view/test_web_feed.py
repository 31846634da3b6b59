"""What the page of the live view receives: all of a mission, in bounded memory, however fast it flies."""

import base64
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.worlds import tiny
from uav_dc_ros import cdr, messages
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import FaultKind, Mission, Phase, Rates, Users
from uav_dc_ros.nodes.view.web import inbox, mission_history
from uav_dc_ros.nodes.view.web.feed import MISSIONS_MAX, Cursor, Feed
from uav_dc_ros.nodes.view.web.inbox import Inbox

WORLD = tiny()
STEPS_MAX = 40  # kept in the tests
RUN = "0123456789abcdef"


def status(step: int, phase: Phase = Phase.READY, mission: int = 0, **more: Any) -> Mission:
    return Mission(
        **{"run": RUN, "fingerprint": WORLD.fingerprint, "scenario": WORLD.name, "seed": 3} | more,
        mission=mission,
        step=step,
        phase=phase,
        cell=(min(step, 1), 0, 0),
        remaining_steps=max(WORLD.mission.max_steps - step, 0),
    )


def users(step: int, mission: int = 0, n: int = WORLD.n_users) -> Users:
    east_m = [float(10 * step + i) for i in range(n)]
    cluster = WORLD.user_cluster.tolist() if n == WORLD.n_users else [0] * n
    return Users(run=RUN, mission=mission, step=step, stamp_ns=0, cluster=cluster, x_m=east_m, y_m=[1.0] * n)


def rates(step: int, collected: int = 0, mission: int = 0, n: int = WORLD.n_users) -> Rates:
    zeros, done = [0.0] * n, [i < collected for i in range(n)]
    return Rates(
        run=RUN,
        mission=mission,
        step=step,
        sum_rate_bps=1e3 * step,
        sinr=zeros,
        rate_bps=zeros,
        data_bits=zeros,
        served=[not one for one in done],
        collected=done,
    )


class Page:
    """A page that keeps what it receives, as view.js does."""

    def __init__(self, feed: Feed) -> None:
        self.feed, self.cursor = feed, Cursor()
        self.missions: dict[int, dict[str, Any]] = {}

    def read(self) -> dict[int, dict[str, Any]]:
        news = msgspec.json.decode(self.feed.news(self.cursor))
        for key in self.missions.keys() - set(news["keys"]):
            del self.missions[key]
        for one in news["missions"]:
            mission = self.missions.setdefault(one["key"], {"steps": [], "events": [], "path": []})
            mission |= {name: one[name] for name in ("head", "now") if name in one}
            steps = mission["steps"] + one.get("steps", [])
            last = len(steps) - 1
            mission["steps"] = [
                s for i, s in enumerate(steps) if i in (0, last) or s["step"] % one["stride"] == 0
            ]
            mission["events"] += one.get("events", [])
            if "path" in one:
                mission["path"][one["path_from"] :] = one["path"]
        return self.missions


class Flight:
    """An inbox, its feed, and what was rejected."""

    def __init__(self, namespace: str = "/", feed: Feed | None = None, known: bool = True) -> None:
        self.feed = feed or Feed()
        self.now_s = 100.0
        self.inbox = Inbox(namespace, self.feed, lambda *_: WORLD if known else None, lambda: self.now_s)
        self.rejected: list[tuple[str, str]] = []

    def send(self, *payloads: messages.Payload) -> None:
        for payload in payloads:
            self.inbox.add(type(payload).__name__.lower(), cdr.encode_string(messages.encode(payload)))

    def step(self, step: int, mission: int = 0, collected: int = 0) -> None:
        self.send(users(step, mission), rates(step, collected, mission), status(step, mission=mission))

    def update(self) -> None:
        with self.feed.changing():
            self.inbox.update(lambda topic, error: self.rejected.append((topic, error.reason)))


def xs(step: dict[str, Any]) -> list[float]:
    values = np.frombuffer(base64.b64decode(step["users"]), "<f4")
    return values[: len(values) // 2].tolist()


def test_a_page_receives_each_step_once_and_a_late_page_all_of_them() -> None:
    flight = Flight()
    page = Page(flight.feed)
    for step in range(4):
        flight.step(step, collected=step)
        flight.now_s += 0.5
        flight.update()
        page.read()
    late = Page(flight.feed)
    assert page.missions == late.read()
    (mission,) = page.missions.values()
    assert [step["step"] for step in mission["steps"]] == [0, 1, 2, 3]
    assert [step["s"] for step in mission["steps"]] == [0.0, 0.5, 1.0, 1.5]
    assert [step["n_collected"] for step in mission["steps"]] == [0, 1, 2, 3]
    assert mission["steps"][2]["state"] == "2" * 2 + "1" * (WORLD.n_users - 2)
    assert xs(mission["steps"][2]) == users(2).x_m
    centre_m = WORLD.grid.centre_m(np.array([1, 0, 0]), like=np.zeros(1)).tolist()
    assert mission["steps"][3]["uav_m"] == mission["path"][-1] == centre_m
    assert mission["head"]["world"]["name"] == mission["head"]["scenario"] == WORLD.name
    assert (mission["head"]["seed"], mission["now"]["step"], mission["now"]["over"]) == (3, 3, False)
    assert flight.rejected == []
    assert msgspec.json.decode(flight.feed.news(page.cursor))["missions"] == [], "nothing is sent twice"


def test_phases_and_faults_have_their_reasons_and_routine_leaves_no_rows() -> None:
    flight = Flight()
    fault = {"held": True, "fault": FaultKind.LINK, "reason": "no heartbeat for 2 s"}
    states = [
        status(0, Phase.PREFLIGHT, reason="waits for arming"),
        *(status(step, phase) for step in range(3) for phase in (Phase.READY, Phase.MOVING)),
        status(3, Phase.MOVING, **fault),
        status(3, Phase.MOVING, **fault),
        status(3, Phase.MOVING),
        status(4, Phase.LANDED, reason="at the dock"),
    ]
    for one in states:
        flight.send(one)
    flight.update()
    (mission,) = Page(flight.feed).read().values()
    rows = [(row["state"], row["fault"], row["reason"], row["step"]) for row in mission["events"]]
    assert rows[0] == ("preflight", None, "waits for arming", 0)
    assert ("moving (held)", "link", "no heartbeat for 2 s", 3) in rows
    assert rows[-1] == ("landed", None, "at the dock", 4)
    assert len(rows) <= 6
    assert mission["now"]["over"]
    assert flight.inbox.needs_pose, "a real vehicle is where its pose says"


@settings(max_examples=25, deadline=None)
@given(
    counts=st.lists(st.integers(1, 60), min_size=1, max_size=6),
    reads=st.lists(st.booleans(), min_size=6, max_size=6),
)
def test_a_long_fast_mission_is_thinned_to_the_same_steps_on_every_page(
    counts: list[int], reads: list[bool]
) -> None:
    flight = Flight()
    early = Page(flight.feed)
    step = 0
    with patch.object(mission_history, "STEPS_MAX", STEPS_MAX):
        for count, reads_now in zip(counts, reads, strict=False):
            for _ in range(count):
                flight.step(step)
                step += 1
            flight.update()
            if reads_now:
                early.read()
    (mission,), (late,) = early.read().values(), Page(flight.feed).read().values()
    kept = [one["step"] for one in late["steps"]]
    assert kept[-1] == step - 1, "the newest step is never left out"
    assert kept == sorted(set(kept))
    assert len(kept) <= STEPS_MAX + 1
    own = [one["step"] for one in mission["steps"]]
    assert own == sorted(set(own))
    assert set(kept) <= set(own) | {kept[0]}
    assert len(own) <= 2 * STEPS_MAX
    assert late["path"] == mission["path"]
    assert flight.inbox._pending == {}


def test_ten_thousand_users_are_thinned_and_the_page_can_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mission_history, "USERS_MAX", 4)
    flight = Flight(known=False)
    flight.send(status(0), users(0, n=9), rates(0, n=9))
    flight.update()
    (mission,) = Page(flight.feed).read().values()
    (step,) = mission["steps"]
    assert (len(step["state"]), step["n_users"], xs(step)) == (4, 9, [0.0, 3.0, 5.0, 8.0])
    assert mission["head"]["world"] is None
    assert flight.inbox.needs_pose, "without the scenario a cell has no position"
    flight.inbox.add_pose((1.0, 2.0, 3.0))
    flight.update()
    (mission,) = Page(flight.feed).read().values()
    assert mission["now"]["uav_m"] == [1.0, 2.0, 3.0]


def test_namespaces_stand_side_by_side_and_each_keeps_its_last_missions() -> None:
    feed = Feed()
    one, other = Flight("/uav1", feed), Flight("/uav2", feed)
    page = Page(feed)
    for mission in range(MISSIONS_MAX + 3):
        one.step(0, mission)
        one.update()
        page.read()
    other.step(0)
    other.update()
    heads = [mission["head"] for mission in page.read().values()]
    assert [head["mission"] for head in heads if head["namespace"] == "/uav1"] == list(
        range(3, 3 + MISSIONS_MAX)
    )
    assert [head["namespace"] for head in heads].count("/uav2") == 1


def test_users_without_rates_take_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inbox, "PENDING_BYTES", 5000)
    flight = Flight()
    for step in range(300):
        flight.send(users(step), users(step), status(step))
    kept = flight.inbox._pending
    assert 0 < sum(len(text) for topics in kept.values() for text, _ in topics.values()) <= 5000
    assert flight.inbox._pending_bytes <= 5000
    flight.send(rates(299))
    flight.update()
    (mission,) = Page(flight.feed).read().values()
    assert [(one["step"], xs(one)) for one in mission["steps"]] == [(299, users(299).x_m)]


def test_what_is_no_message_of_the_mission_is_rejected() -> None:
    flight = Flight()
    with pytest.raises(MessageError, match="Expected `int`"):
        flight.inbox.add("mission", cdr.encode_string(b'{"mission": "x"}'))
    flight.send(status(0))
    flight.inbox.add("rates", cdr.encode_string(b'{"run":"' + RUN.encode() + b'","mission":0,"step":0}'))
    flight.send(users(1, n=2), rates(1, n=2))
    flight.send(status(2, fingerprint="0" * 12))
    flight.update()
    assert sorted(set(flight.rejected)) == [
        ("mission", "scenario"),
        ("rates", "invalid"),
        ("rates", "layout"),
        ("users", "layout"),
    ]
    (mission,) = Page(flight.feed).read().values()
    assert mission["steps"] == []
