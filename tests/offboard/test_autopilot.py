"""The fake autopilot behaves as the real ones were seen to; asked by a client that is not this project's."""

import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.conftest import PATIENCE_S
from tests.support.fake_autopilot.flight import Fake, fake

SPEED = 40.0
POSITION, VELOCITY = 0xDF8, 0xDC7


class Client:
    """pymavlink's own connection, and what is asked on it."""

    def __init__(self, autopilot: Fake) -> None:
        self.fake = autopilot
        mavutil.set_dialect("ardupilotmega")
        self.link = mavutil.mavlink_connection(autopilot.address, dialect="ardupilotmega", retries=1)
        self.t_s = 0.0

    def until(
        self, name: str, right: Callable[[Any], bool] = lambda m: True, seconds: float = PATIENCE_S
    ) -> Any:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = self.link.recv_match(blocking=True, timeout=0.5)
            if message is None:
                continue
            self.t_s = getattr(message, "time_boot_ms", self.t_s * 1e3) / 1e3
            if message.get_type() == name and right(message):
                return message
        raise AssertionError(f"no such {name}")

    def ask_rate(self, number: int, rate_hz: float = 50.0) -> None:
        self.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz)

    def command(self, number: int, *parameters: float) -> int:
        filled = [*parameters, *[0] * (7 - len(parameters))]
        self.link.mav.command_long_send(1, 1, number, 0, *filled)
        return int(self.until("COMMAND_ACK", lambda ack: ack.command == number).result)

    def mode(self, main: int, sub: int = 0) -> int:
        return self.command(mav.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def arm(self) -> int:
        return self.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def send(
        self, north_m: float, east_m: float, down_m: float, frame: int = 1, mask: int = POSITION
    ) -> None:
        self.link.mav.set_position_target_local_ned_send(
            0, 1, 1, frame, mask, north_m, east_m, down_m, north_m, east_m, down_m, 0, 0, 0, 0, 0
        )

    def wait_s(self, seconds: float) -> None:
        """Simulated seconds; the position must have been asked for."""
        end_s = self.fake.report()["t_s"] + seconds
        self.until("LOCAL_POSITION_NED", lambda m: m.time_boot_ms / 1e3 >= end_s, 30.0)

    def place(self) -> tuple[float, float, float]:
        now_s = self.fake.report()["t_s"]
        message = self.until("LOCAL_POSITION_NED", lambda m: m.time_boot_ms / 1e3 >= now_s)
        return message.x, message.y, message.z

    def take_off(self, up_m: float) -> None:
        self.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
        self.until("LOCAL_POSITION_NED")
        assert (self.mode(4), self.arm()) == (0, 0)
        assert self.command(mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, up_m) == 0
        self.fake.wait_for("taken off")


@pytest.fixture
def copter() -> Iterator[Client]:
    with fake("ardupilot", speed=SPEED, ready_s=5.0) as autopilot:
        client = Client(autopilot)
        yield client
        client.link.close()


@pytest.fixture
def px4() -> Iterator[Client]:
    with fake("px4", "tcp", speed=SPEED, ready_s=1.0) as autopilot:
        client = Client(autopilot)
        yield client
        client.link.close()


def test_time_starts_with_the_first_client_and_messages_come_as_asked() -> None:
    with fake("ardupilot", speed=SPEED) as autopilot:
        time.sleep(0.3)
        assert autopilot.report()["t_s"] == 0.0
        client = Client(autopilot)
        client.until("HEARTBEAT", lambda m: m.autopilot == mav.MAV_AUTOPILOT_ARDUPILOTMEGA)
        names = {client.link.recv_match(blocking=True, timeout=1.0).get_type() for _ in range(10)}
        assert names == {"HEARTBEAT"}
        client.ask_rate(mav.MAVLINK_MSG_ID_SYSTEM_TIME, 10.0)
        first = client.until("SYSTEM_TIME").time_boot_ms
        times = [client.until("SYSTEM_TIME").time_boot_ms - first for _ in range(10)]
        assert times == pytest.approx([100 * (n + 1) for n in range(10)], abs=21)
        client.link.close()


def test_guided_comes_before_the_estimate_and_arming_only_after(copter: Client) -> None:
    assert copter.mode(4) == mav.MAV_RESULT_ACCEPTED
    assert copter.arm() == mav.MAV_RESULT_FAILED == 4
    assert copter.until("STATUSTEXT").text == "Arm: waiting for home"
    copter.ask_rate(mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    copter.ask_rate(mav.MAVLINK_MSG_ID_SYS_STATUS)
    copter.until("EKF_STATUS_REPORT", lambda m: m.flags == 0x33F)
    copter.until("SYS_STATUS", lambda m: m.onboard_control_sensors_health & 1 << 28)
    assert copter.arm() == mav.MAV_RESULT_ACCEPTED
    assert copter.fake.wait_for("disarmed")["why"] == "on the ground", "nobody took off"


def test_speeds_of_the_copter(copter: Client) -> None:
    copter.take_off(50.0)
    commands = copter.fake.all("command")
    (commanded,) = [event for event in commands if event["command"] == mav.MAV_CMD_NAV_TAKEOFF]
    up_s = copter.fake.all("taken off")[0]["t_s"] - commanded["t_s"]
    assert up_s == pytest.approx(2 + 50 / 2.5, abs=1.0)
    copter.send(100.0, 0.0, -50.0)
    begun_s, peak_mps = copter.t_s, 0.0
    while True:
        message = copter.until("LOCAL_POSITION_NED")
        peak_mps = max(peak_mps, message.vx)
        if message.x == 0.0:
            begun_s = copter.t_s
        if message.x > 98.0:
            break
    assert copter.t_s - begun_s == pytest.approx(13.9, abs=0.7)
    assert peak_mps == pytest.approx(10.2, abs=0.3)
    copter.wait_s(15.0)  # one setpoint is enough, for ever
    assert copter.place() == pytest.approx((100.0, 0.0, -50.0), abs=0.05)
    assert copter.mode(9) == 0
    landed = copter.fake.wait_for("touched down")["t_s"] - copter.fake.all("mode")[-1]["t_s"]
    assert landed == pytest.approx(40 / 1.5 + 10 / 0.5, abs=2.0)
    copter.fake.wait_for("disarmed")


def test_a_velocity_ends_after_three_seconds(copter: Client) -> None:
    copter.take_off(20.0)
    copter.send(5.0, 0.0, 0.0, mask=VELOCITY)
    copter.fake.wait_for("velocity timed out")
    copter.wait_s(15.0)
    before = copter.place()
    copter.wait_s(5.0)
    assert copter.place() == pytest.approx(before, abs=0.05)
    assert 5.0 < before[0] < 25.0


def test_a_setpoint_interrupts_a_take_off_by_command(copter: Client) -> None:
    copter.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    copter.until("LOCAL_POSITION_NED")
    copter.mode(4)
    copter.arm()
    copter.command(mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 50.0)
    copter.until("LOCAL_POSITION_NED", lambda m: m.z < -10.0)
    copter.send(0.0, 0.0, -12.0)
    copter.fake.wait_for("take-off interrupted")


def stream(client: Client, down_m: float, seconds: float, frame: int = 1) -> None:
    """Setpoints, simulated seconds; one for each position that comes."""
    end_s = client.t_s + seconds
    while client.t_s < end_s:
        client.until("LOCAL_POSITION_NED")
        client.send(0.0, 0.0, down_m, frame)


def test_px4_follows_setpoints_only_after_a_stream_of_them_and_returns_when_it_ends(px4: Client) -> None:
    px4.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 10.0)
    px4.until("LOCAL_POSITION_NED")
    assert px4.mode(6) == mav.MAV_RESULT_TEMPORARILY_REJECTED
    assert "no setpoints" in px4.until("STATUSTEXT").text
    stream(px4, 0.0, 0.5)
    assert px4.mode(6) != 0, "half a second is not enough"
    px4.fake.do("param COM_OF_LOSS_T 100.0")  # on a busy machine the stream of this client has gaps
    stream(px4, 0.0, 3.0)
    while px4.mode(6) != 0:
        stream(px4, 0.0, 3.0)
    assert px4.arm() == 0
    stream(px4, -10.0, 8.0)
    assert px4.place()[2] == pytest.approx(-10.0, abs=0.5), "climbs by setpoint"
    px4.fake.do("param COM_OF_LOSS_T 1.0")
    stream(px4, -10.0, 0.2)
    last_s = px4.t_s
    event = px4.fake.wait_for("mode")
    while event["mode"] != "AUTO.RTL":
        event = px4.fake.wait_for("mode")
    assert 0.5 <= event["t_s"] - last_s <= 2.0
    assert "failsafe" in event["why"]


def test_px4_takes_no_other_frames(px4: Client) -> None:
    px4.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 10.0)
    px4.until("LOCAL_POSITION_NED")
    stream(px4, 0.0, 3.0, frame=7)
    assert px4.mode(6) != 0


def test_faults_on_demand(copter: Client) -> None:
    copter.take_off(20.0)
    copter.fake.do("jump", 100, 0, 0)
    copter.until("LOCAL_POSITION_NED", lambda m: m.x > 99.0)
    copter.fake.do("jump", 0, 0, 0)
    copter.ask_rate(mav.MAVLINK_MSG_ID_SYS_STATUS)
    copter.fake.do("battery", 0.13)
    copter.until("SYS_STATUS", lambda m: m.battery_remaining == 13)
    copter.ask_rate(mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    copter.fake.do("lose", 1)
    copter.until("EKF_STATUS_REPORT", lambda m: m.flags != 0x33F)
    assert copter.mode(6) == 4, "nobody returns who does not know where it is"
    copter.fake.do("lose", 0)
    copter.fake.do("late", 2.0)
    before_s = copter.fake.report()["t_s"]
    copter.mode(5)
    assert copter.fake.report()["t_s"] - before_s > 1.9
    copter.fake.do("late", 0.0)
    copter.fake.do("mode", "ALT_HOLD")
    copter.until("HEARTBEAT", lambda m: m.custom_mode == 2)
    copter.fake.do("freeze", 1)
    copter.fake.report()
    while copter.link.recv_match(type="LOCAL_POSITION_NED", blocking=True, timeout=0.3):
        pass
    copter.fake.do("freeze", 0)
    copter.until("LOCAL_POSITION_NED")
    copter.fake.do("drop", 0.2)
    time.sleep(0.3)
    again = Client(copter.fake)
    again.until("HEARTBEAT", lambda m: m.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
    again.link.close()


def test_it_refuses_to_arm_on_demand(copter: Client) -> None:
    copter.fake.do("refuse", 1)
    copter.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    copter.until("LOCAL_POSITION_NED")
    assert copter.arm() == 4
    assert "check frame class" in copter.until("STATUSTEXT").text


def test_parameters_are_answered_by_name_and_unknown_ones_are_not(copter: Client, px4: Client) -> None:
    copter.link.mav.param_request_read_send(1, 1, b"NO_SUCH_NAME", -1)
    copter.link.mav.param_request_read_send(1, 1, b"WPNAV_SPEED_DN", -1)
    answer = copter.until("PARAM_VALUE")
    assert (answer.param_id, answer.param_value) == ("WPNAV_SPEED_DN", 150.0)
    px4.link.mav.param_request_read_send(1, 1, b"GF_ACTION", -1)
    answer = px4.until("PARAM_VALUE")
    assert answer.param_type == mav.MAV_PARAM_TYPE_INT32
    assert struct.unpack("<i", struct.pack("<f", answer.param_value)) == (2,), "byte by byte"


def test_more_wind_than_it_flies_blows_it_away_and_a_return_gets_no_nearer(copter: Client) -> None:
    copter.fake.do("fly", 0, 0, 30)
    copter.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    copter.until("LOCAL_POSITION_NED")
    copter.fake.do("wind", 8, 0)
    copter.wait_s(20.0)
    assert copter.place() == pytest.approx((0.0, 0.0, -30.0), abs=1.0)
    copter.fake.do("wind", 20, 0)
    copter.wait_s(20.0)
    assert copter.mode(6) == 0
    away_m = copter.place()[0]
    assert away_m > 40.0
    copter.wait_s(20.0)
    assert copter.place()[0] > away_m + 100.0
    assert copter.fake.report()["mode"] == "RTL"


def test_a_target_outside_its_fence_is_ignored_without_a_word(copter: Client) -> None:
    copter.fake.do("fly", 0, 0, 30)
    copter.fake.do("param", "FENCE_ENABLE", 1)
    copter.fake.do("param", "FENCE_RADIUS", 50)
    copter.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    copter.ask_rate(mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED)
    copter.until("LOCAL_POSITION_NED")
    copter.send(40.0, 0.0, -30.0)
    copter.until("POSITION_TARGET_LOCAL_NED", lambda m: m.x == 40.0)
    copter.send(60.0, 0.0, -30.0)
    copter.wait_s(20.0)
    assert copter.place() == pytest.approx((40.0, 0.0, -30.0), abs=0.5)
    assert copter.until("POSITION_TARGET_LOCAL_NED").x == 40.0


def test_it_falls_with_a_failed_motor_and_stays_armed_for_a_while(px4: Client) -> None:
    px4.fake.do("fly", 0, 0, 40)
    px4.ask_rate(mav.MAVLINK_MSG_ID_ATTITUDE)
    px4.until("ATTITUDE", lambda m: abs(m.roll) < 0.1)
    px4.fake.do("motor", 5)
    px4.until("ATTITUDE", lambda m: m.roll > 1.0)
    down_s = px4.fake.wait_for("touched down")["t_s"]
    disarmed = px4.fake.wait_for("disarmed")
    assert disarmed["why"] == "crashed"
    assert disarmed["t_s"] - down_s == pytest.approx(5.0, abs=0.1)


def test_low_voltage_is_reported_and_not_acted_upon(copter: Client) -> None:
    copter.fake.do("fly", 0, 0, 40)
    copter.ask_rate(mav.MAVLINK_MSG_ID_SYS_STATUS)
    battery = mav.MAV_SYS_STATUS_SENSOR_BATTERY
    copter.until("SYS_STATUS", lambda m: m.onboard_control_sensors_health & battery)
    copter.fake.do("volts", 9.0)
    assert copter.until("STATUSTEXT").text.startswith("Battery 1 is low 9.00V")
    status = copter.until("SYS_STATUS", lambda m: not m.onboard_control_sensors_health & battery)
    assert (status.voltage_battery, status.battery_remaining > 80) == (9000, True)
    assert copter.fake.report()["mode"] == "GUIDED"


def test_a_ground_station_is_missed_in_the_vehicle_s_own_time(copter: Client) -> None:
    copter.fake.do("fly", 0, 0, 40)
    copter.fake.do("param", "FS_GCS_ENABLE", 1)
    copter.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    copter.wait_s(8.0)
    assert copter.fake.report()["mode"] == "GUIDED", "none was there yet"
    heartbeat = (18, 8, 0, 0, 4)
    before_s = copter.fake.report()["t_s"]
    mav.MAVLink(copter.link, 255, 191).heartbeat_send(*heartbeat)
    after_s = copter.fake.report()["t_s"]
    event = copter.fake.wait_for("mode")
    while event["mode"] != "RTL":
        event = copter.fake.wait_for("mode")
    assert before_s + 4.9 < event["t_s"] < after_s + 6.0


def test_a_second_bridge_and_a_second_vehicle_on_the_link(copter: Client) -> None:
    copter.fake.do("fly", 0, 0, 40)
    copter.fake.do("second_bridge_heartbeats", 1)
    copter.fake.do("second_bridge_acks", 1)
    copter.fake.do("second_bridge_target", 30, 0, -40)
    copter.until("HEARTBEAT", lambda m: (m.get_srcSystem(), m.get_srcComponent()) == (255, 191))
    copter.until("COMMAND_ACK", lambda m: m.command == mav.MAV_CMD_DO_SET_MODE)
    copter.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    copter.until("LOCAL_POSITION_NED", lambda m: m.x > 29.0)
    copter.fake.do("second_vehicle", 2)
    copter.until("HEARTBEAT", lambda m: m.get_srcSystem() == 2)
    copter.link.mav.command_long_send(2, 1, mav.MAV_CMD_DO_SET_MODE, 0, 1, 4, 0, 0, 0, 0, 0)
    assert copter.fake.wait_for("second mode")["mode"] == "GUIDED"
    assert copter.fake.all("command") == []


def test_commands_and_positions_that_are_lost_late_or_broken(copter: Client) -> None:
    copter.fake.do("ignore", mav.MAV_CMD_DO_SET_MODE, 1)
    copter.link.mav.command_long_send(1, 1, mav.MAV_CMD_DO_SET_MODE, 0, 1, 4, 0, 0, 0, 0, 0)
    copter.fake.wait_for("lost")
    assert copter.mode(4) == 0
    copter.ask_rate(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 10.0)
    newest_ms = copter.until("LOCAL_POSITION_NED").time_boot_ms
    copter.fake.do("late_position", 1.5)
    copter.fake.wait_for("control")
    for _ in range(40):
        message = copter.until("LOCAL_POSITION_NED")
        if message.time_boot_ms < newest_ms:
            break
        newest_ms = message.time_boot_ms
    assert newest_ms - message.time_boot_ms == pytest.approx(1500, abs=200)
    copter.fake.do("zero_time")
    copter.until("LOCAL_POSITION_NED", lambda m: m.time_boot_ms == 0)
    copter.fake.do("nonsense")
    copter.until("LOCAL_POSITION_NED", lambda m: m.y == 1e9)
    copter.fake.do("twice", 1)
    times = [copter.until("LOCAL_POSITION_NED").time_boot_ms for _ in range(20)]
    assert len(set(times[-10:])) < 8
