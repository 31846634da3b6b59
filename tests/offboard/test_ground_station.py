"""What a ground station sees: texts, values, the fence; and what a vehicle of a pilot never receives."""

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.conftest import until
from tests.support.fake_autopilot.fences import FenceStore
from tests.support.fake_autopilot.flight import KINDS, fake, free_udp_port
from tests.support.fake_autopilot.flight import Flight as ProcessFlight
from tests.support.fake_autopilot.virtual import VirtualFlight, short
from uav_dc_ros.messages import FaultKind, Mission, Phase
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.ground_station import MissionTexts, Severity, StatusText
from uav_dc_ros.offboard.mavlink.fence_upload import FenceUpload
from uav_dc_ros.offboard.mavlink.status_text import MESSAGES_MAX, TEXT_BYTES, StatusTextQueue
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import UPLOAD_MARGIN_M, Geofence

VERTEX = mav.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
TEXTS = st.builds(StatusText, st.sampled_from(Severity), st.text(min_size=1, max_size=250))


def status(bridge: MissionController) -> Mission:
    """What the node publishes, as far as a ground station shows it."""
    return Mission(
        mission=0,
        step=bridge.step,
        phase=bridge.phase,
        reason=bridge.reason[:200],
        held=bridge.fault_kind is not None,
        fault=bridge.fault_kind,
        cell=bridge.cell,
        remaining_steps=0,
        seed=0,
        scenario="small",
        fingerprint="0" * 12,
    )


class Shown(VirtualFlight):
    """A flight whose bridge reports to ground stations; `sent`: its messages, with their vehicle time."""

    def __init__(self, kind: str, **options: Any) -> None:
        self.sent: list[tuple[float, Any]] = []
        self._texts, self._parser = MissionTexts(), mav.MAVLink(None)
        super().__init__(kind, **options)

    def _note(self) -> None:
        super()._note()
        text = self._texts.update(status(self.bridge), self.bridge.checkpoint.outcome)
        if text is not None:
            self.session.report_text(text)

    def _write(self, data: bytes) -> bool:
        self.sent += ((self.copter.t_s, message) for message in self._parser.parse_buffer(data) or ())
        return super()._write(data)

    def of(self, *names: str, since_s: float = 0.0) -> list[Any]:
        """The messages of these names."""
        return [m for at_s, m in self.sent if at_s >= since_s and m.get_type() in names]

    def texts(self) -> list[tuple[int, str]]:
        """Severity and whole text of each, without the number of omitted ones."""
        return [(s, re.sub(r"^\(\+\d+\) ", "", text)) for s, text in joined(self.of("STATUSTEXT"))]


def joined(messages: list[Any]) -> Iterator[tuple[int, str]]:
    """Severity and text of chunked STATUSTEXT messages, as a receiver puts them together."""
    parts: dict[int, str] = {}
    for message in messages:
        text = message.text
        if message.id == 0:
            yield message.severity, text
            continue
        assert message.chunk_seq == 0 or message.id in parts
        parts[message.id] = parts.get(message.id, "") + text
        if len(text) < 50:
            yield message.severity, parts.pop(message.id)
    assert parts == {}, "a last chunk is missing"


@settings(max_examples=40)
@given(st.lists(st.tuples(st.floats(0.0, 0.4), TEXTS), max_size=40))
def test_the_rate_of_texts_is_limited_and_the_last_of_the_most_severe_is_sent(
    texts: list[tuple[float, StatusText]],
) -> None:
    queue, now_s, sent = StatusTextQueue(), 0.0, []
    for pause_s, text in [*texts, *[(0.3, None)] * 8]:
        now_s += pause_s
        if text is not None:
            queue.add(text)
        sent += [(now_s, chunk) for chunk in queue.due(now_s)]
    for at_s, _ in sent:
        assert sum(at_s <= other_s < at_s + 1.0 for other_s, _ in sent) <= MESSAGES_MAX
    packed = mav.MAVLink(None)
    received = packed.parse_buffer(b"".join(packed.statustext_encode(*c).pack(packed) for _, c in sent)) or []
    shown = list(joined(received))
    if texts:
        worst = min(text.severity for _, text in texts)
        last = [text for _, text in texts if text.severity == worst][-1]
        expected = last.text.encode("ascii", "replace").decode().partition("\0")[0]
        ends = [text.partition(") ")[2] if text.startswith("(+") else text for s, text in shown if s == worst]
        assert any(expected[: TEXT_BYTES - 8].startswith(end[: TEXT_BYTES - 8]) for end in ends)


@pytest.mark.parametrize("reason", ["", " because of the wind, that is stronger than this vehicle flies" * 3])
def test_a_hundred_faults_in_a_second_give_at_most_ten_messages(reason: str) -> None:
    flight = Shown("ardupilot")
    flight.until(lambda: flight.bridge.phase is Phase.MOVING)
    flight.run(3.0)
    begun_s, texts = flight.copter.t_s, MissionTexts()
    while (n := round((flight.copter.t_s - begun_s) * 100)) < 100:
        fault = messages_fault(flight.bridge, f"fault {n}{reason}")
        text = texts.update(fault, None)
        assert text is not None
        assert text.severity is Severity.WARNING
        flight.session.report_text(text)
        flight.tick()
    flight.run(20.0)
    faults = [m for m in flight.of("STATUSTEXT", since_s=begun_s) if m.severity == Severity.WARNING]
    assert 2 <= len(faults) <= 10
    assert [text for _, text in joined(faults)][-1].startswith("(+"), "how many were left out is shown"


def messages_fault(bridge: MissionController, reason: str) -> Mission:
    """A status with a fault."""
    held = {"phase": Phase.MOVING, "held": True, "fault": FaultKind.POSITION, "reason": reason[:199]}
    base = status(bridge)
    return Mission(**{name: getattr(base, name) for name in base.__struct_fields__} | held)


@pytest.mark.parametrize("kind", KINDS)
def test_each_phase_is_shown_once_with_its_severity(kind: str) -> None:
    flight = Shown(kind, scenario=short(4))
    flight.session.report_values({"collected": 7.0, "rate_mbps": 1.5})
    flight.until_over()
    assert flight.bridge.phase is Phase.LANDED
    flight.run(2.0)
    shown = [(severity, text.split()[1].rstrip(":")) for severity, text in flight.texts()]
    phases = [phase for i, (_, phase) in enumerate(shown) if i == 0 or phase != shown[i - 1][1]]
    assert phases[-6:] == ["preflight", "takeoff", "ready", "moving", "landing", "landed"]
    assert {Severity(severity) for severity, phase in shown if phase in ("takeoff", "landing", "landed")} == {
        Severity.NOTICE
    }
    for message in flight.of("STATUSTEXT", "NAMED_VALUE_FLOAT"):
        assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191), "of the vehicle's system"
    values = flight.of("NAMED_VALUE_FLOAT")
    assert {(message.name, message.value) for message in values} == {("collected", 7.0), ("rate_mbps", 1.5)}
    assert len(values) <= 2 * (flight.now_s - 1000.0 + 1.0), "once a second"


@pytest.mark.parametrize("kind", KINDS)
def test_a_vehicle_that_a_pilot_flies_receives_texts_only(kind: str) -> None:
    flight = Shown(kind, upload_fence=True)
    flight.session.report_values({"collected": 7.0})
    flight.until(lambda: flight.bridge.phase is Phase.MOVING)
    flight.do("mode LOITER" if kind == "ardupilot" else "mode POSCTL")
    flight.until(lambda: flight.bridge.is_over)
    taken_s = flight.copter.t_s
    flight.run(10.0)
    severity, text = flight.texts()[-1]
    assert severity == Severity.CRITICAL
    assert text.startswith("uav_dc aborted: mode ")
    sent = {message.get_type() for at_s, message in flight.sent if at_s > taken_s + 0.1}
    # As before: the heartbeat that failsafes watch, and requests of telemetry.
    assert sent <= {"STATUSTEXT", "HEARTBEAT", "COMMAND_LONG"}
    commands = {m.command for m in flight.of("COMMAND_LONG", since_s=taken_s + 0.1)}
    assert commands <= {mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAV_CMD_REQUEST_MESSAGE}


def test_a_fault_that_ends_the_mission_is_critical() -> None:
    flight = Shown("ardupilot")
    flight.until(lambda: flight.bridge.phase is Phase.MOVING)
    flight.do("freeze 1")
    flight.until(lambda: flight.bridge.phase is Phase.LANDING)
    flight.do("freeze 0")
    flight.until_over()
    flight.run(2.0)
    shown = [(Severity(severity), text) for severity, text in flight.texts()]
    held = [severity for severity, text in shown if text.startswith("uav_dc moving (held): ")]
    assert held == [Severity.WARNING]
    landing = [severity for severity, text in shown if text.startswith("uav_dc landing: ")]
    assert landing
    assert set(landing) == {Severity.CRITICAL}
    assert shown[-1][0] is Severity.CRITICAL
    assert shown[-1][1].startswith("uav_dc aborted: ")


# The fence.


@pytest.mark.parametrize("kind", KINDS)
def test_the_fence_is_uploaded_before_the_take_off_and_once(kind: str) -> None:
    flight = Shown(kind, scenario=short(2), upload_fence=True)
    flight.until(lambda: flight.bridge.phase is Phase.TAKEOFF)
    store, datum = flight.autopilot.fence, flight.telemetry.datum
    assert datum is not None
    assert [(command, n) for command, _, _, n in store.points] == [(VERTEX, 4)] * 4
    corners = [
        Geodetic(x / 1e7, y / 1e7, datum.altitude_m).enu_from(datum)[:2] for _, x, y, _ in store.points
    ]
    fence = flight.bridge.fence
    for (east_m, north_m), outline in zip(corners, fence.outline(UPLOAD_MARGIN_M), strict=True):
        assert (east_m, north_m) == pytest.approx(outline[:2], abs=0.05)
    west_m, east_m = min(corners)[0], max(corners)[0]
    assert (west_m, east_m) == pytest.approx((fence.lower[0] - 10.0, fence.upper[0] + 10.0), abs=0.1)
    assert "fence" in [event["event"] for event in flight.events]
    armed_s = flight.all("armed")[0]["t_s"]
    assert all(m[0] < armed_s for m in flight.sent if m[1].get_type().startswith("MISSION_"))
    again = Shown(kind, scenario=short(2), upload_fence=True)
    again.autopilot.fence.points = store.points
    again.until(lambda: again.bridge.phase is Phase.TAKEOFF)
    assert again.autopilot.fence.uploads == 0, "it has this fence already"


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("fence other", "the autopilot has another one, of 1 points; expected none, or the same"),
        (f"fence refuse {mav.MAV_MISSION_NO_SPACE}", "the autopilot refused it: no space"),
        ("fence refuse 77", "the autopilot refused it: 77"),
        ("fence silent 1", "the autopilot gave no answer: reading the autopilot's fence"),
    ],
)
def test_a_mission_whose_fence_is_refused_is_aborted_on_the_ground(line: str, reason: str) -> None:
    flight = Shown("px4", upload_fence=True)
    flight.do(line)
    before = list(flight.autopilot.fence.points)
    assert reason in flight.until_over()
    assert flight.autopilot.fence.points == before
    assert flight.all("armed") == []
    flight.run(1.0)
    assert flight.texts()[-1][0] == Severity.CRITICAL


def test_a_vehicle_that_is_armed_receives_no_fence() -> None:
    flight = Shown("ardupilot", how=SafetySettings(), upload_fence=True)
    flight.do("fence silent 1")
    flight.until(lambda: flight.telemetry.datum is not None)
    flight.do("fence silent 0")
    flight.do("mode LOITER")
    flight.do("arm")
    flight.run(2.0)
    armed_s = flight.copter.t_s
    flight.run(5.0)
    assert [m for m in flight.sent if m[0] > armed_s and m[1].get_type().startswith("MISSION_")] == []
    assert "once the vehicle is disarmed" in flight.bridge.reason
    flight.do("fly 0 0 20")
    reason = flight.until_over()
    assert "the fence was not uploaded before take-off" in reason
    assert flight.copter.armed
    assert flight.of("SET_POSITION_TARGET_LOCAL_NED", since_s=armed_s) == [], "the vehicle is left alone"


@settings(max_examples=40)
@given(st.lists(st.booleans(), max_size=40))
def test_lost_messages_leave_the_whole_fence_or_a_refusal(lost: list[bool]) -> None:
    datum, drops = Geodetic(47.0, 8.0, 400.0), iter(lost)
    upload = FenceUpload([Enu(0, 0, 0), Enu(50, 0, 0), Enu(50, 40, 0), Enu(0, 40, 0)])
    store = FenceStore(lambda *_, **__: None)
    ours, theirs = mav.MAVLink(None, 255, 191), Replies(1, 1)
    now_s = 0.0
    while not upload.is_over:
        now_s += 0.1
        assert now_s < 200.0
        if round(now_s * 10) % 10 == 0:
            store.repeat(theirs)
        for reply in theirs.take():
            if not next(drops, False):
                upload.on_message(reply, mav)
        message = upload.due(ours, 1, datum, now_s)
        if message is None or next(drops, False):
            continue
        (received,) = mav.MAVLink(None).parse_buffer(message.pack(ours))
        store.receive(received, theirs)
    assert len(store.points) in (0, 4)
    assert (upload.refusal is None) <= (len(store.points) == 4)
    if sum(lost) < 5:
        assert upload.refusal is None


class Replies(mav.MAVLink):
    """An autopilot's encoder, whose messages are taken."""

    def __init__(self, system: int, component: int) -> None:
        super().__init__(self, system, component)
        self.data = bytearray()

    def write(self, data: bytes) -> None:
        self.data += data

    def take(self) -> list[Any]:
        data, self.data = bytes(self.data), bytearray()
        return mav.MAVLink(None).parse_buffer(data) or []


# A second system on the link.


@pytest.mark.parametrize("kind", ["ardupilot", pytest.param("px4", marks=pytest.mark.long)])
def test_a_ground_station_on_another_link_of_the_autopilot_shows_them(kind: str) -> None:
    port = free_udp_port()
    station = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{port}", source_system=250, dialect="ardupilotmega"
    )
    with fake(kind, speed=20.0, ready_s=1.0, station=port) as autopilot:
        flight = ProcessFlight(autopilot, SafetySettings(arm=True), short(2))
        flight.vehicle.report_values({"collected": 3.0, "rate_mbps": 0.25})
        texts = MissionTexts()
        shown, values = [], {}

        def look() -> None:
            text = texts.update(status(flight.bridge), flight.bridge.checkpoint.outcome)
            if text is not None:
                flight.vehicle.report_text(text)
            while (message := station.recv_msg()) is not None:
                if message.get_type() == "STATUSTEXT" and message.get_srcComponent() == 191:
                    shown.append(message)
                elif message.get_type() == "NAMED_VALUE_FLOAT":
                    values[message.name] = message.value

        with flight.vehicle:
            flight.until(lambda: flight.bridge.is_over, beat=look)
            flight.until(lambda: "landed" in "".join(text for _, text in joined_so_far(shown)), beat=look)
        assert flight.bridge.phase is Phase.LANDED
    station.close()
    assert values == {"collected": 3.0, "rate_mbps": 0.25}
    assert {message.severity for message in shown if "landed" in message.text} == {Severity.NOTICE}


def joined_so_far(messages: list[Any]) -> list[tuple[int, str]]:
    """As `joined`, where the last chunk may not have come yet."""
    whole = [m for m in messages if m.id == 0]
    return [(m.severity, m.text) for m in whole] + [(m.severity, m.text) for m in messages if m.id]


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_mavproxy_prints_the_texts_and_lists_the_fence(kind: str, tmp_path: Path) -> None:
    program = Path(sys.executable).with_name("mavproxy.py")
    if not program.exists():
        pytest.skip("MAVProxy is not installed: pip install mavproxy")
    port = free_udp_port()
    command = [
        sys.executable,
        program,
        "--master",
        f"udpin:127.0.0.1:{port}",
        "--source-system",
        "250",
        "--target-system",
        "1",
    ]
    command += ["--state-basedir", tmp_path, "--default-modules", "fence,link"]
    with fake(kind, speed=4.0, ready_s=1.0, station=port) as autopilot:
        station = subprocess.Popen(
            list(map(str, command)),
            cwd=tmp_path,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "HOME": str(tmp_path)},
        )
        lines: list[str] = []
        assert station.stdout is not None
        assert station.stdin is not None
        threading.Thread(target=lambda: lines.extend(station.stdout or ()), daemon=True).start()
        fence = Geofence.around(short(2)).outline(UPLOAD_MARGIN_M)
        flight = ProcessFlight(autopilot, SafetySettings(arm=True), short(2), fence=fence)
        texts = MissionTexts()

        def look() -> None:
            text = texts.update(status(flight.bridge), flight.bridge.checkpoint.outcome)
            if text is not None:
                flight.vehicle.report_text(text)

        with flight.vehicle:
            until(lambda: "Detected vehicle 1:1" in "".join(lines))
            flight.until(lambda: flight.bridge.phase is Phase.TAKEOFF, beat=look)
            station.stdin.write("fence list\n")
            station.stdin.flush()
            flight.until(lambda: flight.bridge.is_over, beat=look)
            flight.until(lambda: "uav_dc landed" in "".join(lines), beat=look)
        assert flight.bridge.phase is Phase.LANDED
        station.stdin.close()
        station.terminate()
        station.wait(30.0)
    printed = "".join(lines)
    for phase in ("takeoff", "moving", "landing"):
        assert f" uav_dc {phase}: " in printed, printed  # after a number of omitted ones, too
    assert printed.count(f"{VERTEX} 0 ") == 4, printed
