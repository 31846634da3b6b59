"""The publishers of a playback, one for each recorded topic, and the subscribers and publishers they meet."""

from collections import defaultdict
from collections.abc import Collection, Iterator

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uav_dc_ros.bags.message_definitions import ENCODING
from uav_dc_ros.bags.read import BagMessage, RecordedTopic
from uav_dc_ros.bags.records import CDR
from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.framework import other_publishers
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.ros import message_types, qos, recorded_qos
from uav_dc_ros.topics import TOPICS

NO_WAIT = Duration()


def message_class(topic: RecordedTopic) -> type:
    """The class of a topic's messages, from the installed ROS packages; raises NodeError without one."""
    if topic.serialization != CDR:
        raise NodeError(f"its messages are in {topic.serialization!r}; expected {CDR!r}")
    if topic.other_types:
        raise NodeError(f"it has several types: {', '.join((topic.type, *topic.other_types))}; expected one")
    if message_types.NAME.fullmatch(topic.type) is None:
        raise NodeError(f"type {topic.type!r} is no message; expected PACKAGE/msg/NAME")
    found: type | None = message_types.find(topic.type)
    if found is None:
        package = topic.type.partition("/")[0]
        raise NodeError(f"type {topic.type} is not installed; expected a ROS package {package}")
    return found


class PlaybackPublisher:
    """Publishes the messages of one recorded topic; tracks acknowledgements and repeated messages.

    `message_bytes` and `per_s` are their size and rate, see `recorded_qos.profile`. Raises BagError for an
    invalid recorded QoS, and NodeError if the messages cannot be published here.
    """

    def __init__(
        self, node: Node, name: str, topic: RecordedTopic, *, message_bytes: int, per_s: float
    ) -> None:
        kind = message_class(topic)
        profile = recorded_qos.profile(topic, message_bytes=message_bytes, per_s=per_s)
        self.latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self.depth = profile.depth  # number of messages in its history
        self.name = name
        self.publisher = qos.create_publisher(node, kind, name, profile)
        self._reliable = profile.reliability == ReliabilityPolicy.RELIABLE
        self._unacknowledged = 0  # messages
        self._published: dict[tuple[int, int], None] = {}  # the last messages of a latched topic
        try:
            _check_definition(node, name, topic)
        except NodeError:
            node.destroy_publisher(self.publisher)
            raise

    def restart(self) -> None:
        """Forget published messages, for another pass through the bag."""
        self._published.clear()

    def is_repeated(self, message: BagMessage) -> bool:
        """Whether this latched message was published before; registers it as published.

        A recorder that starts a new file, or starts late, receives the last latched messages again.
        """
        if not self.latched or message.publish_time_ns <= 0:  # other recorders may lack a publish time
            return False
        key = message.publish_time_ns, hash(message.data)
        if key in self._published:
            return True
        self._published[key] = None
        if len(self._published) > self.depth:
            del self._published[next(iter(self._published))]
        return False

    def has_room(self) -> bool:
        """Whether publishing keeps all unacknowledged messages in the history.

        Publishing never blocks: a full history drops its oldest message, even for reliable subscribers.
        """
        return self._unacknowledged < self.depth or self.is_acknowledged()

    def is_acknowledged(self) -> bool:
        """Whether all reliable subscribers have acknowledged all messages."""
        if self._unacknowledged and not self.publisher.wait_for_all_acked(NO_WAIT):
            return False
        self._unacknowledged = 0
        return True

    def publish(self, data: bytes) -> None:
        """Publish a serialized message."""
        self.publisher.publish(data)
        self._unacknowledged += self._reliable


def _check_definition(node: Node, name: str, topic: RecordedTopic) -> None:
    """Raise NodeError if the recorded definition of a type differs from the installed one."""
    if not topic.definition or topic.encoding != ENCODING:
        return
    try:
        types = get_typestore(Stores.EMPTY)
        types.register(get_types_from_msg(topic.definition.decode(), topic.type))
        recorded = types.hash_rihs01(topic.type)
    except Exception:  # rosbags raises many kinds: the definition is damaged, or unsupported
        return
    ours = [end for end in node.get_publishers_info_by_topic(name) if end.node_name == node.get_name()]
    installed = {str(end.topic_type_hash) for end in ours if end.topic_type == topic.type}
    if installed and recorded not in installed:
        raise NodeError(f"type {topic.type} was recorded with another definition than the one installed")


class SubscriberMonitor:
    """Queries the ROS graph for the peers of playback publishers."""

    def __init__(self, node: Node, publishers: Collection[PlaybackPublisher]) -> None:
        self._node, self._publishers = node, publishers
        self._reported: set[tuple[str, str]] = set()

    def counts(self) -> dict[str, int]:
        """Number of matched subscriptions, by published topic."""
        return {each.name: each.publisher.get_subscription_count() for each in self._publishers}

    def subscribers(self, topic: str) -> str:
        """Full names of the nodes that subscribe to a topic."""
        ends = self._node.get_subscriptions_info_by_topic(topic)
        return ", ".join(sorted(qos.full_name(end) for end in ends))

    def mission(self, also: Collection[str] = ()) -> str | None:
        """Description of a mission that publishes a played exclusive topic, or one of `also`; else None."""
        publishers: dict[str, dict[str, list[str]]] = defaultdict(dict)  # by namespace and relative name
        for name in sorted({*also, *(each.name for each in self._publishers)}):
            namespace, _, relative = name.rpartition("/")
            if relative in TOPICS and TOPICS[relative].exclusive:
                ends = self._node.get_publishers_info_by_topic(name)
                publishers[namespace][relative] = [qos.full_name(end) for end in ends]
        for namespace, ends_by_topic in publishers.items():
            found = other_publishers.find(ends_by_topic, namespace, NODES, absent=NODES)
            if found.doubles:
                return other_publishers.OtherPublishers(doubles=found.doubles).description()
        return None

    def competing_publishers(self) -> Iterator[str]:
        """A note for each played topic that another node publishes."""
        names = [each.name for each in self._publishers]
        for name in dict.fromkeys(names):
            if self._node.count_publishers(name) > names.count(name):
                nodes = {qos.full_name(end) for end in self._node.get_publishers_info_by_topic(name)}
                others = sorted(nodes - {self._node.get_fully_qualified_name()})
                yield f"topic {name} is also published by {', '.join(others) or 'another player'}"

    def incompatible_subscribers(self) -> Iterator[str]:
        """A note for each subscriber with an incompatible type or QoS, once each."""
        publishers = [each.publisher for each in self._publishers]
        for topic, peer, reason in qos.incompatible(self._node, publishers, ()):
            if (topic, peer) not in self._reported:
                self._reported.add((topic, peer))
                yield f"{peer} receives nothing on {topic}: {reason}"
