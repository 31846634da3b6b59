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

ADVICE = (
    "give this one a namespace of its own (--namespace uav2), or a network (export ROS_DOMAIN_ID=1, or any "
    "number up to 101)"
)


class AnotherMissionError(NodeError):
    """A mission cannot begin: other nodes publish its topics."""

    def __init__(self, description: str) -> None:
        super().__init__(f"{description}: {ADVICE}")


@dataclass(frozen=True, kw_only=True)
class OtherPublishers:
    """Publishers that do not belong to this mission; false if there are none.

    Attributes:
        foreign: topics by full name of a node that is not in this mission's table.
        doubles: topics by full name of a node of the table that another mission has, too.
    """

    foreign: Mapping[str, Sequence[str]] = field(default_factory=dict)
    doubles: Mapping[str, Sequence[str]] = field(default_factory=dict)

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
    publishers: Mapping[str, Sequence[str]],
    namespace: str,
    rows: Mapping[str, NodeRow],
    restarted: Collection[str] = (),
    absent: Collection[str] = (),
) -> OtherPublishers:
    """Find the publishers that do not belong to a mission.

    Args:
        publishers: full names of the publishers' nodes, by topic, see `publishers`.
        namespace: of the mission.
        rows: the node table of the mission.
        restarted: nodes that were restarted: the graph may still list the killed ones.
        absent: nodes of the mission that do not publish yet.
    """
    foreign: dict[str, list[str]] = {}
    doubles: dict[str, list[str]] = {}
    for topic, names in publishers.items():
        own = {
            f"{namespace.rstrip('/')}/{row.name}": row.name for row in rows.values() if topic in row.publishes
        }
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
    return {
        topic.name: [
            name
            for end in node.get_publishers_info_by_topic(topic.name)
            if qos.UNKNOWN not in (name := qos.full_name(end))
        ]
        for topic in TOPICS.values()
        if topic.exclusive
    }
