"""The topics, one row each: the only list. Names are relative: a namespace contains a whole mission.

Quality of service:

- *Reliable* publishers: a lost message leaves a hole in a bag and blocks a lockstep. Only `clock` is best
  effort.
- *Best-effort* subscriptions: poses and the clock. An autopilot publishes its pose best effort, which a
  reliable subscription does not match. (The recorder requests what is offered.)
- *Latched* (transient local): state that a late or restarted subscriber needs. Not a pose, since an
  autopilot's is not; not a move, since an old one is useless.
- *Depth*: publishers keep messages for restarted and slow subscribers. Payloads with an entry per user can be
  large: publishers keep at least ten, and at most as many as 64 MiB hold. Subscriptions keep the newest
  hundred, or all (`keeps_all` in the node table).

ROS parameters `qos_overrides./TOPIC.publisher.*` and `qos_overrides./TOPIC.subscription.*` override
`history`, `depth`, `reliability` and `durability` for each node.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Topic:
    """A topic and its quality of service."""

    name: str  # relative
    type: str  # ROS 2 message type; `std_msgs/msg/String` holds a JSON payload, see messages.PAYLOADS
    reliable: bool = True  # offered by publishers
    requests_reliable: bool = True  # requested by subscriptions
    latched: bool = False  # durability transient local, offered and requested; otherwise volatile
    depth: int = 1000  # messages that a publisher keeps
    # Liveliness lease duration that publishers offer, see `nodes.ros.liveliness`. Without one, a killed
    # publisher is detected after tens of seconds.
    lease_s: float | None = None
    recorded: bool = True  # by the recorder
    exclusive: bool = False  # a mission has exactly one publisher of it
    # Not every mission has a publisher of it: the recorder records it once it finds one.
    optional: bool = False


# The world node's simulated vehicle, and the interfaces to a real one.
SIMULATED = "simulated"
VEHICLES = ("mavlink", "mavros", "px4")
SYSTEM_MAX = 255  # highest MAVLink system number

MARK = "mark"  # annotations of a recording, plain text: any node may publish it, see `bag mark`
JSON = "std_msgs/msg/String"
POSE = "geometry_msgs/msg/PoseStamped"
PATH = "nav_msgs/msg/Path"
MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
CLOCK = "rosgraph_msgs/msg/Clock"
FLOAT = "std_msgs/msg/Float64"
INTEGER = "std_msgs/msg/Int32"
ODOMETRY = "nav_msgs/msg/Odometry"
BATTERY = "sensor_msgs/msg/BatteryState"
FIX = "sensor_msgs/msg/NavSatFix"
TRANSFORMS = "tf2_msgs/msg/TFMessage"  # not among ROS 2's wheels on PyPI

TOPICS: dict[str, Topic] = {
    topic.name: topic
    for topic in (
        Topic(name="pose", type=POSE, requests_reliable=False, exclusive=True),
        Topic(name="users", type=JSON, latched=True, depth=500, exclusive=True),
        Topic(name="rates", type=JSON, latched=True, depth=500, exclusive=True),
        Topic(name="mission", type=JSON, latched=True, exclusive=True),
        Topic(name="move", type=JSON, lease_s=0.25, exclusive=True),
        Topic(name="target", type=POSE, latched=True, exclusive=True),
        Topic(name="ready", type=JSON, latched=True, depth=10, recorded=False),
        Topic(name="path", type=PATH, latched=True, depth=1),
        Topic(name="markers", type=MARKERS, latched=True, depth=1),
        Topic(name="sum_rate", type=FLOAT, latched=True, depth=10),
        Topic(name="users_collected", type=INTEGER, latched=True, depth=10),
        Topic(name="remaining_steps", type=INTEGER, latched=True, depth=10),
        Topic(name="odom", type=ODOMETRY, depth=100),
        Topic(name="battery", type=BATTERY, latched=True, depth=10, optional=True),
        Topic(name="fix", type=FIX, depth=100, optional=True),
        Topic(name="tf", type=TRANSFORMS, depth=100, optional=True),
        Topic(name="diagnostics", type=DIAGNOSTICS, depth=10),
        Topic(
            name="clock",
            type=CLOCK,
            reliable=False,
            requests_reliable=False,
            depth=1,
            recorded=False,
            exclusive=True,
        ),
    )
}
