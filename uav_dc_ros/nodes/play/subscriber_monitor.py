"""Subscribers and other publishers of the topics of a playback."""

from collections import defaultdict
from collections.abc import Collection, Iterator

from rclpy.node import Node

from uav_dc_ros.nodes.framework import other_publishers
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.play.playback_publisher import PlaybackPublisher
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS


class SubscriberMonitor:
    """Queries the ROS graph for the peers of playback publishers."""

    def __init__(self, node: Node, publishers: Collection[PlaybackPublisher]) -> None:
        self._node = node
        self._publishers = publishers
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
