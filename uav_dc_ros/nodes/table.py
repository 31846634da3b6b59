"""The nodes, one row each: the only list. Topics are those of `topics.TOPICS`."""

from dataclasses import dataclass

from uav_dc_ros.topics import TOPICS


@dataclass(frozen=True, kw_only=True)
class NodeRow:
    """A node.

    Attributes:
        name: its name in the ROS graph.
        publishes, subscribes: names of topics.
        hears_all: does it keep every message until it gets to it, or the newest hundred?
        process: is it a process of its own, `python -m uav_dc_ros.nodes.NAME`?
        stop_rank: run_all stops nodes of a lower rank first: the recorder must still hear the last word of
            all others.
    """

    name: str
    publishes: tuple[str, ...]
    subscribes: tuple[str, ...]
    hears_all: bool = False
    process: bool = True
    stop_rank: int = 0


NODES: dict[str, NodeRow] = {
    row.name: row
    for row in (
        NodeRow(
            name="world",
            publishes=("pose", "users", "mission", "target"),
            subscribes=("move", "ready"),
        ),
        NodeRow(
            name="channel_monitor",
            publishes=("rates", "ready"),
            subscribes=("pose", "users"),
        ),
        NodeRow(
            name="policy",
            publishes=("move", "ready"),
            subscribes=("mission", "rates"),
        ),
        NodeRow(
            name="recorder",
            publishes=("ready",),
            subscribes=tuple(topic.name for topic in TOPICS.values() if topic.recorded),
            hears_all=True,
            stop_rank=1,
        ),
        NodeRow(
            name="observer",
            publishes=("ready",),
            subscribes=("mission", "rates"),
            hears_all=True,
            process=False,
        ),
    )
}
