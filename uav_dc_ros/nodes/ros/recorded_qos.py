"""QoS in bags: that of recorded publishers, and that with which a topic is published again.

A bag has the QoS of each publisher that its recorder found, but not which message was whose. One publisher
replaces them all, and offers the most of any of them: it matches each subscription that matched one of them.
(rosbag2 falls back to reliable and volatile where they differ, so that late subscribers miss latched ones.)
"""

import math

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from uav_dc_ros.bags.read import RecordedTopic
from uav_dc_ros.errors import BagError
from uav_dc_ros.nodes.ros.qos import HISTORY_BYTES, HISTORY_MIN

UNKNOWN_DEPTH = 10  # rosbag2's, for a publisher's depth, which discovery does not carry
# Messages kept until they are acknowledged, which Fast DDS does after 5 ms or a little more: with 1000 the
# throughput was half of this.
WINDOW = 5000
ACKNOWLEDGE_S = 0.02
_FOREVER = QosTime(9223372036, 854775807)  # how ROS 2 writes an infinite duration
_FOREVER_NS = 2**63 - 1
FOREVER_S = 2**31 - 1  # and more: what recorders write for "no limit"; so is 0


def offered(profile: QoSProfile, depth: int | None = None) -> Qos:
    """A publisher's QoS as a bag stores it, from its profile in the graph; depth None: not known."""
    manual = profile.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC
    return Qos(
        history=QosHistory.UNKNOWN if depth is None else QosHistory.KEEP_LAST,
        depth=depth or 0,
        reliability=QosReliability[profile.reliability.name],
        durability=QosDurability[profile.durability.name],
        deadline=_qos_time(profile.deadline),
        lifespan=_qos_time(profile.lifespan),
        liveliness=QosLiveliness.MANUAL_BY_TOPIC if manual else QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_qos_time(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def _qos_time(duration: Duration) -> QosTime:
    """A duration; 0 (none) is infinite."""
    limited = 0 < duration.nanoseconds < _FOREVER_NS
    return QosTime(*divmod(duration.nanoseconds, 10**9)) if limited else _FOREVER


def profile(topic: RecordedTopic, *, message_bytes: int, per_s: float) -> QoSProfile:
    """The QoS to offer when a topic is played.

    A latched topic keeps as many messages as its publishers did together, so that a late subscriber gets no
    more and no fewer, unless the rate needs more until they are acknowledged. Any other keeps enough for slow
    subscribers. The deadline and the lease are the strictest, the lifespan the longest of the publishers.

    The larger its messages (about `message_bytes`), the fewer are kept. `per_s`: messages to be published in
    a second; infinite: as many as possible. Raises BagError if its QoS is not in rosbag2's format.
    """
    try:
        offers = parse_qos(topic.offered_qos)
    except (ReaderError, KeyError, TypeError, AttributeError):
        raise BagError(
            f"QoS of topic {topic.name} is {topic.offered_qos!r}; expected rosbag2's YAML"
        ) from None
    fitting = max(HISTORY_MIN, HISTORY_BYTES // max(1, message_bytes))
    latched = [offer for offer in offers if offer.durability == QosDurability.TRANSIENT_LOCAL]
    if latched:
        depth = max(sum(map(_depth, latched)), math.ceil(min(WINDOW, per_s * ACKNOWLEDGE_S)))
    else:
        depth = max(WINDOW, *map(_depth, offers), 0)
    only_best_effort = offers and all(offer.reliability == QosReliability.BEST_EFFORT for offer in offers)
    result = QoSProfile(
        depth=max(1, min(depth, fitting)),
        reliability=ReliabilityPolicy.BEST_EFFORT if only_best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        avoid_ros_namespace_conventions=any(offer.avoid_ros_namespace_conventions for offer in offers),
    )
    if any(offer.liveliness == QosLiveliness.MANUAL_BY_TOPIC for offer in offers):
        result.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    if deadlines := [ns for offer in offers if (ns := _limit_ns(offer.deadline))]:
        result.deadline = Duration(nanoseconds=min(deadlines))
    if leases := [ns for offer in offers if (ns := _limit_ns(offer.liveliness_lease_duration))]:
        result.liveliness_lease_duration = Duration(nanoseconds=min(leases))
    lifespans = [_limit_ns(offer.lifespan) for offer in offers]
    if lifespans and all(lifespans):
        result.lifespan = Duration(nanoseconds=max(lifespans))
    return result


def _depth(offer: Qos) -> int:
    if offer.history == QosHistory.KEEP_ALL:
        return WINDOW
    return offer.depth if offer.history == QosHistory.KEEP_LAST and offer.depth > 0 else UNKNOWN_DEPTH


def _limit_ns(time: QosTime) -> int:
    """A duration in nanoseconds; 0: no limit."""
    return 0 if time.sec >= FOREVER_S else time.sec * 10**9 + time.nsec
