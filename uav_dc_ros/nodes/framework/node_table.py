"""The nodes, one row each: the only list. Topics are those of `topics.TOPICS`. Needs no ROS."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from uav_dc_ros.nodes.framework import parameters as p
from uav_dc_ros.topics import TOPICS

# Numbers of the mission as standard messages.
NUMERIC = ("sum_rate", "users_collected", "remaining_steps", "odom")
# Processes of several nodes: those that wait for one another in every step, and those that no node waits for.
STEPS, VIEWS = "container", "view_container"


@dataclass(frozen=True, kw_only=True)
class NodeRow:
    """A node: its topics and parameters, and how run_all supervises it."""

    name: str  # in the ROS graph
    publishes: tuple[str, ...]  # names of topics
    subscribes: tuple[str, ...]
    parameters: tuple[p.Parameter, ...] = ()  # its own, beside `parameters.COMMON`
    # Services of std_srvs/Trigger while it is active, beside those of the life cycle; `~/`: below its name.
    services: tuple[str, ...] = ()
    keeps_all: bool = False  # subscriptions keep every message until it is handled, not only the newest 100
    process: bool = True  # it is a process of its own, `python -m uav_dc_ros.nodes.NAME`
    container: str = ""  # the process of several nodes that it may join, see `CONTAINERS`
    # Nodes of a lower rank start first and stop last: the recorder receives the first and the last message,
    # and the world starts the mission.
    rank: int = 1
    # Within `supervisor.RESTART_WINDOW_S`. One more failure ends the mission or, if not needed, its restarts.
    max_restarts: int = 3
    # An active node without a report for so long is restarted. Time for which it waits for a CPU or the disk
    # does not count.
    hang_timeout_s: float = 5.0
    stop_timeout_s: float = 10.0  # for its process to end after SIGTERM: the bridge waits for its vehicle
    needed: bool = True  # the mission cannot fly without it (the bridge: only with a real vehicle)
    on_request: bool = False  # it starts only if the user requests it
    restart_parameters: Mapping[str, object] = field(default_factory=dict)  # that a restart adds


VEHICLE_SERVICES = ("start", "stop", "abort")
RECORDER_SERVICES = ("~/pause", "~/resume", "~/split", "~/snapshot")

NODES: dict[str, NodeRow] = {
    row.name: row
    for row in (
        NodeRow(
            name="world",
            publishes=("pose", "users", "mission", "target", "diagnostics", "clock"),
            subscribes=("move", "ready"),
            parameters=(
                p.SCENARIO,
                p.VEHICLE_OF_WORLD,
                p.SEED,
                p.MISSIONS,
                p.PACE,
                p.JOURNAL,
                p.WAIT_FOR_START,
            ),
            services=VEHICLE_SERVICES,
            container=STEPS,
            rank=2,
        ),
        NodeRow(
            name="bridge",
            publishes=("pose", "mission", "target", "battery", "fix", "diagnostics"),
            subscribes=("move", "ready", "rates"),  # rates: for ground stations
            parameters=p.BRIDGE,
            services=VEHICLE_SERVICES,
            rank=2,
            on_request=True,
        ),
        NodeRow(
            name="channel_monitor",
            publishes=("rates", "ready", "diagnostics"),
            subscribes=("pose", "users"),
            parameters=(p.SCENARIO, p.JOURNAL),
            container=STEPS,
        ),
        NodeRow(
            name="policy",
            publishes=("move", "ready", "diagnostics"),
            subscribes=("mission", "rates"),
            parameters=(
                p.POLICY,
                p.SCENARIO_OF_POLICY,
                p.OBJECTIVE_WEIGHT,
                p.SEARCH,
                p.SEARCH_TIME_LIMIT_S,
            ),
            container=STEPS,
        ),
        NodeRow(
            name="recorder",
            publishes=("ready", "diagnostics"),
            subscribes=tuple(one.name for one in TOPICS.values() if one.recorded and not one.optional),
            parameters=(
                *(
                    p.SCENARIO,
                    p.RECORDED_POLICY,
                    p.OBJECTIVE_WEIGHT,
                    p.SEARCH,
                    p.SEED,
                    p.MISSIONS,
                    p.PACE,
                    p.RECORDED_VEHICLE,
                ),
                *p.BAG_WRITER,
            ),
            services=RECORDER_SERVICES,
            keeps_all=True,
            rank=0,
            hang_timeout_s=10.0,  # a slow disk blocks its callbacks between waits within the kernel, ...
            stop_timeout_s=60.0,  # ... and the end of its bag
            restart_parameters={"resume": True},
        ),
        NodeRow(
            name="bag_record",
            publishes=("diagnostics",),
            subscribes=(),
            parameters=p.BAG_WRITER,
            services=RECORDER_SERVICES,
            keeps_all=True,
            process=False,
            max_restarts=0,
            needed=False,
            on_request=True,
        ),
        NodeRow(
            name="visualizer",
            publishes=("path", "markers", *NUMERIC, "battery", "tf", "ready", "diagnostics"),
            subscribes=("pose", "target", "users", "rates", "mission"),
            parameters=(p.SCENARIO, p.RATE_HZ, p.NUMERIC_RATE_HZ, p.TF),
            keeps_all=True,
            container=VIEWS,
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
            name="web_view",
            publishes=("diagnostics",),
            subscribes=("mission", "users", "rates"),
            parameters=(p.SCENARIO, p.WEB_PORT, p.ADDRESS, p.TOKEN),
            container=VIEWS,
            needed=False,
            on_request=True,
        ),
        NodeRow(
            name="mission_monitor",
            publishes=("ready", "diagnostics"),
            subscribes=("mission", "rates"),
            keeps_all=True,
            process=False,
            max_restarts=0,
        ),
    )
}

# The nodes that may share a process, by its name.
CONTAINERS = {
    container: tuple(row.name for row in NODES.values() if row.container == container)
    for container in (STEPS, VIEWS)
}

# A planner that knows where the users are.
POLICY_WITH_POSITIONS = replace(NODES["policy"], subscribes=(*NODES["policy"].subscribes, "users"))

# Beside a bridge the world only moves the users.
WORLD_BESIDE_BRIDGE = replace(
    NODES["world"], publishes=("users", "ready", "diagnostics"), subscribes=("mission", "pose"), services=()
)


def mission_rows(nodes: Collection[str]) -> Mapping[str, NodeRow]:
    """The node table in a mission of these nodes: a bridge changes the world's row."""
    return {**NODES, "world": WORLD_BESIDE_BRIDGE} if "bridge" in nodes else NODES
