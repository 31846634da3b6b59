"""Who else is there while a bag is played: subscribers, those that cannot hear, other publishers."""

from collections import defaultdict
from collections.abc import Collection, Iterator

from rclpy.node import Node

from uav_dc_ros.nodes.framework import other_publishers
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.play.playback_publisher import PlaybackPublisher
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS


class SubscriberMonitor:
    """Looks at the graph around some outlets.

    Args:
        node: that publishes.
        outlets: its outlets.
    """

    def __init__(self, node: Node, outlets: Collection[PlaybackPublisher]) -> None:
        self._node = node
        self._outlets = outlets
        self._told: set[tuple[str, str]] = set()

    def counts(self) -> dict[str, int]:
        """Number of subscribers that hear, by published topic."""
        return {outlet.name: outlet.publisher.get_subscription_count() for outlet in self._outlets}

    def subscribers(self, outlet: PlaybackPublisher) -> str:
        """Full names of the nodes that subscribe to an outlet's topic."""
        ends = self._node.get_subscriptions_info_by_topic(outlet.name)
        return ", ".join(sorted(f"{end.node_namespace.rstrip('/')}/{end.node_name}" for end in ends))

    def mission(self, also: Collection[str] = ()) -> str | None:
        """The mission that publishes an outlet's topic, and has to be the only one; None: there is none.

        Args:
            also: full names of topics that are published beside the outlets.
        """
        publishers: dict[str, dict[str, list[str]]] = defaultdict(dict)  # by namespace and relative name
        for name in sorted({*also, *(outlet.name for outlet in self._outlets)}):
            namespace, _, relative = name.rpartition("/")
            if relative in TOPICS and TOPICS[relative].exclusive:
                ends = self._node.get_publishers_info_by_topic(name)
                publishers[namespace][relative] = [qos.full_name(end) for end in ends]
        for namespace, ends_by_topic in publishers.items():
            found = other_publishers.find(ends_by_topic, namespace, NODES, absent=NODES)
            if found.doubles:
                return other_publishers.OtherPublishers(doubles=found.doubles).told()
        return None

    def others(self) -> Iterator[str]:
        """What is to be told of topics that somebody else publishes, too: two worlds at once help nobody."""
        names = [outlet.name for outlet in self._outlets]
        for name in dict.fromkeys(names):
            if self._node.count_publishers(name) > names.count(name):
                ends = self._node.get_publishers_info_by_topic(name)
                nodes = {f"{end.node_namespace.rstrip('/')}/{end.node_name}" for end in ends}
                others = sorted(nodes - {self._node.get_fully_qualified_name()})
                yield f"topic {name} is published by {', '.join(others) or 'another player'}, too"

    def deaf(self) -> Iterator[str]:
        """What is to be told of subscribers that cannot hear, of each once."""
        publishers = [outlet.publisher for outlet in self._outlets]
        for topic, peer, why in qos.incompatible(self._node, publishers, ()):
            if (topic, peer) not in self._told:
                self._told.add((topic, peer))
                yield f"{peer} does not hear {topic}: {why}"
