"""ROS messages to and from plain values: times and positions."""

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped

from uav_dc_ros import cdr
from uav_dc_ros.core.arrays import Array


def stamp(stamp_ns: int) -> Time:
    """Nanoseconds as a ROS time."""
    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def stamp_ns(time: Time) -> int:
    """A ROS time in nanoseconds."""
    return int(time.sec) * 10**9 + int(time.nanosec)


def position_m(message: PoseStamped) -> Array:
    """Position x, y, altitude, metres, `[3]`; MessageError: not in frame `map`, or not finite."""
    point = message.pose.position
    position = point.x, point.y, point.z
    cdr.check_position(message.header.frame_id, position)
    return np.asarray(position, dtype=np.float64)
