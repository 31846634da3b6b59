"""The mission's numbers as standard messages: read without this package's code, and equal to the payloads."""

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

from tests.nodes.conftest import Observed
from uav_dc_ros import cdr
from uav_dc_ros.nodes.ros import numeric_messages
from uav_dc_ros.nodes.view.rate_limiter import RateLimiter

STEP_S = 10.0  # of the small world
JAZZY = get_typestore(Stores.ROS2_JAZZY)


def read(data: bytes, kind: str) -> Any:
    """A message, by the definitions of ROS 2 itself."""
    return JAZZY.deserialize_cdr(data, kind)


def plotted(bag: Path, topic: str) -> tuple[list[float], list[float]]:
    """What a plotting tool draws of a topic: times and values, with mcap and rosbags alone."""
    times_s, values = [], []
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages(topics=[topic]):
            assert schema is not None
            times_s.append(message.log_time * 1e-9)
            values.append(JAZZY.deserialize_cdr(message.data, schema.name).data)
    return times_s, values


def is_within(values: list[float], all_values: list[float]) -> bool:
    """Whether the values are among all values, in the same order."""
    rest = iter(all_values)
    return all(value in rest for value in values)


def test_a_recorded_bag_is_plotted_without_this_package(observed: Observed) -> None:
    rates = [json.loads(text) for text in plotted(observed.bag, "/uav1/rates")[1]]  # type: ignore[arg-type]
    missions = [json.loads(text) for text in plotted(observed.bag, "/uav1/mission")[1]]  # type: ignore[arg-type]
    steps = {
        "sum_rate": [one["sum_rate_bps"] for one in rates],
        "users_collected": [sum(one["collected"]) for one in rates],
        "remaining_steps": [one["remaining_steps"] for one in missions],
    }
    for topic, expected in steps.items():
        times_s, values = plotted(observed.bag, f"/uav1/{topic}")
        assert len(values) >= len(expected) // 2, "ten steps a second are slower than the limit"
        assert is_within(values, expected)
        assert values[-1] == expected[-1]
        assert times_s == sorted(times_s)
        assert np.ptp(times_s) > 1.0


def test_the_odometry_is_the_pose_and_how_fast_it_moved(observed: Observed) -> None:
    (file,) = observed.bag.glob("*.mcap")
    with file.open("rb") as stream:
        read_all = list(make_reader(stream).iter_messages(topics=["/uav1/odom", "/uav1/pose"]))
    of: dict[str, list[Any]] = {"/uav1/odom": [], "/uav1/pose": []}
    for schema, channel, message in read_all:
        assert schema is not None
        of[channel.topic].append(read(message.data, schema.name))
    at = {one.header.stamp.sec: one.pose.position for one in of["/uav1/pose"]}
    odometry = of["/uav1/odom"]
    assert len(odometry) >= len(at) // 2
    for one in odometry:
        assert (one.header.frame_id, one.child_frame_id) == ("map", "base_link")
        assert one.pose.pose.position == at[one.header.stamp.sec]
    for before, one in itertools.pairwise(odometry):
        seconds = one.header.stamp.sec - before.header.stamp.sec
        moved_m = one.pose.pose.position.x - before.pose.pose.position.x
        assert one.twist.twist.linear.x == pytest.approx(moved_m / seconds)
        assert seconds >= STEP_S


def pose(position_m: tuple[float, float, float], seconds: float, yaw_rad: float = 0.0) -> cdr.Pose:
    body = bytearray(cdr.encode_pose(np.asarray(position_m), round(seconds * 1e9)))
    body[-32:] = np.array([0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)]).tobytes()
    return cdr.Pose(bytes(body))


@given(yaw_rad=st.floats(-math.pi, math.pi), east_m=st.floats(-99, 99), up_m=st.floats(-9, 9))
def test_the_velocity_is_that_of_the_body(yaw_rad: float, east_m: float, up_m: float) -> None:
    data = numeric_messages.odometry(pose((east_m, 0.0, up_m), 2.0, yaw_rad), pose((0.0, 0.0, 0.0), 0.0))
    linear = read(data, "nav_msgs/msg/Odometry").twist.twist.linear
    forward, left = math.cos(yaw_rad) * east_m / 2, -math.sin(yaw_rad) * east_m / 2
    assert (linear.x, linear.y, linear.z) == pytest.approx((forward, left, up_m / 2), abs=1e-9)


def test_a_pose_that_repeats_has_no_speed_and_one_without_rotation_faces_east() -> None:
    still = read(
        numeric_messages.odometry(pose((1, 2, 3), 5.0), pose((0, 0, 0), 5.0)), "nav_msgs/msg/Odometry"
    )
    assert still.twist.twist.linear.x == 0.0
    zeros = bytearray(cdr.encode_pose(np.asarray((1.0, 2.0, 3.0)), 0))
    zeros[-32:] = bytes(32)
    assert cdr.Pose(bytes(zeros)).orientation == (0.0, 0.0, 0.0, 1.0)


def test_what_is_not_known_is_nan_as_the_messages_define_it() -> None:
    charge = read(numeric_messages.battery(0.625, 7_000_000_009, 15.5), "sensor_msgs/msg/BatteryState")
    assert (charge.percentage, charge.voltage, charge.present) == (0.625, 15.5, True)
    assert (charge.header.stamp.sec, charge.header.stamp.nanosec) == (7, 9)
    assert all(map(math.isnan, (charge.current, charge.charge, charge.capacity, charge.temperature)))
    assert math.isnan(read(numeric_messages.battery(1.0, 0), "sensor_msgs/msg/BatteryState").voltage)
    fix = read(numeric_messages.fix(47.25, 8.5, 0), "sensor_msgs/msg/NavSatFix")
    assert (fix.latitude, fix.longitude, fix.status.status) == (47.25, 8.5, fix.status.STATUS_FIX)
    assert math.isnan(fix.altitude)
    assert fix.position_covariance_type == fix.COVARIANCE_TYPE_UNKNOWN


def test_the_transform_leads_from_the_map_to_the_body() -> None:
    (one,) = read(
        numeric_messages.transform(pose((1, 2, 3), 4.0, math.pi)), "tf2_msgs/msg/TFMessage"
    ).transforms
    assert (one.header.frame_id, one.child_frame_id, one.header.stamp.sec) == ("map", "base_link", 4)
    assert (one.transform.translation.x, one.transform.translation.z) == (1.0, 3.0)
    assert one.transform.rotation.z == pytest.approx(1.0)


@given(gaps_s=st.lists(st.floats(0, 0.3), max_size=60), rate_hz=st.sampled_from([0.0, 5.0, 20.0]))
def test_the_limit_holds_and_the_last_one_is_never_lost(gaps_s: list[float], rate_hz: float) -> None:
    now_s, acted = [100.0], list[tuple[float, int]]()
    requested = [0]
    limiter = RateLimiter(rate_hz, lambda _: acted.append((now_s[0], requested[0])), lambda: now_s[0])
    for gap_s in gaps_s:
        now_s[0] += gap_s
        requested[0] += 1
        limiter.request("a")
        limiter.flush()
    before_flush = list(acted)
    limiter.flush(at_once=True)
    if not rate_hz:
        assert acted == []
        return
    assert all(b[0] - a[0] >= 1 / rate_hz - 1e-9 for a, b in itertools.pairwise(before_flush))
    assert not gaps_s or acted[-1][1] == requested[0]
    assert [seen for _, seen in acted] == sorted({seen for _, seen in acted})
