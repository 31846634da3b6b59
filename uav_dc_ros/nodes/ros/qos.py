"""Quality of service: profiles from the topic table, endpoints, and peers that do not match them."""

import copy
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.duration import Duration, Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64, Int32, String
from visualization_msgs.msg import MarkerArray

from uav_dc_ros import topics
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.ros import message_types
from uav_dc_ros.topics import Topic

MESSAGE_TYPES: dict[str, type] = {
    topics.JSON: String,
    topics.POSE: PoseStamped,
    topics.PATH: Path,
    topics.MARKERS: MarkerArray,
    topics.DIAGNOSTICS: DiagnosticArray,
    topics.CLOCK: Clock,
    topics.FLOAT: Float64,
    topics.INTEGER: Int32,
    topics.ODOMETRY: Odometry,
}
NEWEST = 100  # depth of a subscription: a burst of invalid messages must not displace a valid one
HISTORY_BYTES = 64 * 2**20  # that a publisher keeps of one topic for late subscribers
HISTORY_MIN = 10  # messages, however large
UNKNOWN = "UNKNOWN_"  # in a name that the graph does not know yet
OVERRIDES = QoSOverridingOptions(
    [QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY]
)


def message_class(topic: Topic) -> Any:
    """The Python class of a topic's messages; None if their package is not installed."""
    return MESSAGE_TYPES.get(topic.type) or message_types.find(topic.type)  # rare ones take time to import


def offered(topic: Topic, message_bytes: int = 0) -> QoSProfile:
    """The QoS that a topic's publisher offers; the larger its messages, the fewer it keeps."""
    fitting = HISTORY_BYTES // message_bytes if message_bytes else topic.depth
    return QoSProfile(
        depth=min(topic.depth, max(fitting, HISTORY_MIN)),
        reliability=ReliabilityPolicy.RELIABLE if topic.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
        **({} if topic.lease_s is None else {"liveliness_lease_duration": Duration(seconds=topic.lease_s)}),
    )


def requested(topic: Topic, *, keep_all: bool) -> QoSProfile:
    """The QoS that a subscription requests; `keep_all` as in the node table's `keeps_all`."""
    profile = offered(replace(topic, lease_s=None))  # a lease would not match publishers without one
    profile.depth = NEWEST
    if not topic.requests_reliable:
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if keep_all:
        profile.history = HistoryPolicy.KEEP_ALL
    return profile


def create_publisher(node: Node, kind: Any, name: str, profile: QoSProfile, **options: Any) -> Publisher:
    """Create a publisher without event callbacks: see `DirectExecutor`."""
    events = PublisherEventCallbacks(use_default_callbacks=False)
    return node.create_publisher(kind, name, profile, event_callbacks=events, **options)


def create_subscription(
    node: Node, kind: Any, name: str, callback: Any, profile: QoSProfile, *, raw: bool = True, **options: Any
) -> Any:
    """Create a subscription without event callbacks. A callback with a second parameter takes the info."""
    events = SubscriptionEventCallbacks(use_default_callbacks=False)
    return node.create_subscription(kind, name, callback, profile, event_callbacks=events, raw=raw, **options)


@contextmanager
def overridable(topic: str) -> Iterator[dict[str, Any]]:
    """Options to create an endpoint with overridable QoS; raises ParameterError for an invalid override."""
    try:
        yield {"qos_overriding_options": OVERRIDES}
    except (RuntimeError, InvalidParameterTypeException) as error:
        raise ParameterError(f"qos_overrides of {topic}: {error}") from None


def incompatible(
    node: Node, publishers: Iterable[Publisher], subscriptions: Iterable[Subscription]
) -> Iterator[tuple[str, str, str]]:
    """Peers that do not match: topic, the peer's full name, what does not match (type or QoS).

    The middleware reports that some peer does not match, and which policy; only the graph knows which peer.
    """
    for publisher in publishers:
        if node.count_subscribers(publisher.topic_name) != publisher.get_subscription_count():
            for end in node.get_subscriptions_info_by_topic(publisher.topic_name):
                yield from _mismatch(publisher, end, _in_graph(publisher.qos_profile), end.qos_profile)
    for subscription in subscriptions:
        if node.count_publishers(subscription.topic_name) != subscription.get_publisher_count():
            for end in node.get_publishers_info_by_topic(subscription.topic_name):
                yield from _mismatch(subscription, end, end.qos_profile, _in_graph(subscription.qos_profile))


def full_name(end: TopicEndpointInfo) -> str:
    """Full name of an endpoint's node."""
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def _in_graph(profile: QoSProfile) -> QoSProfile:
    """A profile as in the graph, where a duration of zero (none) is infinite."""
    profile = copy.copy(profile)
    for name in ("deadline", "lifespan", "liveliness_lease_duration"):
        if getattr(profile, name) == Duration():
            setattr(profile, name, Infinite)
    return profile


def _mismatch(
    endpoint: Publisher | Subscription, peer: TopicEndpointInfo, offer: QoSProfile, request: QoSProfile
) -> Iterator[tuple[str, str, str]]:
    name = full_name(peer)
    if UNKNOWN in name:
        return  # discovered a moment ago: its name follows
    message_class: Any = endpoint.msg_type
    package, namespace, *_ = message_class.__module__.split(".")
    kind = f"{package}/{namespace}/{message_class.__name__}"  # such as std_msgs/msg/String
    if peer.topic_type != kind:
        yield endpoint.topic_name, name, f"its type is {peer.topic_type}; expected {kind}"
        return
    compatibility, reason = qos_check_compatible(offer, request)
    if compatibility == QoSCompatibility.ERROR:
        yield endpoint.topic_name, name, f"its QoS: {reason.removeprefix('ERROR: ')}"
