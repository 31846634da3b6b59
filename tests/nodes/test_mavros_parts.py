"""The parts of the MAVROS transport without DDS: what follows from what is heard, and what is asked for.

mavros_msgs cannot be installed where this is tested: its messages are stood in for by plain classes of the
same fields (those that MAVROS's sys_status and command plugins fill in, and of its .msg and .srv files),
its services by an object that is called as rclpy's client is. So this shows what becomes of them, not that
they arrive.
"""

import math
import sys
import threading
import time
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.task import Future

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.nodes.vehicles import mavros
from uav_dc_ros.nodes.vehicles.mavros import RETRY_S, MavrosCommands
from uav_dc_ros.offboard.flight_stacks import ARDUCOPTER, PX4
from uav_dc_ros.offboard.frames import Enu, Geodetic, tilt_rad
from uav_dc_ros.offboard.mavros.diagnostics import OTHERS_S
from uav_dc_ros.offboard.mavros.telemetry import (
    ESTIMATOR_STATUS,
    EXTENDED_STATE,
    HOME,
    STAMP_TIMEOUT_S,
    STATE,
    SYS_STATUS,
    TARGET,
    MavrosTelemetry,
    VehicleTime,
)
from uav_dc_ros.offboard.mission.fault_detector import FaultDetector, SafetySettings
from uav_dc_ros.offboard.rejections import Rejections
from uav_dc_ros.offboard.setpoint_stream import STREAM_TIMEOUT_S, SetpointStream
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, TakeOff

PLACE = Enu(20.0, 0.0, 0.0)
LINK = "uas:///uas1"
HEALTHY = (1 << 21) | (1 << 25) | (1 << 28)  # estimate, battery, would arm


def heartbeat(
    telemetry: MavrosTelemetry,
    beats: int,
    mode: str = "POSCTL",
    state: str = "Standby",
    kind: str = "PX4 Autopilot",
    *,
    vehicle: str = "Quadrotor",
    node: str = "mavros",
    now_s: float = 1.0,
    health: int = HEALTHY,
) -> None:
    """One second of MAVROS's diagnostics."""
    values = {
        "Heartbeats since startup": str(beats),
        "Vehicle type": vehicle,
        "Autopilot type": kind,
        "Mode": mode,
        "System status": state,
    }
    telemetry.diagnostics.on_status(f"{node}: Heartbeat", LINK, values, now_s)
    system = {"Sensor present": "0x1FFFFFFF", "Sensor enabled": f"0x{HEALTHY:08X}"}
    system["Sensor health"] = f"0x{health:08X}"
    telemetry.diagnostics.on_status(f"{node}: System", LINK, system, now_s)


def met(kind: str = "PX4 Autopilot", **how: Any) -> MavrosTelemetry:
    """A vehicle that stands on the ground at 5, 6, 7 of MAVROS's frame, is well, and was listened to."""
    telemetry = MavrosTelemetry(PLACE, **how)
    for beats in (1, 2, 3):
        heartbeat(telemetry, beats, kind=kind)
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 100.0, 1.0)
    return telemetry


# Frames.


def test_the_first_pose_on_the_ground_is_the_place_and_both_ways_agree() -> None:
    telemetry = met()
    assert telemetry.snapshot(1.0).missing is None
    assert telemetry.position == PLACE
    assert telemetry.origin == Enu(15.0, -6.0, -7.0)
    telemetry.on_pose(Enu(6.0, 8.0, 10.0), 0.5, 101.0, 2.0)
    assert telemetry.position == Enu(21.0, 2.0, 3.0), "east is east, north is north, up is up"
    assert telemetry.to_mavros(Enu(21.0, 2.0, 3.0)) == Enu(6.0, 8.0, 10.0)


def test_in_the_air_or_without_an_estimate_nothing_is_the_place() -> None:
    for state, health in [("Active", HEALTHY), ("Critical", HEALTHY), ("Standby", 1 << 28)]:
        telemetry = MavrosTelemetry(PLACE)
        for beats in (1, 2, 3):
            heartbeat(telemetry, beats, "OFFBOARD", state, health=health)
        telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 100.0, 1.0)
        known = telemetry.snapshot(1.0)
        assert (known.position, telemetry.accepts_setpoints) == (None, False)
        assert known.missing is not None
        assert "expected it" in known.missing or "not ready to arm" in known.missing


def test_a_grid_origin_needs_no_ground() -> None:
    grid_origin = "15.1,-6.0,-7.000000000000001"
    telemetry = MavrosTelemetry(PLACE, grid_origin=grid_origin)
    assert ",".join(map(repr, telemetry.origin or ())) == grid_origin
    for beats in (1, 2, 3):
        heartbeat(telemetry, beats, "OFFBOARD", "Active")
    telemetry.on_pose(Enu(5.0, 6.0, 30.0), 0.5, 100.0, 1.0)
    known = telemetry.snapshot(1.0)
    assert known.missing is None
    assert known.position == pytest.approx((20.1, 0.0, 23.0))
    assert (known.armed, known.on_ground, telemetry.accepts_setpoints) == (True, False, True)
    for wrong in ("1,2", "1,2,nan", "1,2,3,4", "here"):
        with pytest.raises(VehicleError, match=r"^grid origin: .*; expected EAST,NORTH,UP"):
            MavrosTelemetry(PLACE, grid_origin=wrong)


def test_with_a_datum_the_fix_says_where_it_stands_across_and_the_ground_how_high() -> None:
    datum = Geodetic(latitude_deg=47.4, longitude_deg=8.5, altitude_m=400.0)
    stands = datum.at(Enu(250.0, 120.0, 88.0))
    telemetry = met(datum=datum)
    assert "no fix on mavros/global_position/global" in str(telemetry.snapshot(1.0).missing)
    telemetry.on_fix(False, stands.latitude_deg, stands.longitude_deg, 1.0)
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 100.1, 1.1)
    assert telemetry.position is None, "no fix"
    telemetry.on_fix(True, stands.latitude_deg, stands.longitude_deg, 1.2)
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 100.2, 9.0)
    assert telemetry.position is None, "an old fix"
    telemetry.on_fix(True, stands.latitude_deg, stands.longitude_deg, 9.2)
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 100.3, 9.3)
    assert telemetry.position == pytest.approx((250.0, 120.0, 0.0), abs=0.01)


def test_without_a_datum_the_fix_says_where_the_grid_came_to_lie() -> None:
    corner = Geodetic(latitude_deg=47.4, longitude_deg=8.5, altitude_m=0.0)
    stands = corner.at(PLACE)
    telemetry = met()
    assert telemetry.corner is None
    telemetry.on_fix(True, stands.latitude_deg, stands.longitude_deg, 1.2)
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 100.2, 1.3)
    assert telemetry.corner is not None
    assert telemetry.corner.enu_from(corner) == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    assert telemetry.position == PLACE


# What the diagnostics tell.


def test_mode_arming_and_ground_follow_from_the_diagnostics() -> None:
    cases = [
        # kind, mode, MAV_STATE -> mode, armed, on the ground, may it be steered
        ("PX4 Autopilot", "POSCTL", "Standby", Mode.OTHER, False, True, True),
        ("PX4 Autopilot", "OFFBOARD", "Active", Mode.COMMANDED, True, None, True),
        ("PX4 Autopilot", "AUTO.RTL", "Critical", Mode.RETURN, True, None, True),
        ("PX4 Autopilot", "AUTO.LAND", "Active", Mode.LAND, True, None, True),
        ("PX4 Autopilot", "CMODE(393216)", "Active", Mode.COMMANDED, True, None, True),
        ("ArduPilot", "STABILIZE", "Standby", Mode.OTHER, False, True, False),
        ("ArduPilot", "GUIDED", "Active", Mode.COMMANDED, True, False, True),
        ("ArduPilot", "CMODE(21)", "Active", Mode.RETURN, True, False, True),
        ("ArduPilot", "OFFBOARD", "Active", Mode.OTHER, True, False, True),
        ("ArduPilot", "", "Active", Mode.OTHER, True, False, True),
    ]
    for kind, mode, state, expected, armed, on_ground, steered in cases:
        telemetry = met(kind)
        heartbeat(telemetry, 4, "AUTO.LOITER", "Active" if armed else "Standby", kind)
        heartbeat(telemetry, 5, mode, state, kind)
        known = telemetry.snapshot(1.0)
        told = (known.mode, known.armed, known.on_ground, telemetry.accepts_setpoints)
        assert told == (expected, armed, on_ground, steered), (kind, mode, state)
        assert known.mode_name == mode


def test_a_heartbeat_is_one_that_was_counted() -> None:
    telemetry = met()
    heartbeat(telemetry, 4, now_s=5.0)
    assert telemetry.snapshot(5.0).heartbeat_s == 5.0
    heartbeat(telemetry, 4, now_s=6.0)  # MAVROS lives, and has heard no more of the autopilot
    assert telemetry.snapshot(6.0).heartbeat_s == 5.0


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ({"kind": "Generic autopilot"}, "the autopilot is 'Generic autopilot'; expected 'ArduPilot' or"),
        ({"vehicle": "Fixed wing aircraft"}, "the vehicle is 'Fixed wing aircraft'; expected a multicopter"),
    ],
)
def test_a_stranger_is_told(how: dict[str, str], expected: str) -> None:
    telemetry = met()
    heartbeat(telemetry, 4, **how)
    assert expected in str(telemetry.snapshot(1.0).missing)


def test_two_vehicles_on_one_topic_are_told_and_the_first_is_listened_to() -> None:
    telemetry = met()
    heartbeat(telemetry, 90, "AUTO.RTL", "Active", node="other", now_s=2.0)
    known = telemetry.snapshot(2.0)
    expected = f"/diagnostics has mavros ({LINK}) and other ({LINK}); expected one MAVROS"
    assert (known.missing, known.mode_name) == (expected, "POSCTL")
    heartbeat(telemetry, 4, now_s=3.0 + OTHERS_S)
    assert telemetry.snapshot(3.0 + OTHERS_S).missing is None
    twins = MavrosTelemetry(PLACE)
    for beats in range(1, 9):
        heartbeat(twins, beats)
        heartbeat(twins, beats + 1000)
        twins.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 100.0 + beats, 1.0)
        assert "waiting for other vehicles" in str(twins.snapshot(1.0).missing), "one name, two counts"


def test_garbage_in_the_diagnostics_changes_nothing() -> None:
    telemetry = met()
    before = telemetry.snapshot(1.0)
    for values in [
        {},
        {"Mode": "GUIDED"},
        {
            "Heartbeats since startup": "many",
            "Autopilot type": "ArduPilot",
            "Vehicle type": "?",
            "Mode": "GUIDED",
            "System status": "Active",
        },
    ]:
        telemetry.diagnostics.on_status("mavros: Heartbeat", LINK, values, 2.0)
    telemetry.diagnostics.on_status("mavros: System", LINK, {"Sensor present": "yes"}, 2.0)
    telemetry.diagnostics.on_status("uav_dc_ros/policy", "uav_dc_ros", {"state": "active"}, 2.0)
    telemetry.diagnostics.on_status("", "", {}, 2.0)
    assert telemetry.snapshot(1.0) == before


def test_batteries_tell_the_least_or_nothing() -> None:
    telemetry = met()
    assert telemetry.snapshot(1.0).battery is None
    for where, charge, volts, expected in [
        ("", -0.01, 12.0, (None, 12.0)),
        ("", math.nan, 65.535, (None, None)),
        ("", 0.9, 0.0, (0.9, None)),
        ("id0", 0.5, 11.5, (0.5, 11.5)),
        ("id1", 0.3, 11.3, (0.3, 11.3)),
        ("id1", 0.7, 11.7, (0.5, 11.5)),
        ("id0", -0.01, 11.5, (0.7, 11.7)),
    ]:
        telemetry.on_battery(where, charge, volts)
        known = telemetry.snapshot(1.0)
        assert (known.battery, known.battery_v) == expected, (where, charge)
    assert not known.battery_fails
    heartbeat(telemetry, 4, health=HEALTHY & ~(1 << 25))
    assert telemetry.snapshot(1.0).battery_fails


def test_an_estimate_that_is_lost_is_told() -> None:
    for kind, mode in [("ArduPilot", "GUIDED"), ("PX4 Autopilot", "OFFBOARD")]:
        telemetry = met(kind)
        heartbeat(telemetry, 4, mode, "Active", kind, health=1 << 21)
        assert telemetry.snapshot(1.0).estimate_ok, "what it checks before arming says nothing in the air"
        heartbeat(telemetry, 5, mode, "Active", kind, health=1 << 28)
        assert not telemetry.snapshot(1.0).estimate_ok
        heartbeat(telemetry, 6, mode, "Standby", kind, health=1 << 21)
        known = telemetry.snapshot(1.0)
        assert known.estimate_ok == (kind != "ArduPilot"), "PX4 tells that of the mode that it is in"
        assert (known.missing is None) == known.estimate_ok


# Time.


def test_vehicle_time_follows_the_stamps_and_only_ever_goes_on() -> None:
    clock = VehicleTime()
    assert clock.at(5.0) == 0.0
    clock.update(1000.0, 5.0)
    clock.update(1002.0, 5.1)  # twenty times as fast
    assert clock.at(5.1) == pytest.approx(2.0)
    clock.update(500.0, 5.2)  # another offset
    assert clock.at(5.2) == pytest.approx(2.1)
    clock.update(9e8, 5.3)
    assert clock.at(5.3) == pytest.approx(2.2)
    assert clock.at(7.3) == pytest.approx(2.2 + 2.0 - STAMP_TIMEOUT_S), "without stamps, by the clock"
    clock.update(9e8 + 0.1, 7.4)
    assert clock.at(7.4) == pytest.approx(2.2 + 2.0 - STAMP_TIMEOUT_S), "it waits, and does not go back"


def test_the_same_pose_again_is_no_news_and_one_without_a_stamp_is() -> None:
    telemetry = met()
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 100.0, 9.0)
    assert telemetry.snapshot(9.0).position_s == 1.0
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 0.0, 10.0)
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 0.0, 11.0)
    known = telemetry.snapshot(11.0)
    assert (known.position_s, known.vehicle_s) == (11.0, pytest.approx(10.0))


def test_a_pose_that_is_late_repeated_or_unstamped_is_counted_and_ignored() -> None:
    telemetry = met()
    for stamp_s, now_s in ((98.5, 1.1), (100.0, 1.2), (0.0, 1.3), (9e6, 1.4)):
        telemetry.on_pose(Enu(400.0, 6.0, 7.0), 0.5, stamp_s, now_s)
        known = telemetry.snapshot(now_s)
        assert (known.position, known.position_s) == (PLACE, 1.0)
    telemetry.on_pose(Enu(6.0, 6.0, 7.0), 0.5, 100.5, 1.5)
    assert telemetry.snapshot(1.5).position == pytest.approx((21.0, 0.0, 0.0))
    assert known.discarded == {"late": 1, "repeated": 1, "zeroed": 1, "impossible": 1}
    telemetry.on_pose(Enu(7.0, 6.0, 7.0), 0.5, 5.0, 2.6)
    assert telemetry.snapshot(2.6).position_s == 2.6, "MAVROS has found another offset, or it has booted anew"


# With mavros_msgs: stand-ins.


class Message(SimpleNamespace):
    """Any message or request: its fields."""


class Service:
    """A class of a service."""

    Request = Message


PACKAGE = mavros.MavrosMsgs(
    msg=SimpleNamespace(**dict.fromkeys(mavros.MESSAGES.values(), Message)),
    srv=SimpleNamespace(**dict.fromkeys(mavros.SERVICES.values(), Service)),
)
FLAGS = [
    *("attitude", "velocity_horiz", "velocity_vert", "pos_horiz_rel", "pos_horiz_abs", "pos_vert_abs"),
    *("pos_vert_agl", "const_pos_mode", "pred_pos_horiz_rel", "pred_pos_horiz_abs", "gps_glitch"),
    "accel_error",
]


def estimator(**wrong: bool) -> Message:
    """mavros_msgs/EstimatorStatus of a good estimate."""
    flags = dict.fromkeys(FLAGS, True) | {"const_pos_mode": False, "gps_glitch": False, "accel_error": False}
    return Message(**{f"{name}_status_flag": flag for name, flag in (flags | wrong).items()})


def full(kind: str) -> MavrosTelemetry:
    """A vehicle on the ground, with all that mavros_msgs tells."""
    telemetry = met(kind, has_msgs=True)
    telemetry.update(STATE, Message(connected=True, armed=False, mode="STABILIZE", system_status=3), 1.0)
    telemetry.update(EXTENDED_STATE, Message(landed_state=1, vtol_state=0), 1.0)
    telemetry.update(SYS_STATUS, Message(sensors_enabled=HEALTHY, sensors_health=HEALTHY), 1.0)
    return telemetry


def test_with_mavros_msgs_all_is_waited_for_and_named() -> None:
    telemetry = met(has_msgs=True)
    missing = str(telemetry.snapshot(1.0).missing)
    assert missing.startswith("nothing received of mavros/state, mavros/extended_state, mavros/sys_status, ")
    telemetry = full("PX4 Autopilot")
    assert telemetry.snapshot(1.0).missing == "nothing received of mavros/estimator_status"
    telemetry.update(ESTIMATOR_STATUS, estimator(), 1.0)
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 101.0, 1.1)
    assert telemetry.snapshot(1.1).missing is None
    arducopter = full("ArduPilot")
    arducopter.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 101.0, 1.1)
    assert arducopter.snapshot(1.1).missing is None, "ArduPilot has no ESTIMATOR_STATUS"


def test_with_mavros_msgs_home_and_target_are_told_in_the_grid_s_frame() -> None:
    telemetry = full("ArduPilot")
    assert (telemetry.snapshot(1.0).home, telemetry.snapshot(1.0).target) == (None, None)
    point = Message(x=5.0, y=16.0, z=7.0)
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 101.0, 1.1, tilt_rad(0.5, 0.5, 0.5, 0.5))
    telemetry.update(HOME, Message(position=point), 1.05)
    telemetry.update(TARGET, Message(position=point, type_mask=0xDF8), 1.05)
    known = telemetry.snapshot(1.1)
    there = (PLACE.east_m, PLACE.north_m + 10.0, PLACE.up_m)
    assert (known.home, known.target) == (pytest.approx(there), pytest.approx(there))
    assert known.target_s == 1.05
    assert known.tilt_rad == pytest.approx(math.pi / 2)
    assert known.system == "mavros (uas:///uas1)"
    telemetry.update(TARGET, Message(position=point, type_mask=0xDFF), 1.1)
    assert telemetry.snapshot(1.1).target is None, "it follows a velocity"


def test_with_mavros_msgs_state_and_ground_are_what_it_says() -> None:
    telemetry = full("ArduPilot")
    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 101.0, 1.1)
    for landed_state, on_ground, steered in [
        (0, None, False),
        (1, True, False),
        (2, False, True),
        (3, False, False),
    ]:
        telemetry.update(STATE, Message(connected=True, armed=True, mode="GUIDED", system_status=4), 2.0)
        telemetry.update(EXTENDED_STATE, Message(landed_state=landed_state), 2.0)
        known = telemetry.snapshot(2.0)
        assert (known.on_ground, telemetry.accepts_setpoints) == (on_ground, steered), (
            "a take-off is not interrupted"
        )
        assert (known.mode, known.armed, known.heartbeat_s) == (Mode.COMMANDED, True, 2.0)
    telemetry.update(STATE, Message(connected=False, armed=False, mode="", system_status=0), 12.0)
    known = telemetry.snapshot(12.0)
    assert (known.armed, known.mode_name, known.heartbeat_s) == (True, "GUIDED", 2.0), (
        "it is lost, not landed"
    )


@pytest.mark.parametrize(
    "wrong",
    [{"const_pos_mode": True}, {"pos_horiz_abs": False}, {"velocity_vert": False}, {"attitude": False}],
)
def test_with_mavros_msgs_the_estimators_flags_count(wrong: dict[str, bool]) -> None:
    telemetry = full("PX4 Autopilot")
    telemetry.update(ESTIMATOR_STATUS, estimator(), 1.0)
    assert telemetry.snapshot(1.0).estimate_ok
    assert not telemetry.snapshot(9.0).estimate_ok, "nothing new for a while"
    telemetry.update(ESTIMATOR_STATUS, estimator(**wrong), 1.0)
    assert not telemetry.snapshot(1.0).estimate_ok


@pytest.mark.parametrize("kind", ["PX4 Autopilot", "ArduPilot"])
def test_with_mavros_msgs_an_estimate_that_a_cut_link_leaves_old_is_not_lost(kind: str) -> None:
    """The link is back: heartbeats come first. What ended while heartbeats came was lost."""
    detector = FaultDetector(SafetySettings())
    telemetry = full(kind)
    sys_status = Message(sensors_enabled=1 << 21, sensors_health=0)

    def report(now_s: float) -> None:
        if kind == "PX4 Autopilot":
            telemetry.update(ESTIMATOR_STATUS, estimator(attitude=False), now_s)
        else:
            telemetry.update(SYS_STATUS, sys_status, now_s)

    def is_lost(now_s: float, heartbeat_s: float) -> bool:
        telemetry.update(
            STATE, Message(connected=True, armed=True, mode="GUIDED", system_status=4), heartbeat_s
        )
        return detector.estimate_lost(now_s, detector.update(now_s, telemetry.snapshot(now_s)))

    telemetry.on_pose(Enu(5.0, 6.0, 7.0), 0.5, 101.0, 1.0)
    report(1.0)
    assert telemetry.snapshot(1.0).estimate_s == 1.0
    assert is_lost(1.1, 1.1), "it says so"
    assert not is_lost(11.1, 11.0), "nothing was said since"
    assert is_lost(14.0, 13.9), "heartbeats come, and no report"
    report(14.1)
    assert is_lost(14.2, 13.9)


class Client:
    """Stands in for a service: is called as rclpy's client is."""

    def __init__(self, answer: Any) -> None:
        self.answer, self.requests, self.ready = answer, [], True

    def service_is_ready(self) -> bool:
        return self.ready

    def call_async(self, request: Any) -> Future:
        self.requests.append(request)
        future = Future()
        future.set_result(self.answer)
        return future


class Node:
    """Stands in for the node: its clients, and its log."""

    def __init__(self) -> None:
        self.clients = {
            "mavros/set_mode": Client(Message(mode_sent=True)),
            "mavros/cmd/arming": Client(Message(success=True, result=0)),
            "mavros/cmd/takeoff": Client(Message(success=True, result=0)),
            "mavros/set_message_interval": Client(Message(success=True)),
        }
        self.warnings: list[str] = []

    def create_client(self, kind: Any, name: str) -> Client:
        return self.clients[name]

    def destroy_client(self, client: Client) -> None:
        client.ready = False

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.warnings.append)


@pytest.mark.parametrize(
    ("command", "dialect", "service", "request_"),
    [
        (SetMode(Mode.COMMANDED), ARDUCOPTER, "mavros/set_mode", {"custom_mode": "GUIDED"}),
        (SetMode(Mode.COMMANDED), PX4, "mavros/set_mode", {"custom_mode": "OFFBOARD"}),
        (SetMode(Mode.RETURN), ARDUCOPTER, "mavros/set_mode", {"custom_mode": "RTL"}),
        (SetMode(Mode.RETURN), PX4, "mavros/set_mode", {"custom_mode": "AUTO.RTL"}),
        (SetMode(Mode.LAND), ARDUCOPTER, "mavros/set_mode", {"custom_mode": "LAND"}),
        (SetMode(Mode.LAND), PX4, "mavros/set_mode", {"custom_mode": "AUTO.LAND"}),
        (SetMode(Mode.HOLD), ARDUCOPTER, "mavros/set_mode", {"custom_mode": "BRAKE"}),
        (SetMode(Mode.HOLD), PX4, "mavros/set_mode", {"custom_mode": "AUTO.LOITER"}),
        (Arm(), PX4, "mavros/cmd/arming", {"value": True}),
        (TakeOff(100.0), ARDUCOPTER, "mavros/cmd/takeoff", {"altitude": 97.5}),
        (TakeOff(100.0), PX4, "mavros/cmd/takeoff", None),  # by setpoints
    ],
)
def test_wishes_become_requests(
    command: Command, dialect: Any, service: str, request_: dict[str, Any] | None
) -> None:
    node = Node()
    rejections = Rejections()
    commands = MavrosCommands(node, PACKAGE, rejections, time.monotonic)  # type: ignore[arg-type]
    commands.send_command(command, dialect, 2.5)
    asked = {name: client.requests for name, client in node.clients.items() if client.requests}
    assert asked == ({service: [Message(**request_)]} if request_ is not None else {})
    assert rejections.latest() is None


def test_refusals_are_told_with_the_autopilots_own_words() -> None:
    node, now_s, rejections = Node(), [10.0], Rejections()
    commands = MavrosCommands(node, PACKAGE, rejections, lambda: now_s[0])  # type: ignore[arg-type]
    arming = node.clients["mavros/cmd/arming"]
    arming.answer = Message(success=False, result=4)
    commands.send_command(Arm(), ARDUCOPTER, 0.0)
    assert rejections.latest() == "arming refused: result 4"
    rejections.on_status_text(6, "idle talk", now_s[0])
    rejections.on_status_text(2, "Arm: waiting for home ", now_s[0])
    assert rejections.latest() == "arming refused: Arm: waiting for home"
    arming.answer = Message(success=True, result=0)
    commands.send_command(Arm(), ARDUCOPTER, 0.0)
    assert rejections.latest() is None
    arming.ready = False
    commands.send_command(Arm(), ARDUCOPTER, 0.0)
    now_s[0] += 60.0
    rejection = str(rejections.latest())
    assert "no node offers mavros/cmd/arming" in rejection or "waiting" in rejection
    assert len(arming.requests) == 2


def test_messages_that_do_not_come_are_asked_for_now_and_then() -> None:
    node, now_s = Node(), [10.0]
    commands = MavrosCommands(node, PACKAGE, Rejections(), lambda: now_s[0])  # type: ignore[arg-type]
    requests = node.clients["mavros/set_message_interval"].requests
    lacking = ["mavros/state", "mavros/local_position/pose", "mavros/extended_state"]
    for _ in range(5):
        commands.request_messages(lacking)
    assert sorted((request.message_id, request.message_rate) for request in requests) == [
        (32, 30.0),
        (245, 5.0),
    ]
    now_s[0] += RETRY_S
    commands.request_messages(lacking)
    assert len(requests) == 4


def test_without_mavros_msgs_nothing_is_asked_for_and_the_pilot_is_told_once() -> None:
    node, rejections = Node(), Rejections()
    commands = MavrosCommands(node, None, rejections, time.monotonic)  # type: ignore[arg-type]
    for _ in range(3):
        commands.send_command(SetMode(Mode.LAND), ARDUCOPTER, 10.0)
        commands.send_command(TakeOff(10.0), ARDUCOPTER, 0.0)
        commands.send_command(Arm(), ARDUCOPTER, 0.0)
    commands.request_messages(["mavros/local_position/pose"])
    assert not any(client.requests for client in node.clients.values())
    assert rejections.latest() == "arming refused: mavros_msgs is not installed: a pilot has to arm"
    assert len(node.warnings) == 3
    assert "a pilot has to set LAND" in node.warnings[0]
    assert "a pilot has to take off, and set the mode in the air" in node.warnings[1]


def test_the_package_is_found_and_one_of_another_kind_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mavros_msgs", None)
    assert mavros.load_messages() is None
    with pytest.raises(
        VehicleError, match="arming through MAVROS needs the package mavros_msgs; expected it"
    ):
        mavros.load_messages(needed_for="arming")
    package, messages, services = ModuleType("mavros_msgs"), ModuleType("msg"), ModuleType("srv")
    names = ("State", "ExtendedState", "SysStatus", "EstimatorStatus", "StatusText", "HomePosition")
    for name in (*names, "PositionTarget"):
        setattr(messages, name, Message)
    for name in ("SetMode", "CommandBool", "CommandTOL", "MessageInterval"):
        setattr(services, name, Service)
    for name, module in (("", package), (".msg", messages), (".srv", services)):
        monkeypatch.setitem(sys.modules, f"mavros_msgs{name}", module)
    assert mavros.load_messages(needed_for="arming") == (messages, services)
    del messages.SysStatus
    with pytest.raises(VehicleError, match=r"mavros_msgs has no SysStatus; expected"):
        mavros.load_messages()


# The stream.


def test_the_stream_keeps_its_pace_sends_news_at_once_and_ends_with_those_who_decide() -> None:
    sent: list[tuple[float, str]] = []
    stream: SetpointStream[str] = SetpointStream(
        lambda target: sent.append((time.monotonic(), target)), "test"
    )
    stream.start()
    time.sleep(0.2)
    assert not sent
    began_s = time.monotonic()
    stream.set_setpoint("a")
    time.sleep(0.33)
    before_s = time.monotonic()
    stream.set_setpoint("b")
    after_s = time.monotonic()
    time.sleep(STREAM_TIMEOUT_S + 2.0)
    of_a = [at_s for at_s, target in sent if target == "a"]
    of_b = [at_s for at_s, target in sent if target == "b"]
    assert np.median(np.diff(of_b)) == pytest.approx(0.05, abs=0.02)
    assert 1 <= len(of_a) <= (before_s - began_s) / 0.05 + 3
    assert before_s + STREAM_TIMEOUT_S - 1.0 < of_b[-1] < after_s + STREAM_TIMEOUT_S + 1.5
    stream.set_setpoint(None)
    time.sleep(0.05)
    count = len(sent)
    time.sleep(0.12)
    assert len(sent) == count
    stream.stop()
    stream.stop()
    assert not [thread for thread in threading.enumerate() if thread.name == "test"]


def test_a_stream_that_broke_is_not_believed_to_live() -> None:
    def send(target: str) -> None:
        raise RuntimeError("no such publisher")

    stream: SetpointStream[str] = SetpointStream(send, "test")
    stream.start()
    stream.set_setpoint("a")
    time.sleep(0.1)
    with pytest.raises(RuntimeError, match="no such publisher"):
        stream.set_setpoint("a")
    stream.stop()
