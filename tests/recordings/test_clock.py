"""Recordings during which the clock was set: missions and steps are identified by their payloads."""

import random
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.bags.test_foreign import run
from tests.recordings.made import BEGUN_NS, about, flight, write
from tests.recordings.test_steps import LATER_NS, STEP_NS, InMemory, plain, read
from tests.support import flights
from tests.support.bags import bare
from tests.support.worlds import tiny
from uav_dc_ros.bags import receive_order, storage
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.recordings.step_reader import Steps

SCENARIO = tiny()
FLIGHT = flight(SCENARIO, missions=3)
WHOLE = [plain(step) for step in read(FLIGHT)[0]]
SECOND = 10**9


def set_by(recorded: list[BagMessage], at: int, by_ns: int) -> list[BagMessage]:
    """The messages with all times from one of them on by so much later."""
    return [
        m._replace(log_time_ns=m.log_time_ns + by_ns, publish_time_ns=m.publish_time_ns + by_ns)
        if i >= at
        else m
        for i, m in enumerate(recorded)
    ]


def steps_of(bag: Path, scenario: Scenario = SCENARIO) -> list[tuple]:
    with BagReader(bag) as reader:
        stream = Steps(reader, "", round(scenario.mission.step_s * 1e9))
        found = [plain(step) for step in stream]
        assert not stream.orphans + stream.repeated + stream.rejected
        assert reader.set_back_ns > 4 * SECOND
    return found


@pytest.mark.parametrize("at", [2, 7, len(FLIGHT) // 3, len(FLIGHT) // 2, len(FLIGHT) - 3])
def test_a_clock_that_is_set_back_makes_no_other_missions_of_ours(tmp_path: Path, at: int) -> None:
    assert steps_of(write(tmp_path / "bag", set_by(FLIGHT, at, -5 * SECOND))) == WHOLE


def test_nor_without_an_index_nor_in_several_parts(tmp_path: Path) -> None:
    recorded = set_by(FLIGHT, 40, -5 * SECOND)
    bag = write(tmp_path / "bare", recorded)
    (part,) = bag.glob("*.mcap")
    bare(part)
    assert steps_of(bag) == WHOLE
    with BagWriter(tmp_path / "split", {}, split_bytes=6000) as writer:
        for name, type in sorted({(m.topic, m.type) for m in recorded}):
            writer.add_topic(name, type)
        for m in recorded:
            writer.write(m.topic, m.data, log_time_ns=m.log_time_ns, publish_time_ns=m.publish_time_ns)
    assert len(list((tmp_path / "split").glob("*.mcap"))) > 2
    assert steps_of(tmp_path / "split") == WHOLE


def test_it_may_be_set_back_twice_and_forward(tmp_path: Path) -> None:
    recorded = set_by(set_by(set_by(FLIGHT, 20, -5 * SECOND), 33, 60 * SECOND), 50, -7 * SECOND)
    assert steps_of(write(tmp_path / "bag", recorded)) == WHOLE


def test_a_second_flight_that_begins_before_the_first_one_by_its_clock(tmp_path: Path) -> None:
    second = flight(SCENARIO, seed=0, begun_ns=LATER_NS - 7200 * SECOND)
    found = steps_of(write(tmp_path / "bag", FLIGHT + second))
    assert found[: len(WHOLE)] == WHOLE
    assert [step[0] for step in found[len(WHOLE) :]] == [
        (1, 0, s) for s in range(SCENARIO.mission.max_steps + 1)
    ]


def test_what_waited_when_the_recorder_was_stopped_lies_topic_by_topic(tmp_path: Path) -> None:
    """As it is written down then; also with a clock that was set back."""
    recorded = set_by(FLIGHT, 30, -5 * SECOND)
    tail = sorted(recorded[60:], key=lambda message: message.topic)
    assert steps_of(write(tmp_path / "bag", recorded[:60] + tail)) == WHOLE


MILLISECONDS = st.integers(-9000, -20) | st.integers(20, 9000)


@given(
    st.integers(0, 2**32),
    st.lists(st.tuples(st.integers(1, 130), MILLISECONDS), max_size=3, unique_by=itemgetter(0)),
)
@settings(max_examples=60, deadline=None)
def test_any_setting_of_the_clock_and_any_delay_in_writing_give_the_same_steps(
    seed: int, settings_of_the_clock: list[tuple[int, int]]
) -> None:
    """Topics are written down late, each in its order; the clock is set by up to nine seconds."""
    rng = random.Random(seed)
    recorded = FLIGHT
    for at, by_ms in settings_of_the_clock:
        recorded = set_by(recorded, at, by_ms * 10**6)
    late: dict[str, float] = {}
    places = []
    for i, message in enumerate(recorded):
        late[message.topic] = max(late.get(message.topic, 0.0), i + rng.randrange(20))
        places.append((late[message.topic], i, message))

    class Recorded(InMemory):
        def received(self, names: object) -> Iterator[tuple[int, BagMessage]]:
            return receive_order.in_order(message for *_, message in sorted(places, key=itemgetter(0, 1)))

    stream = Steps(Recorded(recorded), "", STEP_NS)
    assert [plain(step) for step in stream] == WHOLE
    assert not stream.orphans + stream.repeated + stream.rejected


def test_the_order_of_receipt() -> None:
    """A message that was lost and sent again is no clock; memory is bounded."""
    rng = random.Random(0)
    recorded = [
        BagMessage(f"/{i % 3}", "", b"", BEGUN_NS + i * 10**6 + rng.randrange(10**6), BEGUN_NS + i * 10**6)
        for i in range(3000)
    ]
    late = recorded[:100] + recorded[101:103] + [recorded[100]] + recorded[103:]
    assert list(receive_order.in_order(late)) == [(0, m) for m in recorded]
    resent = [*recorded]
    resent[100] = recorded[100]._replace(log_time_ns=recorded[100].log_time_ns + SECOND)
    assert receive_order.set_back_ns(resent) == 0
    alone = [
        m._replace(log_time_ns=m.log_time_ns - SECOND) if i >= 1500 else m for i, m in enumerate(recorded)
    ]
    for back in (alone, set_by(recorded, 1500, -SECOND)):
        assert list(receive_order.in_order(back)) == [(int(i >= 1500), m) for i, m in enumerate(back)]
        assert receive_order.set_back_ns(back) > SECOND * 0.99


def test_memory_of_what_waits_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receive_order, "WAITING_BYTES", 10 * (storage.MESSAGE_BYTES + 100))
    taken = 0

    def stream():
        nonlocal taken
        for taken in range(1, 1001):
            yield BagMessage("/a", "", bytes(100), taken, taken)

    for n, (_, message) in enumerate(receive_order.in_order(stream()), 1):
        assert message.log_time_ns == n
        assert taken - n <= 10


def test_it_is_reported_and_nothing_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded = set_by(FLIGHT, 40, -5 * SECOND)
    bag = write(tmp_path / "bag", recorded, about(SCENARIO, missions="3"))
    printed = run(capsys, "info", bag)
    assert "bag complete" in printed
    assert "set back by 5.000 s during the recording" in printed
    assert "3: 3" in printed
    printed = run(capsys, "verify", bag)
    assert "3 missions" in printed
    assert "differ" not in printed
    run(capsys, "report", bag, "--out", tmp_path / "page.html")
    assert "3 missions" in run(capsys, "export", bag, "--out", tmp_path / "tables", "--format", "csv")


@pytest.mark.parametrize(
    ("at_s", "by_s"),
    [
        (33.3, -5.0),
        (60.0, -3600.0),
        *(pytest.param(*case, marks=pytest.mark.long) for case in ((1.0, -5.0), (33.3, -40.0))),
    ],
)
def test_beside_an_autopilot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], at_s: float, by_s: float
) -> None:
    """Times of the machine are in all that is published then: of users, of poses, of phases."""
    done = False

    def set_back(the: flights.Flight) -> None:
        nonlocal done
        if not done and the.vehicle.now_s >= at_s:
            the.set_clock(by_s)
            done = True

    recorded = flights.Flight(SCENARIO, beat=set_back).fly()
    expected = flights.Flight(SCENARIO).fly()
    assert done
    bag = write(tmp_path / "bag", recorded, about(SCENARIO, vehicle="mavlink"))
    (same, stream), found = read(expected), steps_of(bag)
    assert [step[0] for step in found] == [plain(step)[0] for step in same]
    assert not stream.orphans
    assert [step[-2:] for step in found] == [plain(step)[-2:] for step in same]
    assert sum(step[1] is not None for step in found) == sum(step.position_m is not None for step in same)
    printed = run(capsys, "verify", bag)
    assert "1 mission," in printed
    assert "all changes are allowed" in printed
    assert "differ" not in printed
    run(capsys, "report", bag, "--out", tmp_path / "page.html")
    run(capsys, "export", bag, "--out", tmp_path / "tables", "--format", "csv")
