"""Who else publishes what a mission has one publisher of: another mission, or a player of bags.

A payload says which run it belongs to; a pose and a clock do not. So a mission does not begin where somebody
else publishes them, and tells who does.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from rclpy.node import Node

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.framework.node_table import NodeRow
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS

ADVICE = (
    "give this one a namespace of its own (--namespace uav2), or a network (export ROS_DOMAIN_ID=1, or any "
    "number up to 101)"
)


class AnotherMissionError(NodeError):
    """A mission cannot begin where somebody else publishes its topics."""

    def __init__(self, told: str) -> None:
        super().__init__(f"{told}: {ADVICE}")


@dataclass(frozen=True, kw_only=True)
class OtherPublishers:
    """Publishers that do not belong to this mission.

    Attributes:
        foreign: topics by full name of a node that no mission of this namespace has.
        doubles: topics by full name of a node that another mission has, too.
    """

    foreign: Mapping[str, Sequence[str]] = field(default_factory=dict)
    doubles: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Is there any."""
        return bool(self.foreign or self.doubles)

    def told(self, run: str = "") -> str:
        """Who publishes what, in words; `run` is that of the messages received, where there were any."""
        of_run = f" (run {run})" if run else ""
        told = [f"{name} publishes {', '.join(on)}" for name, on in self.foreign.items()]
        if told:
            return f"{'; '.join(told)} here{of_run}, and is no node of this mission"
        by = f" by {', '.join(self.doubles)}" if self.doubles else ""
        return f"another mission is being flown here{by}{of_run}"


def find(
    publishers: Mapping[str, Sequence[str]],
    namespace: str,
    rows: Mapping[str, NodeRow],
    restarted: Collection[str] = (),
    absent: Collection[str] = (),
) -> OtherPublishers:
    """Rivals among the publishers of exclusive topics.

    Args:
        publishers: full names of the nodes behind the publishers, one for each, by topic.
        namespace: of the mission.
        rows: the node table, as it is in this mission.
        absent: nodes of this mission that do not publish yet.
        restarted: nodes that were started again: of those that were killed the graph may still tell.
    """
    foreign: dict[str, list[str]] = {}
    doubles: dict[str, list[str]] = {}
    for topic, names in publishers.items():
        ours = {
            f"{namespace.rstrip('/')}/{row.name}": row.name for row in rows.values() if topic in row.publishes
        }
        if not ours:
            continue  # nobody publishes it in this mission, nor trusts it
        for name, count in Counter(names).items():
            if name not in ours:
                foreign.setdefault(name, []).append(topic)
            elif count > (ours[name] not in absent) and ours[name] not in restarted:
                doubles.setdefault(name, []).append(topic)
    return OtherPublishers(foreign=foreign, doubles=doubles)


def publishers(node: Node) -> dict[str, list[str]]:
    """Full names of the nodes behind the publishers of exclusive topics, as the graph tells now."""
    return {
        topic.name: [
            name
            for end in node.get_publishers_info_by_topic(topic.name)
            if qos.UNKNOWN not in (name := qos.full_name(end))
        ]
        for topic in TOPICS.values()
        if topic.exclusive
    }
