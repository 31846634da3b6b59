"""A recorded topic that is published again: its publisher, what it still has to deliver, what it repeats."""

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uav_dc_ros.bags.message_definitions import ENCODING
from uav_dc_ros.bags.read import BagMessage, RecordedTopic
from uav_dc_ros.bags.records import CDR
from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.ros import message_types, recorded_qos

AT_ONCE = Duration()


def message_class(topic: RecordedTopic) -> type:
    """The class of a topic's messages, from the installed ROS packages.

    Raises:
        NodeError: there is none, the messages have several types, or are not serialised as ROS 2 does.
    """
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
    """Publishes the messages of one recorded topic.

    Args:
        node: that has the publisher.
        name: full name of the topic to publish.
        topic: as recorded.
        message_bytes, per_s: of its messages, see `recorded_qos.profile`.

    Attributes:
        name: full name of the topic.
        publisher: of the topic.
        latched: does who joins late get its last messages?
        depth: so many messages, of those published last, are kept.

    Raises:
        BagError: its recorded QoS makes no sense.
        NodeError: its messages cannot be published here.
    """

    def __init__(
        self, node: Node, name: str, topic: RecordedTopic, *, message_bytes: int, per_s: float
    ) -> None:
        kind = message_class(topic)
        qos = recorded_qos.profile(topic, message_bytes=message_bytes, per_s=per_s)
        self.latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self.depth = qos.depth
        self.name = name
        self.publisher = node.create_publisher(
            kind, name, qos, event_callbacks=PublisherEventCallbacks(use_default_callbacks=False)
        )
        self._reliable = qos.reliability == ReliabilityPolicy.RELIABLE
        self._since_acknowledged = 0  # messages published since all were known to have arrived
        self._played: dict[tuple[int, int], None] = {}  # the last messages of a latched topic
        try:
            _same_definition(node, name, topic)
        except NodeError:
            node.destroy_publisher(self.publisher)
            raise

    def begin(self) -> None:
        """The bag is played from its beginning, once more."""
        self._played.clear()

    def repeats(self, message: BagMessage) -> bool:
        """Was this very message published before? It is taken for published from now on, in any case.

        A recorder that begins a file, or comes late, hears the last messages of latched topics once more.
        """
        if not self.latched or message.publish_time_ns <= 0:  # of another recorder, that does not tell it
            return False
        key = message.publish_time_ns, hash(message.data)
        if key in self._played:
            return True
        self._played[key] = None
        if len(self._played) > self.depth:
            del self._played[next(iter(self._played))]
        return False

    def has_room(self) -> bool:
        """Whether a message can be published without pushing out one that has not arrived everywhere.

        Publishing does not wait for slow subscribers, not even for reliable ones: the oldest message that is
        kept makes room for the newest, and whoever has not got it yet never will.
        """
        return self._since_acknowledged < self.depth or self.delivered()

    def delivered(self) -> bool:
        """Whether all that was published has arrived at every reliable subscriber."""
        if self._since_acknowledged and not self.publisher.wait_for_all_acked(AT_ONCE):
            return False
        self._since_acknowledged = 0
        return True

    def publish(self, data: bytes) -> None:
        """Publish a message, serialised."""
        self.publisher.publish(data)
        if self._reliable:
            self._since_acknowledged += 1


def _same_definition(node: Node, name: str, topic: RecordedTopic) -> None:
    """Compare what the bag says of a type with what is installed, as far as the bag says anything.

    Raises:
        NodeError: subscribers would read something else into the bytes.
    """
    if not topic.definition or topic.encoding != ENCODING:
        return
    try:
        types = get_typestore(Stores.EMPTY)
        types.register(get_types_from_msg(topic.definition.decode(), topic.type))
        recorded = types.hash_rihs01(topic.type)
    except Exception:  # of rosbags, all sorts: a definition that is damaged, or too new for it
        return
    ours = [end for end in node.get_publishers_info_by_topic(name) if end.node_name == node.get_name()]
    installed = {str(end.topic_type_hash) for end in ours if end.topic_type == topic.type}
    if installed and recorded not in installed:
        raise NodeError(f"type {topic.type} was recorded with another definition than the one installed")
