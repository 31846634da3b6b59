"""What a vehicle's messages add up to: who is meant, which messages are news, limits, another controller."""

import math
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav

from uav_dc_ros.offboard.flight_stacks import ARDUCOPTER, PX4
from uav_dc_ros.offboard.frames import Enu, Geodetic, Ned
from uav_dc_ros.offboard.limits import MAX_REQUESTS
from uav_dc_ros.offboard.mavlink.telemetry import MavlinkTelemetry
from uav_dc_ros.offboard.vehicle import Limits, Telemetry

HOME = Geodetic(latitude_deg=47.397742, longitude_deg=8.545594, altitude_m=488.0)
HERE = (473977420, 85455940, 488000)
ARDUPILOT, PX4_STACK = 3, 12
NORTH_MPS = 5.0


class Radio:
    """Messages of one sender, with their numbers; `telemetry` takes them in, at `now_s`."""

    def __init__(self, telemetry: MavlinkTelemetry, system: int = 1, component: int = 1) -> None:
        self.telemetry, self.now_s = telemetry, 0.0
        self.codec = mav.MAVLink(None, system, component)

    def make(self, name: str, *fields: Any) -> Any:
        packed = getattr(self.codec, f"{name}_encode")(*fields).pack(self.codec)
        self.codec.seq = (self.codec.seq + 1) % 256
        return mav.MAVLink(None).parse_buffer(packed)[0]

    def send(self, name: str, *fields: Any) -> Telemetry:
        self.telemetry.update(self.make(name, *fields), self.now_s)
        return self.telemetry.snapshot(self.now_s)

    def heartbeat(self, autopilot: int = ARDUPILOT, kind: int = 2, mode: int = 4) -> Telemetry:
        return self.send("heartbeat", kind, autopilot, 0, mode, 4)

    def position(self, boot_s: float, north_m: float = 0.0, east_m: float = 0.0) -> Telemetry:
        return self.send("local_position_ned", round(boot_s * 1e3), north_m, east_m, -3.0, 0, 0, 0)

    def target(self, boot_s: float, north_m: float, mask: int = 0xDF8) -> Telemetry:
        fields = (round(boot_s * 1e3), 1, mask, north_m, 0, -20, *[0] * 8)
        return self.send("position_target_local_ned", *fields)


def met(autopilot: int = ARDUPILOT, datum: Geodetic | None = HOME) -> Radio:
    """A vehicle that was met, and has told where it counts from."""
    radio = Radio(MavlinkTelemetry(datum, Enu(0.0, 0.0, 0.0)))
    radio.heartbeat(autopilot)
    radio.send("gps_global_origin", *HERE)
    return radio


# Who is meant.


def test_only_an_autopilot_is_listened_to() -> None:
    telemetry = MavlinkTelemetry(None, Enu(0.0, 0.0, 0.0))
    Radio(telemetry, 255, 190).heartbeat(8, 6)  # a ground station
    Radio(telemetry, 1, 154).heartbeat(8, 26)  # a gimbal
    assert telemetry.system is None
    known = Radio(telemetry, 7, 1).heartbeat(kind=1)
    assert known.missing == "system 7 is a vehicle of type 1; expected a multicopter"
    known = Radio(telemetry, 8, 1).heartbeat(4)
    assert "autopilot of kind 4; expected 3 (ArduCopter) or 12 (PX4)" in str(known.missing)
    assert known.system == ""
    known = Radio(telemetry, 1, 1).heartbeat()
    assert (telemetry.flight_stack, known.system) == (ARDUCOPTER, "system 1, ArduCopter")


def test_of_two_autopilots_on_a_link_none_is_taken_unless_one_is_named() -> None:
    telemetry = MavlinkTelemetry(None, Enu(0.0, 0.0, 0.0))
    other, ours = Radio(telemetry, 2), Radio(telemetry, 1)
    assert "waiting for its heartbeats, and for those of others" in str(other.heartbeat(PX4_STACK).missing)
    two = "2 autopilots on this link: system 2, PX4; system 1, ArduCopter; expected --system N, one of them"
    known = ours.heartbeat()
    assert (known.missing, known.is_selected) == (two, False)
    other.now_s = ours.now_s = 5.0
    ours.heartbeat()
    assert other.heartbeat(PX4_STACK).missing == two
    assert telemetry.system == 2, "it never changes over by itself"
    other.now_s = 16.0
    for _ in range(4):
        known = other.heartbeat(PX4_STACK)
    assert known.is_selected
    assert "has not sent" in str(known.missing), "the other one is gone"


@pytest.mark.parametrize("first", [1, 2])
def test_the_vehicle_that_is_named_is_taken_whoever_speaks_first(first: int) -> None:
    telemetry = MavlinkTelemetry(HOME, Enu(0.0, 0.0, 0.0), system=2)
    radios = {1: Radio(telemetry, 1), 2: Radio(telemetry, 2)}
    known = radios[first].heartbeat()
    if first == 1:
        others = "no heartbeat from an autopilot of system 2 (there is system 1, ArduCopter)"
        assert known.missing == others
    for _ in range(4):
        radios[1].heartbeat()
        known = radios[2].heartbeat()
    assert "has not sent" in str(known.missing)
    for radio in radios.values():
        radio.send("gps_global_origin", *HERE)
    assert radios[1].position(1.0, 100.0).position is None
    assert radios[2].position(1.0, 50.0).position == pytest.approx((0.0, 50.0, 3.0), abs=0.2)


def test_px4_is_ready_whatever_it_says_of_the_mode_that_it_is_in() -> None:
    assert PX4.estimate_ok(0x37, 0, armed=False)
    assert not PX4.estimate_ok(0x37 | 0x80, 0, armed=False)
    assert not ARDUCOPTER.estimate_ok(0x33F, 0, armed=False)
    assert ARDUCOPTER.estimate_ok(0x33F, 1 << 28, armed=False)
    assert not ARDUCOPTER.estimate_ok(0x37, 1 << 28, armed=False), "not where it would arm"
    assert ARDUCOPTER.estimate_ok(0x37, 0, armed=True), "what it predicts on the ground is gone in the air"


def test_a_long_text_comes_in_parts() -> None:
    radio, text = met(PX4_STACK), "Preflight Fail: " + "x" * 60 + " the end"
    for number in range(2):
        radio.send("statustext", 2, text[number * 50 : number * 50 + 50].encode(), 9, number)
    radio.telemetry.rejections.reject("arming", "failed", 1.5)
    assert radio.telemetry.snapshot(1.5).refusal == f"arming refused: {text}"
    radio.telemetry.rejections.accept("arming")
    assert radio.telemetry.snapshot(1.5).refusal is None


@pytest.mark.parametrize(
    ("command", "shows"), [("arming", "heartbeat"), ("taking off", "extended_sys_state")]
)
def test_a_repeated_command_that_was_executed_is_not_refused(command: str, shows: str) -> None:
    radio = met()
    radio.telemetry.rejections.reject(command, "failed", 1.0)
    assert radio.telemetry.snapshot(1.0).refusal == f"{command} refused: failed"
    radio.send(shows, *{"heartbeat": (2, ARDUPILOT, 0x80, 4, 4), "extended_sys_state": (0, 2)}[shows])
    radio.telemetry.rejections.reject(command, "failed", 1.2)
    assert radio.telemetry.snapshot(1.2).refusal is None
    radio.telemetry.rejections.reject("the change of mode", "denied", 1.3)
    assert radio.telemetry.snapshot(1.3).refusal == "the change of mode refused: denied"


# Which messages are news.


def test_values_that_no_vehicle_can_have_are_ignored_and_counted() -> None:
    radio = met()
    radio.position(1.0, 10.0)
    radio.send("attitude", 1100, 0.1, 0.0, 0, 0, 0, 0)
    before = radio.send("sys_status", 0, 0, 0, 0, 12000, -1, 55, 0, 0, 0, 0, 0, 0)
    for boot_s, (north_m, east_m) in enumerate([(math.nan, 2.0), (1.0, math.inf), (2e5, 0.0)], 2):
        radio.position(boot_s, north_m, east_m)
    radio.send("gps_global_origin", 2_000_000_000, 85455940, 488000)
    radio.send("home_position", 0, 2_000_000_000, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
    radio.send("attitude", 1300, math.nan, 0.0, 0, 0, 0, 0)
    radio.send("extended_sys_state", 0, 9)
    known = radio.send("sys_status", 0, 0, 0, 0, 12000, -1, 120, 0, 0, 0, 0, 0, 0)
    assert known.discarded == {"impossible": 8}
    assert (known.position, known.home, known.on_ground) == (before.position, None, None)
    assert (known.battery, known.tilt_rad) == (0.55, pytest.approx(0.1))
    known = radio.send("sys_status", 0, 0, 0, 0, 65535, -1, -1, 0, 0, 0, 0, 0, 0)
    assert (known.battery, known.battery_v) == (None, None)


def test_one_message_at_time_zero_changes_nothing() -> None:
    radio = met()
    before = radio.position(600.0, 5.0)
    known = radio.position(0.0, 7.0)
    assert (known.position, known.vehicle_s) == (before.position, 600.0)
    assert known.discarded == {"zeroed": 1}


def test_a_message_that_comes_late_or_twice_changes_nothing() -> None:
    radio = met()
    radio.position(600.0)
    late = radio.make("local_position_ned", 600_050, 99.0, 0, -3, 0, 0, 0)
    late_mode = radio.make("heartbeat", 2, 3, 128, 5, 4)
    for tick in range(2, 40):
        radio.now_s += 0.05
        before = radio.position(600.0 + 0.05 * tick)
    twice = radio.make("heartbeat", 2, 3, 0, 4, 4)
    for message in (late, late_mode, twice, twice):
        radio.telemetry.update(message, radio.now_s)
    known = radio.telemetry.snapshot(radio.now_s)
    assert (known.position, known.position_s, known.mode) == (before.position, before.position_s, before.mode)
    assert not known.armed, "nor does an old heartbeat"
    assert known.discarded == {"late": 2, "repeated": 1}


def test_a_message_that_was_overtaken_by_others_is_news() -> None:
    """On a link that reorders, a heartbeat would otherwise be late for ever."""
    radio = met()
    for second in range(5):
        heartbeat = radio.make("heartbeat", 2, 3, 0, 5, 4)
        radio.now_s += 1.0
        radio.position(600.0 + second)
        radio.telemetry.update(heartbeat, radio.now_s)
        radio.telemetry.update(heartbeat, radio.now_s)
        assert radio.telemetry.snapshot(radio.now_s).heartbeat_s == radio.now_s
    assert radio.telemetry.discarded == {"late": 5}, "the second time"


def test_a_mode_that_was_just_left_is_believed_at_the_second_heartbeat() -> None:
    """The first may be seconds old: numbers begin anew after 256."""
    radio = met()
    guided = radio.send("heartbeat", 2, 3, 0, 4, 4)
    radio.now_s += 1.0
    landing = radio.send("heartbeat", 2, 3, 0, 9, 4)
    assert (guided.mode_name, landing.mode_name) == ("GUIDED", "LAND")
    radio.now_s += 1.0
    assert radio.send("heartbeat", 2, 3, 0, 4, 4).mode_name == "LAND"
    assert radio.telemetry.is_mode_uncertain(radio.now_s), "nothing is commanded until that is clear"
    radio.now_s += 1.0
    assert radio.send("heartbeat", 2, 3, 0, 4, 4).mode_name == "GUIDED"
    assert not radio.telemetry.is_mode_uncertain(radio.now_s)
    radio.now_s += 10.0
    assert radio.send("heartbeat", 2, 3, 0, 9, 4).mode_name == "LAND", "at once, after a while"
    radio.now_s += 1.0
    assert radio.send("heartbeat", 2, 3, 0, 5, 4).mode_name == "LOITER", "at once, if it is another"


def test_a_position_that_was_overtaken_is_as_old_as_it_is() -> None:
    """The only one for a while: it is taken, and not taken for fresh."""
    radio = met()
    radio.position(600.0)
    for tick in range(1, 9):
        radio.now_s += 0.1
        radio.send("attitude", 600_000 + 100 * tick, 0, 0, 0, 0, 0, 0)
    known = radio.position(600.05, 1.0)
    assert known.position == pytest.approx((0.0, 1.0, 3.0), abs=0.01)
    assert known.position_s == pytest.approx(radio.now_s - 0.75)


def test_a_vehicle_that_starts_anew_is_believed_when_it_says_so_for_a_while() -> None:
    radio = met()
    radio.position(600.0, 1.0)
    radio.codec.seq = 0
    for tick in range(30):
        radio.now_s += 0.05
        known = radio.position(2.0 + 0.05 * tick, 2.0)
        if tick < 20:
            assert known.position is not None, "one message, or a few, are no evidence"
            assert known.vehicle_s == 600.0
    assert known.position is None, "it has not told where it counts from"
    assert 601.0 <= known.vehicle_s <= 602.0, "its time goes on"
    assert known.discarded["late"] >= 20
    radio.send("gps_global_origin", *HERE)
    radio.now_s += 0.05
    assert radio.position(4.0, 2.0).position is not None


def test_one_time_far_ahead_is_not_the_vehicle_s() -> None:
    radio = met()
    radio.position(600.0)
    assert radio.position(4_000_000.0).vehicle_s == 600.0
    radio.now_s += 0.05
    known = radio.position(600.05, 1.0)
    assert (known.vehicle_s, known.discarded) == (600.05, {"impossible": 1})
    assert known.position_s == radio.now_s


def test_after_a_gap_of_the_link_its_time_goes_on_where_it_is() -> None:
    radio = met()
    radio.position(600.0)
    radio.now_s += 10.0
    for tick in range(3):
        radio.now_s += 0.05
        known = radio.position(610.0 + 0.05 * tick, 1.0)
    assert known.vehicle_s == pytest.approx(610.1)
    assert known.position_s == radio.now_s


def test_many_lost_messages_do_not_make_the_next_ones_old() -> None:
    radio = met()
    radio.position(600.0)
    for _ in range(200):
        radio.make("heartbeat", 2, 3, 0, 4, 4)  # lost: the count goes on by more than half of its numbers
    for tick in range(1, 20):
        radio.now_s += 0.01
        known = radio.position(600.0 + 0.01 * tick, float(tick))
    assert known.position_s == radio.now_s


def test_a_router_that_does_not_count_is_listened_to() -> None:
    radio = met()
    for tick in range(1, 40):
        radio.codec.seq, radio.now_s = 1, 0.05 * tick
        assert radio.position(600.0 + 0.05 * tick).position_s == radio.now_s


FATES = st.sampled_from(["late", "twice", "zeroed", "nonsense", "lost", "ahead"])


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    fates=st.dictionaries(st.integers(1, 399), st.tuples(FATES, st.floats(0.06, 3.0)), max_size=120),
    boot_s=st.floats(1.0, 4e6),
)
def test_whatever_happens_to_single_messages_the_vehicle_is_where_it_is(
    fates: dict[int, tuple[str, float]], boot_s: float
) -> None:
    """Twenty seconds of positions at 20 Hz; every third message is well."""
    radio = met()
    arrivals: list[tuple[float, Any]] = []
    for number in range(400):
        sent_s = 0.05 * number
        fate, how_long_s = fates.get(number, ("", 0.0)) if number % 3 else ("", 0.0)
        boot_ms = round((boot_s + sent_s) * 1e3)
        told_ms = {"zeroed": 0, "ahead": boot_ms + round(1e5 * how_long_s)}.get(fate, boot_ms)
        north_m = math.nan if fate == "nonsense" else NORTH_MPS * sent_s
        message = radio.make("local_position_ned", told_ms, north_m, 0, 0, 0, 0, 0)
        if fate != "lost":
            arrivals.append((sent_s + (how_long_s if fate == "late" else 0.0), message))
        if fate == "twice":
            arrivals.append((sent_s + 0.02, message))
    before = radio.telemetry.snapshot(0.0)
    taken = 0
    for arrives_s, message in sorted(arrivals, key=lambda arrival: arrival[0]):
        taken += radio.telemetry.update(message, arrives_s)
        known = radio.telemetry.snapshot(arrives_s)
        assert known.position is not None
        assert known.position_s is not None
        assert known.vehicle_s >= before.vehicle_s
        assert known.vehicle_s <= boot_s + arrives_s + 1e-3
        is_at_s = known.position.north_m / NORTH_MPS
        assert is_at_s <= arrives_s + 1e-2, "never where it was not yet"
        assert known.position_s - is_at_s <= 0.01 * is_at_s + 0.021, "never fresher than it is"
        if before.position is not None:
            assert known.position.north_m >= before.position.north_m, "never back"
        before = known
    assert arrives_s - before.position_s <= 3.0 + 0.15
    assert taken + sum(before.discarded.values()) == len(arrivals), "what is ignored is counted"


# What it is told besides.


def test_home_target_and_tilt() -> None:
    radio = met()
    radio.position(1.0)
    radio.send("home_position", 473977420, 85455940 + 10_000, 490000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
    radio.send("attitude", 1100, 0.3, 0.4, 2.0, 0, 0, 0)
    known = radio.target(1.2, 100.0)
    assert known.home == pytest.approx((75.46, 0.0, 2.0), abs=0.1)
    assert known.tilt_rad == pytest.approx(math.acos(math.cos(0.3) * math.cos(0.4)))
    assert known.target == pytest.approx((0.0, 99.9, 20.0), abs=0.2)
    assert radio.target(1.3, 0.0, mask=0xDC7).target is None, "a velocity is no position"
    assert radio.target(1.4, math.nan).target is None, "PX4, in a mode without one"
    radio.now_s += 5.0
    known = radio.position(6.0)
    assert (known.tilt_rad, known.target) == (None, None), "long ago"


def test_an_estimate_that_is_not_reported_any_more_is_not_one_that_is_lost() -> None:
    radio = met()
    radio.now_s = 1.0
    assert radio.position(1.0).estimate_s is None
    radio.now_s = 2.0
    radio.send("ekf_status_report", 0x33F, 0, 0, 0, 0, 0)
    radio.now_s = 12.0
    known = radio.heartbeat()
    assert (known.estimate_ok, known.estimate_s) == (False, 2.0)


# Limits.


def answer(radio: Radio, values: dict[str, float]) -> None:
    for name in radio.telemetry.parameters_to_request(radio.now_s):
        if name in values:
            radio.send("param_value", name.encode(), values[name], 9, 500, 1)


FENCE = {"FENCE_ENABLE": 1, "FENCE_AUTOENABLE": 0, "FENCE_RADIUS": 120.0, "FENCE_ALT_MAX": 80.0}
FENCE |= {"FENCE_ALT_MIN": 5.0, "FENCE_TOTAL": 0, "FENCE_TYPE": 7}


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (
            FENCE | {"WPNAV_SPEED": 1000.0, "WPNAV_SPEED_UP": 250.0, "WPNAV_SPEED_DN": 150.0},
            Limits(fence_radius_m=120, fence_ceiling_m=80, speed_mps=10, climb_mps=2.5, descent_mps=1.5),
        ),
        (
            FENCE | {"FENCE_TYPE": 12, "FENCE_TOTAL": 4, "WP_SPD": 8.0, "WP_SPD_UP": 2.0, "WP_SPD_DN": 1.0},
            Limits(fence_floor_m=5, polygon_fence=True, speed_mps=8, climb_mps=2, descent_mps=1),
        ),
        (FENCE | {"FENCE_ENABLE": 0}, Limits()),
        (FENCE | {"FENCE_ENABLE": 0, "FENCE_AUTOENABLE": 3, "FENCE_TYPE": 2}, Limits(fence_radius_m=120)),
        ({}, None),
    ],
)
def test_limits_of_arducopter(values: dict[str, float], expected: Limits | None) -> None:
    radio = met()
    answer(radio, values)
    assert radio.telemetry.snapshot(0.0).limits == expected


def test_limits_of_px4_whose_integers_are_bytes() -> None:
    radio = met(PX4_STACK)
    (three,) = struct.unpack("<f", struct.pack("<i", 3))
    radio.send("param_value", b"GF_ACTION", three, mav.MAV_PARAM_TYPE_INT32, 500, 1)
    answer(radio, {"GF_MAX_HOR_DIST": 300.0, "GF_MAX_VER_DIST": 0.0, "MPC_XY_VEL_MAX": 12.0})
    answer(radio, {"MPC_Z_VEL_MAX_UP": 3.0, "MPC_Z_VEL_MAX_DN": 1.5})
    expected = Limits(fence_radius_m=300.0, speed_mps=12.0)
    assert radio.telemetry.snapshot(0.0).limits == expected
    (one,) = struct.unpack("<f", struct.pack("<i", 1))
    known = radio.send("param_value", b"GF_ACTION", one, mav.MAV_PARAM_TYPE_INT32, 500, 1)
    assert known.limits == Limits(speed_mps=12.0), "it only warns, and somebody has just changed that"


@pytest.mark.parametrize("autopilot", [ARDUPILOT, PX4_STACK])
def test_a_vehicle_that_answers_for_no_parameter_is_not_waited_for_long(autopilot: int) -> None:
    radio = met(autopilot)
    for _ in range(3):
        radio.heartbeat(autopilot)
    estimate = ("ekf_status_report", "estimator_status")[autopilot == PX4_STACK]
    radio.send(estimate, *((0x33F, 0, 0, 0, 0, 0) if autopilot == ARDUPILOT else (0, 0x33F, *[0] * 8)))
    radio.send("sys_status", 1 << 28, 1 << 28, 1 << 28, 0, 12000, -1, 55, 0, 0, 0, 0, 0, 0)
    radio.send("extended_sys_state", 0, 1)
    radio.send("system_time", 0, 900)
    asked: list[str] = []
    while "parameters" in str(radio.position(1.0 + radio.now_s).missing):
        asked += radio.telemetry.parameters_to_request(radio.now_s)
        radio.now_s += 0.1
    assert radio.now_s < 3.0
    assert radio.telemetry.snapshot(radio.now_s).missing is None
    assert all(asked.count(name) == MAX_REQUESTS for name in asked)


# Another controller.


def test_heartbeats_of_our_own_identity_that_are_not_ours_are_another_controller() -> None:
    radio = met()
    other = Radio(radio.telemetry, 255, 191)
    other.codec.seq = 100
    for second in range(1, 4):
        radio.telemetry.other_controllers.sent_heartbeat(second)
        radio.position(float(second))
        before = other.send("heartbeat", 18, 8, 0, 0, 4)
        if second < 3:
            assert before.other_controller is None, "one process may leave the other a message or two"
    words = "heartbeats of system 255, component 191 that this bridge did not send"
    assert before.other_controller == words
    for second in range(4, 16):
        known = radio.position(float(second))
    assert known.other_controller is None, "it is gone"


def test_what_a_router_sends_back_is_no_other_controller() -> None:
    radio = met()
    echo = Radio(radio.telemetry, 255, 191)
    for second in range(1, 60):
        echo.codec.seq = number = 20 * second % 256
        radio.telemetry.other_controllers.sent_heartbeat(number)
        radio.position(float(second))
        assert echo.send("heartbeat", 18, 8, 0, 0, 4).other_controller is None


def test_a_ground_station_is_no_other_controller() -> None:
    radio = met()
    station = Radio(radio.telemetry, 255, 190)
    for second in range(1, 60):
        radio.telemetry.other_controllers.sent_heartbeat(second)
        radio.position(float(second))
        assert station.send("heartbeat", 6, 8, 0, 0, 4).other_controller is None


def test_answers_to_commands_that_were_never_sent_are_another_controller() -> None:
    radio = met()
    rivals = radio.telemetry.other_controllers
    rivals.sent_command(mav.MAV_CMD_DO_SET_MODE, 0.0)
    for second in range(1, 10):
        known = radio.position(float(second))
        rivals.on_ack(mav.MAV_CMD_DO_SET_MODE, known.vehicle_s)
        assert radio.telemetry.snapshot(0.0).other_controller is None, "asked for once, answered often"
    for _ in range(3):
        rivals.on_ack(mav.MAV_CMD_NAV_TAKEOFF, known.vehicle_s)
    words = "answers to commands of system 255, component 191 that this bridge did not send"
    assert radio.telemetry.snapshot(0.0).other_controller == words


@pytest.mark.parametrize("mode", [4, 5])
def test_targets_that_were_never_sent_are_another_controller(mode: int) -> None:
    radio = met()
    radio.heartbeat(mode=mode)
    for tick in range(1, 80):
        radio.position(0.5 * tick)
        known = radio.target(0.5 * tick, 100.0 * (tick // 20))
    found = known.other_controller is not None
    assert found == (mode == 4), "in its own modes a vehicle has targets of its own"
    if found:
        assert str(known.other_controller).startswith("position targets of ")


def test_the_last_target_of_a_bridge_that_was_killed_is_no_other_controller() -> None:
    radio = met()
    radio.heartbeat()
    for tick in range(1, 40):
        radio.position(0.5 * tick)
        if tick < 20:
            north_m = 100.0  # what the process before has left
        else:
            north_m = 200.0 + 100.0 * (tick // 10)
            radio.telemetry.other_controllers.sent_setpoint(Ned(north_m, 0.0, -20.0))
        assert radio.target(0.5 * tick, north_m).other_controller is None
