"""Poses as message objects: what the nodes write and read serialised must be these."""

from collections.abc import Sequence

from geometry_msgs.msg import PoseStamped

from uav_dc_ros.cdr import FRAME
from uav_dc_ros.nodes.ros.convert import stamp


def pose(position_m: Sequence[float], time_ns: int) -> PoseStamped:
    """A position (x, y, altitude, metres) as a level pose in the frame `map`."""
    message = PoseStamped()
    message.header.frame_id = FRAME
    message.header.stamp = stamp(time_ns)
    point = message.pose.position
    point.x, point.y, point.z = (float(value) for value in position_m)
    message.pose.orientation.w = 1.0
    return message
