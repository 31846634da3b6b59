"""Messages into the core's arrays: whatever comes, an array or a MessageError."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from tests.conftest import outcome
from tests.nodes import poses
from tests.support.worlds import tiny
from uav_dc_ros import cdr, messages, payloads
from uav_dc_ros.errors import MessageError
from uav_dc_ros.nodes.ros import convert

ANY_NUMBER = st.floats(allow_nan=True, allow_infinity=True)
LATEST_NS = 2**31 * 10**9 - 1  # of a ROS time: its seconds have 32 bits
SCENARIO = tiny()


@given(st.binary(max_size=64))
@example(b"")
@example(b"\0\1\0\0")
@example(b"\0\1\0\0\0\0\0\0")
@example(b"\0\1\0\0\xff\xff\xff\xff")
@example(b"\0\0\0\0\0\0\0\2a\0")
def test_any_bytes_are_a_text_or_malformed(data: bytes) -> None:
    came = outcome(lambda: cdr.decode_string(data))
    if isinstance(came, MessageError):
        assert came.reason in ("malformed", "encapsulation")
    else:
        assert came in data


@given(st.text(st.characters(codec="utf-8", exclude_characters="\0")))
def test_a_text_is_serialised_as_ros_does(text: str) -> None:
    ours, theirs = cdr.encode_string(text.encode()), serialize_message(String(data=text))
    assert cdr.decode_string(theirs) == text.encode()
    assert deserialize_message(ours, String).data == text


@given(st.text(max_size=20), ANY_NUMBER, ANY_NUMBER, ANY_NUMBER)
@example("map", 1e308, -1e308, 5e-324)
def test_any_pose_is_a_position_or_refused(frame: str, x: float, y: float, z: float) -> None:
    message = poses.pose(np.asarray([x, y, z]), 0)
    message.header.frame_id = frame
    came = outcome(lambda: convert.position_m(message))
    if isinstance(came, MessageError):
        assert came.reason == ("frame" if frame != "map" else "not_finite")
        assert frame != "map" or not all(map(math.isfinite, (x, y, z)))
    else:
        assert frame == "map"
        assert came.tolist() == [x, y, z]


@given(st.integers(0, LATEST_NS))
def test_a_stamp_keeps_its_nanoseconds(time_ns: int) -> None:
    assert convert.stamp_ns(convert.stamp(time_ns)) == time_ns


@given(st.lists(st.integers(0, 3), max_size=6))
@pytest.mark.parametrize("convert_it", [payloads.users_m, payloads.collection])
def test_other_users_are_refused(convert_it: Callable[..., object], cluster: list[int]) -> None:
    zeros, no = [0.0] * len(cluster), [False] * len(cluster)
    users = messages.Users(mission=0, step=0, stamp_ns=0, cluster=cluster, x_m=zeros, y_m=zeros)
    numbers = {"sinr": zeros, "rate_bps": zeros, "data_bits": zeros, "served": no, "collected": no}
    rates = messages.Rates(mission=0, step=0, sum_rate_bps=0.0, **numbers)
    mine = SCENARIO.user_cluster.tolist()
    fits = cluster == mine if convert_it is payloads.users_m else len(cluster) == len(mine)
    payload = users if convert_it is payloads.users_m else rates
    if fits:
        convert_it(payload, SCENARIO)
    else:
        with pytest.raises(MessageError) as refused:
            convert_it(payload, SCENARIO)
        assert refused.value.reason == "layout"


@given(st.binary(max_size=100), st.integers(0, 100))
def test_any_bytes_are_a_pose_or_refused(junk: bytes, at: int) -> None:
    honest = cdr.encode_pose(np.asarray([1.0, 2.0, 3.0]), LATEST_NS)
    for data in (junk, honest[:at], honest[:at] + junk, honest[:at] + junk + honest[at + len(junk) :]):
        came = outcome(lambda data=data: cdr.Pose(data))
        if isinstance(came, MessageError):
            assert came.reason in ("malformed", "encapsulation", "frame", "not_finite")
        else:
            assert all(map(math.isfinite, came.position_m))
            assert len(came.body) == len(honest) - cdr.HEADER_BYTES


@given(st.integers(0, LATEST_NS), st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3))
def test_a_pose_is_serialised_as_ros_does(time_ns: int, position_m: tuple[float, float, float]) -> None:
    theirs = serialize_message(poses.pose(np.asarray(position_m), time_ns))
    assert cdr.encode_pose(np.asarray(position_m), time_ns) == theirs
    assert (cdr.Pose(theirs).stamp_ns, cdr.Pose(theirs).position_m) == (time_ns, position_m)
