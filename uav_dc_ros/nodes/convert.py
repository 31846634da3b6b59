"""ROS messages to and from plain values: times, positions, QoS."""

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.qos import LivelinessPolicy, QoSProfile
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosgraph_msgs.msg import Clock

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import MessageError

FRAME = "map"  # ENU, as everywhere in this project
_FOREVER = QosTime(9223372036, 854775807)  # how ROS 2 writes an infinite duration
_FOREVER_NS = 2**63 - 1


def clock(time_ns: int) -> Clock:
    """A time, nanoseconds, as a message for `clock`."""
    return Clock(clock=stamp(time_ns))


def stamp(stamp_ns: int) -> Time:
    """Nanoseconds as a ROS time."""
    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def stamp_ns(time: Time) -> int:
    """A ROS time in nanoseconds."""
    return int(time.sec) * 10**9 + int(time.nanosec)


def position_m(message: PoseStamped) -> Array:
    """Position x, y, altitude, metres, `[3]`.

    Raises:
        MessageError: another frame than `map`, or a position that is not finite.
    """
    if message.header.frame_id != FRAME:
        raise MessageError("frame", f"frame {message.header.frame_id[:64]!r}; expected {FRAME!r}")
    point = message.pose.position
    position = np.asarray([point.x, point.y, point.z], dtype=np.float64)
    if not np.isfinite(position).all():
        raise MessageError("not_finite", f"position {position.tolist()}; expected finite metres")
    return position


def offered_qos(profile: QoSProfile, depth: int | None = None) -> Qos:
    """The QoS that a publisher offers, as a bag stores it.

    Args:
        profile: as the graph tells it.
        depth: messages that the publisher keeps, which discovery does not carry; None: not known.
    """
    return Qos(
        history=QosHistory.UNKNOWN if depth is None else QosHistory.KEEP_LAST,
        depth=depth or 0,
        reliability=QosReliability[profile.reliability.name],
        durability=QosDurability[profile.durability.name],
        deadline=_qos_time(profile.deadline),
        lifespan=_qos_time(profile.lifespan),
        liveliness=(
            QosLiveliness.MANUAL_BY_TOPIC
            if profile.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC
            else QosLiveliness.AUTOMATIC
        ),
        liveliness_lease_duration=_qos_time(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def _qos_time(duration: Duration) -> QosTime:
    """A duration; 0 stands for none given, which is an infinite one."""
    given = 0 < duration.nanoseconds < _FOREVER_NS
    return QosTime(*divmod(duration.nanoseconds, 10**9)) if given else _FOREVER
