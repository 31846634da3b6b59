"""The transport: addresses, whom it listens to, the stream, links that break."""

import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.autopilot.flight import ROOT, Fake, fake, free_udp_port
from uav_dc_ros.autopilot.dialects import ARDUCOPTER, PX4
from uav_dc_ros.autopilot.frames import Enu, Geodetic
from uav_dc_ros.autopilot.hearing import Hearing
from uav_dc_ros.autopilot.links import Address, LinkDown
from uav_dc_ros.autopilot.mavlink import LIFE_S, Mavlink
from uav_dc_ros.autopilot.vehicle import Arm, Mode, SetMode, TakeOff, Telemetry
from uav_dc_ros.errors import VehicleError

HOME = Geodetic(latitude_deg=47.397742, longitude_deg=8.545594, altitude_m=488.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tcp:127.0.0.1:5760", Address("tcp", "127.0.0.1", 5760)),
        ("udp:0.0.0.0:14540", Address("udpin", "0.0.0.0", 14540)),
        ("tcp:[::1]:5760", Address("tcp", "::1", 5760)),
        ("udpin::14540", None),
        ("udpout:10.0.0.2:14550", Address("udpout", "10.0.0.2", 14550)),
        ("serial:/dev/ttyUSB0:57600", Address("serial", "/dev/ttyUSB0", 57600)),
        ("/dev/ttyUSB0", None),
        ("tcp:127.0.0.1", None),
        ("tcp:127.0.0.1:0", None),
        ("tcp:127.0.0.1:70000", None),
        ("tcp:127.0.0.1:-5", None),
        ("tcp:127.0.0.1:\u0665", None),
        ("http://127.0.0.1:80", None),
        ("", None),
    ],
)
def test_addresses(text: str, expected: Address | None) -> None:
    if expected is not None:
        assert Address.parse(text) == expected
        assert Address.parse(str(expected)) == expected
    else:
        with pytest.raises(VehicleError, match=r"^connect: .*; expected "):
            Address.parse(text)


@pytest.mark.parametrize("text", ["tcp:..:5760", f"tcp:{'a' * 300}:5760", "serial:a\0b:57600"])
def test_a_name_that_nothing_can_have_is_refused_and_not_tried_again(text: str) -> None:
    with Mavlink(text) as vehicle, pytest.raises(VehicleError, match=r"^connect: .*; expected "):
        until(vehicle, lambda known: False)


def test_what_cannot_be_opened_now_is_told_and_tried_again(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with Mavlink(f"udpin:127.0.0.1:{port}") as vehicle:
            taken = f"udpin:127.0.0.1:{port} cannot be opened: Address already in use"
            until(vehicle, lambda known: known.missing == taken)
            other.close()
            until(vehicle, lambda known: known.missing == "no heartbeat from an autopilot")
    device = tmp_path / "ttyUSB0"
    with Mavlink(f"serial:{device}:57600") as vehicle:
        until(vehicle, lambda known: "cannot be opened: " in str(known.missing))
        assert "No such file or directory" in str(vehicle.telemetry().missing)
        master, slave = os.openpty()
        device.symlink_to(os.ttyname(slave))  # somebody plugs it in
        until(vehicle, lambda known: known.missing == "no heartbeat from an autopilot")
    os.close(slave)
    os.close(master)


def test_messages_that_make_no_sense_change_nothing() -> None:
    hearing = Hearing(HOME, Enu(0.0, 0.0, 0.0))
    heartbeat(hearing, 1, 1, 3)
    codec = mav.MAVLink(None, 1, 1)
    for number, message in enumerate(
        [
            codec.gps_global_origin_encode(2_000_000_000, 85455940, 488000),
            codec.gps_global_origin_encode(473977420, 85455940, 488000),
            codec.local_position_ned_encode(1000, math.nan, 2.0, -3.0, 0.0, 0.0, 0.0),
            codec.local_position_ned_encode(2000, 1.0, 2.0, math.inf, 0.0, 0.0, 0.0),
            codec.sys_status_encode(0, 0, 0, 0, 65535, -1, -1, 0, 0, 0, 0, 0, 0),
        ]
    ):
        hearing.hear(mav.MAVLink(None).parse_buffer(message.pack(codec))[0], float(number))
    known = hearing.telemetry(5.0)
    assert (known.position, known.position_s, known.battery, known.battery_v) == (None, None, None, None)
    assert hearing.frame is not None


@pytest.mark.parametrize(
    ("package", "address"),
    [("pymavlink.dialects.v20", "tcp:127.0.0.1:5760"), ("serial", "serial:/dev/ttyUSB0:57600")],
)
def test_a_missing_package_is_told_with_its_extra(package: str, address: str) -> None:
    code = (
        f"import sys; sys.modules['{package}'] = None\n"
        "from uav_dc_ros.autopilot.mavlink import Mavlink\n"
        "from uav_dc_ros.errors import VehicleError\n"
        f"try: Mavlink('{address}')\n"
        "except VehicleError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert f" needs py{package.removeprefix('py').partition('.')[0]}; expected" in done.stdout
    assert "uav_dc_ros[mavlink]" in done.stdout


def test_nothing_here_imports_pymavlink_unless_it_is_used() -> None:
    code = "import sys, uav_dc_ros.autopilot.mavlink; print([m for m in sys.modules if 'pymavlink' in m])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("dialect", [ARDUCOPTER, PX4], ids=lambda dialect: dialect.name)
def test_a_mode_that_is_asked_for_is_the_one_that_is_understood(dialect: Any) -> None:
    for mode, custom_mode in dialect.asked.items():
        assert dialect.mode(custom_mode) is mode
        main, sub = dialect.mode_parameters(mode)
        assert custom_mode in (int(main), int(main) << 16 | int(sub) << 24)
        assert not dialect.mode_name(custom_mode).startswith("0x")
    names = {value: entry.name for value, entry in mav.enums["COPTER_MODE"].items()}
    if dialect is ARDUCOPTER:
        for number, name in dialect.names.items():
            assert names[number] == f"COPTER_MODE_{name}"


def heartbeat(hearing: Hearing, system: int, component: int, autopilot: int, kind: int = 2) -> None:
    codec = mav.MAVLink(None, system, component)
    packed = codec.heartbeat_encode(kind, autopilot, 0, 4, 4).pack(codec)
    hearing.hear(mav.MAVLink(None).parse_buffer(packed)[0], 1.0)


def test_only_an_autopilot_is_listened_to() -> None:
    hearing = Hearing(None, Enu(0.0, 0.0, 0.0))
    heartbeat(hearing, 255, 190, 8, 6)  # a ground station
    heartbeat(hearing, 1, 154, 8, 26)  # a gimbal
    assert hearing.system is None
    heartbeat(hearing, 7, 1, 3, 1)  # an aeroplane
    assert hearing.telemetry(1.0).missing == ("system 7 is a vehicle of type 1; expected a multicopter")
    heartbeat(hearing, 8, 1, 4)
    assert "autopilot of kind 4; expected 3 (ArduCopter) or 12 (PX4)" in str(hearing.telemetry(1.0).missing)
    heartbeat(hearing, 1, 1, 3)
    heartbeat(hearing, 2, 1, 12)  # another aircraft
    assert (hearing.system, hearing.dialect) == (1, ARDUCOPTER)


def test_a_long_text_comes_in_parts() -> None:
    hearing = Hearing(None, Enu(0.0, 0.0, 0.0))
    heartbeat(hearing, 1, 1, 12)
    codec, text = mav.MAVLink(None, 1, 1), "Preflight Fail: " + "x" * 60 + " the end"
    for number in range(2):
        part = text[number * 50 : number * 50 + 50].encode()
        packed = codec.statustext_encode(2, part, 9, number).pack(codec)
        hearing.hear(mav.MAVLink(None).parse_buffer(packed)[0], 1.0)
    hearing.refused("arming", "failed", 1.5)
    assert hearing.telemetry(1.5).refusal == f"arming refused: {text}"
    hearing.granted("arming")
    assert hearing.telemetry(1.5).refusal is None


def until(vehicle: Mavlink, right: Callable[[Telemetry], bool], setpoint: Enu | None = None) -> Telemetry:
    end = time.monotonic() + 15.0
    while not right(known := vehicle.telemetry()):
        assert time.monotonic() < end, known
        vehicle.steer(setpoint)
        time.sleep(0.005)
    return known


def hover(autopilot: Fake, vehicle: Mavlink, up_m: float = 10.0) -> Enu:
    """Take off; where it is sent to."""
    known = until(vehicle, lambda known: known.missing is None and known.estimate_ok)
    assert known.position is not None
    target = Enu(known.position.east_m, known.position.north_m, up_m)
    for wish, right in [
        (SetMode(Mode.COMMANDED), lambda known: known.mode is Mode.COMMANDED),
        (Arm(), lambda known: known.armed),
        (TakeOff(up_m), lambda known: known.on_ground is False),
    ]:
        vehicle.ask(wish)
        until(vehicle, right)
    autopilot.wait_for("taken off")
    return target


def test_where_the_grid_lies_is_what_the_datum_says() -> None:
    with fake("ardupilot", speed=20.0, ready_s=1.0) as autopilot:
        corner = HOME.at(Enu(-300.0, -400.0, -8.0))  # the vehicle stands 300 m east and 400 m north of it
        with Mavlink(autopilot.address, datum=corner) as vehicle:
            known = until(vehicle, lambda known: known.missing is None)
            assert known.position == pytest.approx((300.0, 400.0, 8.0), abs=0.05)
            target = hover(autopilot, vehicle, up_m=30.0)
            until(vehicle, lambda known: known.position is not None and known.position.up_m > 29.5, target)
            assert autopilot.report()["ned"] == pytest.approx((0.0, 0.0, -22.0), abs=0.6), "22 m above home"
            beside = target._replace(east_m=350.0)
            until(vehicle, lambda known: known.position is not None and known.position.east_m > 349.0, beside)
            assert autopilot.report()["ned"][:2] == pytest.approx((0.0, 50.0), abs=1.5)


def test_without_a_datum_the_grid_lies_where_the_vehicle_stands_and_that_is_told() -> None:
    place = Enu(300.0, 400.0, 0.0)
    with (
        fake("px4", speed=20.0, ready_s=1.0) as autopilot,
        Mavlink(autopilot.address, place=place) as vehicle,
    ):
        known = until(vehicle, lambda known: known.missing is None)
        # Not exactly: the plane at the grid's corner is no longer level half a kilometre away (0.02 m).
        assert known.position == pytest.approx(place, abs=0.05)
        assert vehicle.anchor
        assert HOME.seen_from(Geodetic.parse(vehicle.anchor)) == pytest.approx(place, abs=0.05)
        assert vehicle.kind == "PX4"


def test_the_stream_ends_with_those_who_decide() -> None:
    with fake("px4", ready_s=0.5) as autopilot, Mavlink(autopilot.address) as vehicle:  # it may stand still
        known = until(vehicle, lambda known: known.missing is None and known.estimate_ok)
        assert known.position is not None
        before = autopilot.report()["setpoints"]
        until(vehicle, lambda known: autopilot.report()["setpoints"] > before, known.position)
        ends_s = time.monotonic() + LIFE_S + 5.0
        last, still_s = -1, 0.0
        while still_s < 0.5:  # ten setpoints long
            assert time.monotonic() < ends_s, "nobody decides any more"
            if (now := autopilot.report()["setpoints"]) != last:
                last, since_s = now, time.monotonic()
            still_s = time.monotonic() - since_s
            time.sleep(0.01)


def test_it_comes_back_to_a_vehicle_that_flies_and_repeats_no_wish() -> None:
    with fake("ardupilot", speed=20.0, ready_s=1.0) as autopilot, Mavlink(autopilot.address) as vehicle:
        target = hover(autopilot, vehicle)
        autopilot.do("drop 0.3")
        until(vehicle, lambda known: (known.heartbeat_s or 0.0) < time.monotonic() - 0.2, target)
        vehicle.ask(SetMode(Mode.RETURN))  # nobody hears it, and it is not kept for later
        known = until(vehicle, lambda known: (known.heartbeat_s or 0.0) > time.monotonic() - 0.02, target)
        assert known.armed
        far = target._replace(north_m=20.0)
        until(vehicle, lambda known: known.position is not None and known.position.north_m > 19.0, far)
        assert [event["mode"] for event in autopilot.all("mode")] == ["GUIDED"]


def test_a_vehicle_that_starts_anew_is_asked_again() -> None:
    with fake("px4", "udp", speed=20.0, ready_s=1.0) as autopilot, Mavlink(autopilot.address) as vehicle:
        until(vehicle, lambda known: known.missing is None)
        autopilot.do("reboot")
        autopilot.wait_for("control")
        until(vehicle, lambda known: (known.position_s or 0.0) < time.monotonic() - 1.0)
        until(vehicle, lambda known: (known.position_s or 0.0) > time.monotonic() - 0.1)


def test_px4_tells_its_origin_again_to_a_bridge_that_comes_back() -> None:
    with fake("px4", "udp", speed=20.0, ready_s=0.5) as autopilot:
        for _ in range(2):  # its streams go on meanwhile, and the origin does not change
            with Mavlink(autopilot.address) as vehicle:
                until(vehicle, lambda known: known.missing is None and known.estimate_ok)
        assert autopilot.all("armed") == []


def test_what_keeps_a_vehicle_on_the_ground_is_told_in_its_own_words() -> None:
    with fake("ardupilot", speed=20.0, ready_s=30.0) as autopilot, Mavlink(autopilot.address) as vehicle:
        until(vehicle, lambda known: "has not sent" in str(known.missing))
        waiting = "the autopilot is not ready to arm: PreArm: AHRS: waiting for home"
        autopilot.do("lose", 1)  # the position comes, but nobody trusts it
        until(vehicle, lambda known: known.missing == waiting)
        autopilot.do("lose", 0)
        until(vehicle, lambda known: known.missing is None and known.estimate_ok)


def test_px4_is_ready_whatever_it_says_of_the_mode_that_it_is_in() -> None:
    assert PX4.estimate_ok(0x37, 0, armed=False)
    assert not PX4.estimate_ok(0x37 | 0x80, 0, armed=False)
    assert not ARDUCOPTER.estimate_ok(0x33F, 0, armed=False)
    assert ARDUCOPTER.estimate_ok(0x33F, 1 << 28, armed=False)
    assert not ARDUCOPTER.estimate_ok(0x37, 1 << 28, armed=False), "not where it would arm"
    assert ARDUCOPTER.estimate_ok(0x37, 0, armed=True), "what it predicts on the ground is gone in the air"


def test_the_time_of_a_vehicle_that_starts_anew_goes_on_and_its_position_is_forgotten() -> None:
    hearing = Hearing(HOME, Enu(0.0, 0.0, 0.0))
    heartbeat(hearing, 1, 1, 3)
    codec = mav.MAVLink(None, 1, 1)

    def hear(message: Any) -> Telemetry:
        hearing.hear(mav.MAVLink(None).parse_buffer(message.pack(codec))[0], 1.0)
        return hearing.telemetry(1.0)

    hear(codec.gps_global_origin_encode(473977420, 85455940, 488000))
    known = hear(codec.local_position_ned_encode(600_000, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0))
    assert known.position == pytest.approx((2.0, 1.0, 3.0), abs=0.01)
    assert known.vehicle_s == 600.0
    known = hear(codec.system_time_encode(0, 599_900))
    assert (known.vehicle_s, known.position is None) == (600.0, False), "a message that was overtaken"
    known = hear(codec.system_time_encode(0, 2_000))
    assert (known.vehicle_s, known.position, known.position_s) == (602.0, None, None), "or it would be fresh"


def test_a_link_that_cannot_be_opened_says_why() -> None:
    with pytest.raises(LinkDown, match="does not answer: Connection refused"):
        Address("tcp", "127.0.0.1", free_udp_port()).open()
    with pytest.raises(LinkDown, match="does not answer: "):
        Address("tcp", "no-such-host.invalid", 5760).open()
    with Mavlink(f"tcp:127.0.0.1:{free_udp_port()}") as vehicle:
        known = until(vehicle, lambda known: "refused" in str(known.missing))
    assert known.heartbeat_s is None


def test_a_serial_line() -> None:
    pytest.importorskip("serial")
    master, slave = os.openpty()
    link = Address("serial", os.ttyname(slave), 57600).open()
    os.write(master, b"\xfdhello")
    time.sleep(0.05)
    assert link.read() == b"\xfdhello"
    assert link.read() == b""
    link.write(b"\x00\xfd\n")
    assert os.read(master, 10) == b"\x00\xfd\n", "raw: nothing is changed on the way"
    os.close(slave)
    os.close(master)
    with pytest.raises(LinkDown, match="broke"):
        link.read()
    link.close()
