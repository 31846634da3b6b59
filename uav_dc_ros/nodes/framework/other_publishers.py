"""Other nodes that publish a mission's exclusive topics: another mission, or a player of bags.

A payload names its run; a pose and a clock do not. So a mission does not begin beside such publishers.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from rclpy.node import Node

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.framework.node_table import NodeRow
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS


class AnotherMissionError(NodeError):
    """A mission cannot begin: other nodes publish its topics."""

    def __init__(self, description: str) -> None:
        super().__init__(
            f"{description}: give this one a namespace of its own (--namespace uav2), or a network (export "
            "ROS_DOMAIN_ID=1, or any number up to 101)"
        )


@dataclass(frozen=True, kw_only=True)
class OtherPublishers:
    """Publishers that do not belong to this mission: topics by full name of a node; false: there are none."""

    foreign: Mapping[str, Sequence[str]] = field(default_factory=dict)  # not in this mission's table
    doubles: Mapping[str, Sequence[str]] = field(default_factory=dict)  # in it, and in another mission, too

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.foreign or self.doubles)

    def description(self, run: str = "") -> str:
        """Names and topics of the publishers, in words; `run` is that of the messages received from them."""
        of_run = f" (run {run})" if run else ""
        if self.foreign:
            names = "; ".join(f"{name} publishes {', '.join(on)}" for name, on in self.foreign.items())
            return f"{names} here{of_run}, and is no node of this mission"
        by = f" by {', '.join(self.doubles)}" if self.doubles else ""
        return f"another mission is being flown here{by}{of_run}"


def find(
    publishers: Mapping[str, Sequence[str]],  # full names of their nodes, by topic, see `publishers`
    namespace: str,
    rows: Mapping[str, NodeRow],
    restarted: Collection[str] = (),  # nodes of which the graph may still list the killed ones
    absent: Collection[str] = (),  # nodes of the mission that do not publish yet
) -> OtherPublishers:
    """Find the publishers that do not belong to the mission of a namespace and a node table."""
    foreign: dict[str, list[str]] = {}
    doubles: dict[str, list[str]] = {}
    for topic, names in publishers.items():
        within = namespace.rstrip("/")
        own = {f"{within}/{row.name}": row.name for row in rows.values() if topic in row.publishes}
        if not own:
            continue  # no node of this mission publishes it, nor relies on it
        for name, count in Counter(names).items():
            if name not in own:
                foreign.setdefault(name, []).append(topic)
            elif count > (own[name] not in absent) and own[name] not in restarted:
                doubles.setdefault(name, []).append(topic)
    return OtherPublishers(foreign=foreign, doubles=doubles)


def publishers(node: Node) -> dict[str, list[str]]:
    """Full names of the publishers' nodes, one for each publisher, by exclusive topic, from the graph."""
    found = {}
    for topic in TOPICS.values():
        if topic.exclusive:
            names = map(qos.full_name, node.get_publishers_info_by_topic(topic.name))
            found[topic.name] = [name for name in names if qos.UNKNOWN not in name]
    return found
