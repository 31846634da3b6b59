"""Between received messages and a bag: a ring that faults write, pauses, splits."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from uav_dc_ros import cdr, messages
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.errors import NodeError
from uav_dc_ros.messages import FaultKind, Mission, Phase
from uav_dc_ros.nodes.record import gate as gates
from uav_dc_ros.nodes.record.gate import RecordingGate
from uav_dc_ros.nodes.ros import qos, recorded_qos
from uav_dc_ros.topics import JSON, TOPICS

S = 10**9
LATCHED = [recorded_qos.offered(qos.offered(TOPICS["mission"]), 1)]
VOLATILE = [recorded_qos.offered(qos.offered(TOPICS["move"]), 1)]


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[BagWriter]:
    with BagWriter(tmp_path / "bag", {"version": "1"}) as made:
        for name in ("/map", "/mission"):
            made.add_topic(name, JSON, LATCHED)
        for name in ("/move", "/mark"):
            made.add_topic(name, JSON, VOLATILE)
        yield made


def put(gate: RecordingGate, topic: str, text: str, at_s: float) -> None:
    """Have the gate receive a message, a millisecond after its publication."""
    at_ns = round(at_s * S)
    data = cdr.encode_string(text.encode())
    gate.write(topic, data, log_time_ns=at_ns, publish_time_ns=at_ns - 10**6)


def mission(step: int, **changes: Any) -> str:
    """A payload of `mission`."""
    fields = {"phase": Phase.READY, "cell": (0, 0, 0), "remaining_steps": 9, "seed": 0} | changes
    payload = Mission(mission=0, step=step, scenario="small", fingerprint="0" * 12, **fields)
    return messages.encode(payload).decode()


def texts(bag: Path, *topics: str) -> list[str]:
    """Texts of a bag's messages."""
    with BagReader(bag) as reader:
        return [cdr.decode_string(m.data).decode() for m in reader.messages(topics or None)]


def test_a_fault_writes_the_seconds_before_and_after_it_once(writer: BagWriter) -> None:
    gate = RecordingGate(writer, 5.0)
    put(gate, "/map", "field", 0.5)
    put(gate, "/map", "town", 1.0)
    for i in range(1, 200):  # twenty seconds
        put(gate, "/move", str(i), i / 10)
    assert writer.message_count == 0
    held = {"held": True, "fault": FaultKind.POSITION, "reason": "position 0.6 s old"}
    put(gate, "/mission", mission(3, **held), 20.0)
    assert gate.kept == 0
    put(gate, "/mission", mission(3, **held), 20.1)  # the same fault
    for i in range(200, 400):
        put(gate, "/move", str(i), i / 10)
    put(gate, "/mark", "later", 40.0)
    writer.close()
    moves = [int(text) for text in texts(writer.folder, "/move")]
    assert moves == list(range(150, 250)), "five seconds before the fault, and five after it"
    assert texts(writer.folder, "/map") == ["town"], "the last latched message"
    with BagReader(writer.folder) as reader:
        assert len(reader.parts) == 1
        first = next(iter(reader.messages()))
        assert (first.topic, first.log_time_ns, first.publish_time_ns) == ("/map", 15 * S, S - 10**6)
        assert reader.about["saved_1"].endswith("/mission ready (held): position 0.6 s old")
    assert gate.omitted + writer.message_count == 2 + 399 + 2 + 1 - gate.kept


def test_each_fault_and_the_abort_begin_a_part_that_can_be_read_alone(writer: BagWriter) -> None:
    gate = RecordingGate(writer, 1.0)
    put(gate, "/map", "field", 1.0)
    for at_s, changes in [
        (10.0, {"held": True, "fault": FaultKind.LINK}),
        (12.0, {}),
        (20.0, {"held": True, "fault": FaultKind.LINK}),
        (30.0, {"phase": Phase.ABORTED}),
    ]:
        put(gate, "/mission", mission(int(at_s), **changes), at_s)
    writer.close()
    parts = sorted(writer.folder.glob("*.mcap"))
    assert len(parts) == 3
    for part, step in zip(parts, (10, 20, 30), strict=True):
        with BagReader(part) as reader:
            found = {m.topic: cdr.decode_string(m.data).decode() for m in reader.messages()}
        assert found["/map"] == "field"
        assert json.loads(found["/mission"])["step"] == step


def test_a_snapshot_needs_a_ring(writer: BagWriter) -> None:
    with pytest.raises(
        NodeError, match="no messages are kept in memory; expected a recorder with keep_last_s"
    ):
        RecordingGate(writer).save("snapshot")
    gate = RecordingGate(writer, 60.0)
    put(gate, "/move", "a", 1.0)
    assert gate.save("snapshot") == 1
    assert gate.save("snapshot") == 0


def test_memory_is_bounded(writer: BagWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gates, "KEPT_BYTES_MAX", 10_000)
    gate = RecordingGate(writer, 3600.0)
    for i in range(100):
        put(gate, "/move", "x" * 988, i)  # a thousand bytes and a few
    assert (gate.kept, gate.omitted) == (10, 90)


def test_a_pause_keeps_marks_and_the_last_latched_messages(writer: BagWriter) -> None:
    gate = RecordingGate(writer)
    put(gate, "/move", "before", 1.0)
    gate.pause(2 * S)
    with pytest.raises(NodeError, match="paused already"):
        gate.pause(2 * S)
    for at_s, topic, text in [(3.0, "/move", "lost"), (4.0, "/map", "old"), (5.0, "/map", "new")]:
        put(gate, topic, text, at_s)
    put(gate, "/mark", "gust", 5.5)
    gate.resume(6 * S)
    with pytest.raises(NodeError, match="not paused"):
        gate.resume(6 * S)
    put(gate, "/move", "after", 7.0)
    writer.close()
    assert sorted(texts(writer.folder)) == ["after", "before", "gust", "new"]
    with BagReader(writer.folder) as reader:
        assert reader.about["paused_1"] == f"{2 * S} to {6 * S}"
    assert gate.omitted == 2


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15, deadline=None)
@given(
    events=st.lists(
        st.tuples(
            st.floats(0.0, 2.0), st.sampled_from(["/map", "/move", "save", "pause", "resume", "split"])
        ),
        max_size=60,
    ),
    keep_s=st.sampled_from([0.0, 1.5]),
)
def test_no_message_is_written_twice_and_none_is_lost_uncounted(
    tmp_path_factory: pytest.TempPathFactory, events: list[tuple[float, str]], keep_s: float
) -> None:
    folder, at_s, received = tmp_path_factory.mktemp("random") / "bag", 1.0, 0
    with BagWriter(folder, {}) as writer:
        writer.add_topic("/map", JSON, LATCHED)
        writer.add_topic("/move", JSON, VOLATILE)
        gate = RecordingGate(writer, keep_s)
        for pause_s, what in events:
            at_s += pause_s
            if what.startswith("/"):
                put(gate, what, str(received), at_s)
                received += 1
            elif what == "save" and keep_s:
                gate.save("snapshot")
            elif what == "split":
                writer.split()
            elif what in ("pause", "resume") and gate.is_paused == (what == "resume"):
                getattr(gate, what)(round(at_s * S))
        written = gate.omitted, gate.kept
    found = texts(folder)
    assert len(found) == len(set(found)) == received - sum(written)
