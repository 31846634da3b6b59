"""The nodes, one row each: the only list. Topics are those of `topics.TOPICS`. Knows no ROS."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from uav_dc_ros.nodes.framework import bridge_parameters
from uav_dc_ros.nodes.framework import parameters as p
from uav_dc_ros.topics import TOPICS


@dataclass(frozen=True, kw_only=True)
class NodeRow:
    """A node.

    Attributes:
        name: its name in the ROS graph.
        publishes, subscribes: names of topics.
        parameters: its own, beside those that every node has.
        hears_all: does it keep every message until it gets to it, or the newest hundred?
        process: is it a process of its own, `python -m uav_dc_ros.nodes.NAME`?
        composable: may it share a process with others (see `container`)? Those may that wait for one another
            in every step.
        rank: nodes of a lower rank are brought up first, and taken down last: the recorder must hear the
            first word and the last, and the world starts the mission.
        restarts: how often a node that died is started again within `supervisor.RESTART_WINDOW_S`; once more
            ends the mission, or, if the node is not needed for it, the restarts.
        hang_s: how long its process may give no sign of life, once it is active, before it is killed and
            started again: longer than any of its callbacks takes on a busy computer.
        needed: can no mission be flown without it? A bridge, not without one where the vehicle is a real one.
        on_request: is it started only when it is asked for?
        again: parameters with which it is restarted, beside those that it had.
    """

    name: str
    publishes: tuple[str, ...]
    subscribes: tuple[str, ...]
    parameters: tuple[p.Parameter, ...] = ()
    hears_all: bool = False
    process: bool = True
    composable: bool = False
    rank: int = 1
    restarts: int = 3
    hang_s: float = 5.0
    needed: bool = True
    on_request: bool = False
    again: Mapping[str, object] = field(default_factory=dict)


NODES: dict[str, NodeRow] = {
    row.name: row
    for row in (
        NodeRow(
            name="world",
            publishes=("pose", "users", "mission", "target", "diagnostics", "clock"),
            subscribes=("move", "ready"),
            parameters=(p.SCENARIO, p.VEHICLE_OF_WORLD, p.SEED, p.MISSIONS, p.PACE, p.JOURNAL),
            composable=True,
            rank=2,
        ),
        NodeRow(
            name="bridge",
            publishes=("pose", "mission", "target", "diagnostics"),
            subscribes=("move", "ready"),
            parameters=(
                *(bridge_parameters.VEHICLE, bridge_parameters.CONNECT, bridge_parameters.SYSTEM),
                bridge_parameters.DATUM,
                *(p.SCENARIO, p.SEED, p.JOURNAL, bridge_parameters.FENCE_MARGIN_M),
                *bridge_parameters.SETTINGS,
            ),
            rank=2,
            on_request=True,
        ),
        NodeRow(
            name="channel_monitor",
            publishes=("rates", "ready", "diagnostics"),
            subscribes=("pose", "users"),
            parameters=(p.SCENARIO, p.JOURNAL),
            composable=True,
        ),
        NodeRow(
            name="policy",
            publishes=("move", "ready", "diagnostics"),
            subscribes=("mission", "rates"),
            parameters=(p.POLICY, p.SCENARIO_OR_POLICYS),
            composable=True,
        ),
        NodeRow(
            name="recorder",
            publishes=("ready", "diagnostics"),
            subscribes=tuple(topic.name for topic in TOPICS.values() if topic.recorded),
            parameters=(
                *(p.BAG, p.RESUME, p.SCENARIO, p.POLICY_IF_KNOWN, p.SEED, p.MISSIONS, p.PACE),
                p.VEHICLE_FLOWN,
                *p.BAG_FILES,
            ),
            hears_all=True,
            rank=0,
            hang_s=10.0,  # a slow disk makes it wait
            again={"resume": True},
        ),
        NodeRow(
            name="bag_record",
            publishes=("diagnostics",),
            subscribes=(),
            parameters=(p.BAG, p.RESUME, *p.BAG_FILES),
            hears_all=True,
            process=False,
            restarts=0,
            needed=False,
            on_request=True,
        ),
        NodeRow(
            name="visualizer",
            publishes=("path", "markers", "ready", "diagnostics"),
            subscribes=("pose", "target", "users", "rates", "mission"),
            parameters=(p.SCENARIO, p.RATE_HZ),
            hears_all=True,
            needed=False,
        ),
        NodeRow(
            name="live_view",
            publishes=("diagnostics",),
            subscribes=tuple(topic.name for topic in TOPICS.values() if topic.name != "ready"),
            parameters=(p.PORT, p.ADDRESS),
            needed=False,
            on_request=True,
        ),
        NodeRow(
            name="mission_monitor",
            publishes=("ready", "diagnostics"),
            subscribes=("mission", "rates"),
            hears_all=True,
            process=False,
            restarts=0,
        ),
    )
}

COMPOSABLE = tuple(row.name for row in NODES.values() if row.composable)

# Around a real vehicle the world has the users only.
WORLD_AROUND = replace(
    NODES["world"], publishes=("users", "ready", "diagnostics"), subscribes=("mission", "pose")
)


def rows(nodes: Collection[str]) -> Mapping[str, NodeRow]:
    """The rows as they are in a mission of these nodes: a bridge brings a vehicle of its own."""
    return {**NODES, "world": WORLD_AROUND} if "bridge" in nodes else NODES
