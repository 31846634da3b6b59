"""The transport: addresses, whom it listens to, the stream, links that break."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.conftest import PATIENCE_S
from tests.support.fake_autopilot.flight import ROOT, Fake, fake, free_udp_port
from uav_dc_ros.errors import VehicleError
from uav_dc_ros.offboard.flight_stacks import ARDUCOPTER, PX4
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mavlink.connection import Address, ConnectionLost
from uav_dc_ros.offboard.mavlink.vehicle import MavlinkVehicle
from uav_dc_ros.offboard.setpoint_stream import STREAM_TIMEOUT_S, Heartbeat
from uav_dc_ros.offboard.vehicle import Arm, Limits, Mode, SetMode, TakeOff, Telemetry

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
    with MavlinkVehicle(text) as vehicle, pytest.raises(VehicleError, match=r"^connect: .*; expected "):
        until(vehicle, lambda known: False)


def test_what_cannot_be_opened_now_is_told_and_tried_again(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with MavlinkVehicle(f"udpin:127.0.0.1:{port}") as vehicle:
            taken = f"udpin:127.0.0.1:{port} cannot be opened: Address already in use"
            until(vehicle, lambda known: known.missing == taken)
            other.close()
            until(vehicle, lambda known: known.missing == "no heartbeat from an autopilot")
    device = tmp_path / "ttyUSB0"
    with MavlinkVehicle(f"serial:{device}:57600") as vehicle:
        until(vehicle, lambda known: "cannot be opened: " in str(known.missing))
        assert "No such file or directory" in str(vehicle.telemetry().missing)
        master, slave = os.openpty()
        device.symlink_to(os.ttyname(slave))  # somebody plugs it in
        until(vehicle, lambda known: known.missing == "no heartbeat from an autopilot")
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize(
    ("package", "address"),
    [("pymavlink.dialects.v20", "tcp:127.0.0.1:5760"), ("serial", "serial:/dev/ttyUSB0:57600")],
)
def test_a_missing_package_is_told_with_its_extra(package: str, address: str) -> None:
    code = (
        f"import sys; sys.modules['{package}'] = None\n"
        "from uav_dc_ros.offboard.mavlink.vehicle import MavlinkVehicle\n"
        "from uav_dc_ros.errors import VehicleError\n"
        f"try: MavlinkVehicle('{address}')\n"
        "except VehicleError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert f" needs py{package.removeprefix('py').partition('.')[0]}; expected" in done.stdout
    assert "uav_dc_ros[mavlink]" in done.stdout


def test_nothing_here_imports_pymavlink_unless_it_is_used() -> None:
    code = (
        "import sys, uav_dc_ros.offboard.mavlink.vehicle; print([m for m in sys.modules if 'pymavlink' in m])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("dialect", [ARDUCOPTER, PX4], ids=lambda dialect: dialect.name)
def test_a_mode_that_is_asked_for_is_the_one_that_is_understood(dialect: Any) -> None:
    for mode, custom_mode in dialect.custom_modes.items():
        assert dialect.mode(custom_mode) is mode
        main, sub = dialect.mode_parameters(mode)
        assert custom_mode in (int(main), int(main) << 16 | int(sub) << 24)
        assert not dialect.mode_name(custom_mode).startswith("0x")
    names = {value: entry.name for value, entry in mav.enums["COPTER_MODE"].items()}
    if dialect is ARDUCOPTER:
        for number, name in dialect.mode_names.items():
            assert names[number] == f"COPTER_MODE_{name}"


def until(
    vehicle: MavlinkVehicle, right: Callable[[Telemetry], bool], setpoint: Enu | None = None
) -> Telemetry:
    end = time.monotonic() + PATIENCE_S
    while not right(known := vehicle.telemetry()):
        assert time.monotonic() < end, known
        vehicle.set_setpoint(setpoint)
        time.sleep(0.005)
    return known


def hover(autopilot: Fake, vehicle: MavlinkVehicle, up_m: float = 10.0) -> Enu:
    """Take off; where it is sent to."""
    known = until(vehicle, lambda known: known.missing is None and known.estimate_ok)
    assert known.position is not None
    target = Enu(known.position.east_m, known.position.north_m, up_m)
    for command, right in [
        (SetMode(Mode.COMMANDED), lambda known: known.mode is Mode.COMMANDED),
        (Arm(), lambda known: known.armed),
        (TakeOff(up_m), lambda known: known.on_ground is False),
    ]:
        vehicle.send_command(command)
        until(vehicle, right)
    autopilot.wait_for("taken off")
    return target


def test_where_the_grid_lies_is_what_the_datum_says() -> None:
    with fake("ardupilot", speed=20.0, ready_s=1.0) as autopilot:
        corner = HOME.at(Enu(-300.0, -400.0, -8.0))  # the vehicle stands 300 m east and 400 m north of it
        with MavlinkVehicle(autopilot.address, datum=corner) as vehicle:
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
        MavlinkVehicle(autopilot.address, start=place) as vehicle,
    ):
        known = until(vehicle, lambda known: known.missing is None)
        # Not exactly: the plane at the grid's corner is no longer level half a kilometre away (0.02 m).
        assert known.position == pytest.approx(place, abs=0.05)
        assert known.grid_origin
        assert HOME.enu_from(Geodetic.parse(known.grid_origin)) == pytest.approx(place, abs=0.05)
        assert known.autopilot == "PX4"


def test_the_stream_ends_with_those_who_decide() -> None:
    with (
        fake("px4", ready_s=0.5) as autopilot,
        MavlinkVehicle(autopilot.address) as vehicle,
    ):  # it may stand still
        known = until(vehicle, lambda known: known.missing is None and known.estimate_ok)
        assert known.position is not None
        before = autopilot.report()["setpoints"]
        until(vehicle, lambda known: autopilot.report()["setpoints"] > before, known.position)
        ends_s = time.monotonic() + STREAM_TIMEOUT_S + 60.0
        last, still_s = -1, 0.0
        while still_s < 0.5:  # ten setpoints long
            assert time.monotonic() < ends_s, "nobody decides any more"
            if (now := autopilot.report()["setpoints"]) != last:
                last, since_s = now, time.monotonic()
            still_s = time.monotonic() - since_s
            time.sleep(0.01)


@pytest.mark.parametrize("kind", ["udpin", "udpout"])
def test_the_first_heartbeat_goes_out_as_soon_as_somebody_can_hear_it(kind: str) -> None:
    """The autopilot of a bridge that was killed waits for it: no command is needed before its setpoints."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.settimeout(15.0)
        autopilot.bind(("127.0.0.1", 0))
        port = autopilot.getsockname()[1] if kind == "udpout" else free_udp_port()
        with MavlinkVehicle(f"{kind}:127.0.0.1:{port}") as vehicle:
            if kind == "udpin":
                until(vehicle, lambda known: known.missing == "no heartbeat from an autopilot")
                autopilot.sendto(b"anything", ("127.0.0.1", port))
            (message,) = mav.MAVLink(None).parse_buffer(autopilot.recv(4096))
    assert (message.get_type(), message.get_srcSystem(), message.get_srcComponent()) == (
        "HEARTBEAT",
        255,
        191,
    )


@pytest.mark.parametrize("speed", [0.5, 1.0, 8.0, 30.0])
def test_heartbeats_keep_up_with_the_clock_and_with_the_vehicle(speed: float) -> None:
    heartbeat, sent_s = Heartbeat(), []
    for tick in range(2000):
        now_s = 100.0 + 0.005 * tick
        if heartbeat.is_due(now_s, speed * now_s):
            heartbeat.sent(now_s, speed * now_s)
            sent_s.append(now_s)
    assert sent_s[0] == 100.0
    assert np.diff(sent_s) == pytest.approx(1.0 / max(1.0, speed), abs=0.01)
    heartbeat.begin()
    assert heartbeat.is_due(now_s, speed * now_s), "another link, which has had none"


def test_a_simulated_vehicle_that_is_faster_than_the_clock_misses_no_heartbeat() -> None:
    with (
        fake("ardupilot", speed=20.0, ready_s=1.0) as autopilot,
        MavlinkVehicle(autopilot.address) as vehicle,
    ):
        autopilot.do("param FS_GCS_ENABLE 1")
        target = hover(autopilot, vehicle)
        begun_s = vehicle.telemetry().vehicle_s
        known = until(vehicle, lambda known: known.vehicle_s > begun_s + 40.0, target)
        assert known.mode_name == "GUIDED", known.status_text


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_the_autopilot_s_limits_home_and_target_are_read(kind: str) -> None:
    place = Enu(300.0, 400.0, 0.0)
    fence = "FENCE_RADIUS" if kind == "ardupilot" else "GF_MAX_HOR_DIST"
    with fake(kind, speed=20.0, ready_s=1.0) as autopilot:
        autopilot.do("param FENCE_ENABLE 1")
        autopilot.do(f"param {fence} 250.0")
        with MavlinkVehicle(autopilot.address, start=place) as vehicle:
            known = until(vehicle, lambda known: known.missing is None and known.home is not None)
            assert known.system == f"system 1, {'ArduCopter' if kind == 'ardupilot' else 'PX4'}"
            assert known.limits is not None
            assert known.limits.fence_radius_m == 250.0
            assert known.limits.return_altitude_m == 15.0
            speeds = known.limits.speed_mps, known.limits.climb_mps, known.limits.descent_mps
            assert speeds == pytest.approx((10.2, 2.5, 1.5))
            assert known.home == pytest.approx(place, abs=0.05)
            autopilot.do("fly 0 0 20")
            target = Enu(310.0, 400.0, 20.0)
            known = until(vehicle, lambda known: known.target is not None, target)
            known = until(vehicle, lambda known: known.target == pytest.approx(target, abs=0.1), target)
            autopilot.do("motor 1")
            until(vehicle, lambda known: (known.tilt_rad or 0.0) > 1.0, target)


def test_parameters_that_a_vehicle_does_not_know_hold_nobody_up() -> None:
    with fake("ardupilot", speed=20.0, ready_s=1.0) as autopilot:
        for name in ("FENCE_AUTOENABLE", "RTL_ALT", "WPNAV_SPEED", "WPNAV_SPEED_UP", "WPNAV_SPEED_DN"):
            autopilot.do(f"param {name} none")
        for name, value in (("WP_SPD", 8.5), ("WP_SPD_UP", 2.0), ("WP_SPD_DN", 1.0), ("RTL_ALT_M", 21.0)):
            autopilot.do(f"param {name} {value}")
        autopilot.wait_for("control")
        with MavlinkVehicle(autopilot.address) as vehicle:
            known = until(vehicle, lambda known: known.missing is None)
            expected = Limits(return_altitude_m=21.0, speed_mps=8.5, climb_mps=2.0, descent_mps=1.0)
            assert known.limits == expected


def test_of_two_vehicles_on_a_link_the_one_that_is_named_is_commanded() -> None:
    with fake("ardupilot", "udp", speed=20.0, ready_s=1.0) as autopilot:
        autopilot.do("second_vehicle 7 px4")
        with MavlinkVehicle(autopilot.address) as vehicle:
            known = until(vehicle, lambda known: "2 autopilots on this link" in str(known.missing))
            assert "system 7, PX4" in str(known.missing)
            assert "expected --system N" in str(known.missing)
        with MavlinkVehicle(autopilot.address, system=1) as vehicle:
            hover(autopilot, vehicle)
            assert vehicle.telemetry().system == "system 1, ArduCopter"
        with MavlinkVehicle(autopilot.address, system=7) as vehicle:
            known = until(vehicle, lambda known: known.missing is None)
            assert (known.system, known.armed) == ("system 7, PX4", False)
    assert not [event for event in autopilot.events if event["event"].startswith("second ")]


def test_on_a_port_that_several_vehicles_send_to_the_right_one_is_answered() -> None:
    port = free_udp_port()
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        codecs = {system: mav.MAVLink(None, system, 1) for system in (7, 1)}
        vehicle = stack.enter_context(MavlinkVehicle(f"udpin:127.0.0.1:{port}", system=1))
        until(vehicle, lambda known: known.missing == "no heartbeat from an autopilot of system 1")
        heard: list[Any] = []
        ends_s = time.monotonic() + PATIENCE_S
        while sum(message.get_type() == "COMMAND_LONG" for message in heard) < 20:
            assert time.monotonic() < ends_s
            for one, codec in zip(sockets, codecs.values(), strict=True):
                one.settimeout(0.05)
                packed = codec.heartbeat_encode(2, 3, 0, 4, 4).pack(codec)
                codec.seq = (codec.seq + 1) % 256
                one.sendto(packed, ("127.0.0.1", port))
                with contextlib.suppress(TimeoutError):
                    while True:
                        message = mav.MAVLink(None).parse_buffer(one.recv(4096))[0]
                        heard += [message] if one is sockets[1] else []
                        assert message.get_type() != "COMMAND_LONG" or one is sockets[1]


def test_a_second_bridge_is_noticed_and_a_router_s_echo_is_none() -> None:
    with (
        fake("ardupilot", speed=20.0, ready_s=1.0) as autopilot,
        MavlinkVehicle(autopilot.address) as vehicle,
    ):
        autopilot.do("echo 1")
        target = hover(autopilot, vehicle)
        begun_s = vehicle.telemetry().vehicle_s
        known = until(vehicle, lambda known: known.vehicle_s > begun_s + 20.0, target)
        assert known.other_controller is None
        autopilot.do("second_bridge_heartbeats 1")
        known = until(vehicle, lambda known: known.other_controller is not None, target)
        assert str(known.other_controller).startswith("heartbeats of system 255, component 191")
        autopilot.do("second_bridge_heartbeats 0")
        until(vehicle, lambda known: known.other_controller is None, target)
        autopilot.do("second_bridge_target 40 40 -20")
        known = until(vehicle, lambda known: known.other_controller is not None, target)
        assert str(known.other_controller).startswith("position targets")


def test_a_take_off_command_that_was_lost_twice_is_followed_when_it_comes() -> None:
    with (
        fake("ardupilot", speed=20.0, ready_s=1.0) as autopilot,
        MavlinkVehicle(autopilot.address) as vehicle,
    ):
        autopilot.do(f"ignore {mav.MAV_CMD_NAV_TAKEOFF} 2")
        until(vehicle, lambda known: known.missing is None and known.estimate_ok)
        for command, right in [
            (SetMode(Mode.COMMANDED), lambda known: known.mode is Mode.COMMANDED),
            (Arm(), lambda known: known.armed),
        ]:
            vehicle.send_command(command)
            until(vehicle, right)
        for _ in range(2):
            vehicle.send_command(TakeOff(10.0))
            autopilot.wait_for("lost")
        vehicle.send_command(TakeOff(10.0))
        autopilot.wait_for("taken off")


def test_a_flying_vehicle_without_a_datum_says_what_to_give() -> None:
    with fake("px4", speed=20.0, ready_s=1.0) as autopilot:
        autopilot.do("fly 10 10 20")
        with MavlinkVehicle(autopilot.address) as vehicle:
            until(vehicle, lambda known: "expected a datum" in str(known.missing))
        with MavlinkVehicle(autopilot.address, datum=HOME) as vehicle:
            known = until(vehicle, lambda known: known.missing is None)
            assert known.position is not None


def test_it_comes_back_to_a_vehicle_that_flies_and_repeats_no_wish() -> None:
    with (
        fake("ardupilot", speed=20.0, ready_s=1.0) as autopilot,
        MavlinkVehicle(autopilot.address) as vehicle,
    ):
        target = hover(autopilot, vehicle)
        autopilot.do("drop 0.3")
        until(vehicle, lambda known: (known.heartbeat_s or 0.0) < time.monotonic() - 0.2, target)
        vehicle.send_command(SetMode(Mode.RETURN))  # nobody hears it, and it is not kept for later
        known = until(vehicle, lambda known: (known.heartbeat_s or 0.0) > time.monotonic() - 0.02, target)
        assert known.armed
        far = target._replace(north_m=20.0)
        until(vehicle, lambda known: known.position is not None and known.position.north_m > 19.0, far)
        assert [event["mode"] for event in autopilot.all("mode")] == ["GUIDED"]


def test_a_vehicle_that_starts_anew_is_asked_again() -> None:
    with (
        fake("px4", "udp", speed=20.0, ready_s=1.0) as autopilot,
        MavlinkVehicle(autopilot.address) as vehicle,
    ):
        until(vehicle, lambda known: known.missing is None)
        autopilot.do("reboot")
        autopilot.wait_for("control")
        until(vehicle, lambda known: (known.position_s or 0.0) < time.monotonic() - 1.0)
        until(vehicle, lambda known: (known.position_s or 0.0) > time.monotonic() - 0.5)


def test_px4_tells_its_origin_again_to_a_bridge_that_comes_back() -> None:
    with fake("px4", "udp", speed=20.0, ready_s=0.5) as autopilot:
        for _ in range(2):  # its streams go on meanwhile, and the origin does not change
            with MavlinkVehicle(autopilot.address) as vehicle:
                until(vehicle, lambda known: known.missing is None and known.estimate_ok)
        assert autopilot.all("armed") == []


def test_what_keeps_a_vehicle_on_the_ground_is_told_in_its_own_words() -> None:
    with (
        fake("ardupilot", speed=20.0, ready_s=30.0) as autopilot,
        MavlinkVehicle(autopilot.address) as vehicle,
    ):
        until(vehicle, lambda known: "has not sent" in str(known.missing))
        waiting = "the autopilot is not ready to arm: PreArm: AHRS: waiting for home"
        autopilot.do("lose", 1)  # the position comes, but nobody trusts it
        until(vehicle, lambda known: known.missing == waiting)
        autopilot.do("lose", 0)
        until(vehicle, lambda known: known.missing is None and known.estimate_ok)


def test_a_link_that_cannot_be_opened_says_why() -> None:
    with pytest.raises(ConnectionLost, match="does not answer: Connection refused"):
        Address("tcp", "127.0.0.1", free_udp_port()).open()
    with pytest.raises(ConnectionLost, match="does not answer: "):
        Address("tcp", "no-such-host.invalid", 5760).open()
    with MavlinkVehicle(f"tcp:127.0.0.1:{free_udp_port()}") as vehicle:
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
    with pytest.raises(ConnectionLost, match="broke"):
        link.read()
    link.close()
