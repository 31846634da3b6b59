"""QoS as bags have it: that of a publisher, to be recorded, and that with which a topic is published again.

A bag tells the QoS of each publisher that its recorder saw, but not which message was whose. One publisher
stands for all of them, and offers the most that any of them did: each subscription that heard at least one
of them hears it. (rosbag2 falls back to reliable and volatile where they differ, so that nobody who joins
late learns what was latched.)
"""

import math
from collections.abc import Sequence

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from uav_dc_ros.bags.read import RecordedTopic
from uav_dc_ros.errors import BagError
from uav_dc_ros.nodes.ros.qos import HISTORY_BYTES, HISTORY_LEAST

# Depth of a publisher whose own one is not known, as most recorders leave it: discovery does not carry it.
UNKNOWN_DEPTH = 10  # rosbag2's
# What is not acknowledged yet has to be kept. Fast DDS acknowledges after 5 ms, or a little later; with 1000
# messages half as many arrived in a second as with so many.
WINDOW = 5000
ACKNOWLEDGE_S = 0.02
_FOREVER = QosTime(9223372036, 854775807)  # how ROS 2 writes an infinite duration
_FOREVER_NS = 2**63 - 1
FOREVER_S = 2**31 - 1  # and more: what recorders write for "no limit"; so is 0


def offered(profile: QoSProfile, depth: int | None = None) -> Qos:
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


def profile(topic: RecordedTopic, *, message_bytes: int, per_s: float) -> QoSProfile:
    """The QoS to offer.

    A latched topic keeps as many messages as its publishers did together, so that a late subscriber gets no
    more and no fewer; unless so many are published before they can be acknowledged. One that is not latched
    keeps enough for subscribers that fall behind.

    Args:
        topic: as recorded.
        message_bytes: about how large its messages are: of large ones fewer are kept.
        per_s: messages that are to be published in a second; infinite: as many as can be.

    Raises:
        BagError: the bag tells it in a way that rosbag2 does not.
    """
    try:
        offers = parse_qos(topic.offered_qos)
    except (ReaderError, KeyError, TypeError, AttributeError):
        raise BagError(
            f"QoS of topic {topic.name} is {topic.offered_qos!r}; expected rosbag2's YAML"
        ) from None
    fitting = max(HISTORY_LEAST, HISTORY_BYTES // max(1, message_bytes))
    latched = [offer for offer in offers if offer.durability == QosDurability.TRANSIENT_LOCAL]
    if latched:
        depth = max(sum(map(_depth, latched)), math.ceil(min(WINDOW, per_s * ACKNOWLEDGE_S)))
    else:
        depth = max(WINDOW, *map(_depth, offers), 0)
    only_best_effort = offers and all(offer.reliability == QosReliability.BEST_EFFORT for offer in offers)
    made = QoSProfile(
        depth=max(1, min(depth, fitting)),
        reliability=ReliabilityPolicy.BEST_EFFORT if only_best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        avoid_ros_namespace_conventions=any(offer.avoid_ros_namespace_conventions for offer in offers),
    )
    if any(offer.liveliness == QosLiveliness.MANUAL_BY_TOPIC for offer in offers):
        made.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    _set_times(made, offers)
    return made


def _depth(offer: Qos) -> int:
    if offer.history == QosHistory.KEEP_ALL:
        return WINDOW
    return offer.depth if offer.history == QosHistory.KEEP_LAST and offer.depth > 0 else UNKNOWN_DEPTH


def _set_times(made: QoSProfile, offers: Sequence[Qos]) -> None:
    """The strictest promise of how often it speaks, and the longest life of its messages."""
    deadlines = [ns for offer in offers if (ns := _limit_ns(offer.deadline))]
    leases = [ns for offer in offers if (ns := _limit_ns(offer.liveliness_lease_duration))]
    lives = [_limit_ns(offer.lifespan) for offer in offers]
    if deadlines:
        made.deadline = Duration(nanoseconds=min(deadlines))
    if leases:
        made.liveliness_lease_duration = Duration(nanoseconds=min(leases))
    if lives and all(lives):
        made.lifespan = Duration(nanoseconds=max(lives))


def _limit_ns(time: QosTime) -> int:
    """A duration in nanoseconds; 0 for one without limit."""
    return 0 if time.sec >= FOREVER_S else time.sec * 10**9 + time.nsec
