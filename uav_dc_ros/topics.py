"""The topics, one row each: the only list. Names are relative, so a namespace carries a whole mission.

Quality of service, with reasons:

- *Offered reliable*: a lost message would leave a hole in a bag and make a lockstep wait. Only `clock` is
  offered best effort, as everywhere in ROS: the next one is worth more than a lost one.
- *Asked best effort*: poses and the clock. An autopilot's bridge publishes its pose best effort, and a
  subscription that asks for more than is offered hears nothing. (The recorder asks for what is offered.)
- *Latched* (transient local): what describes the state, so that whoever joins late, or again, learns it at
  once. A pose is not latched, since an autopilot's is not; a move is not, since an old one is worth nothing.
- *Depth*: publishers keep as much as a node that was restarted, or a reader that fell behind, may want to
  catch up on. Payloads with an entry per user can be large: of those no more are kept than 64 MiB hold, and
  at least ten. Who acts on messages keeps the newest hundred; who must miss nothing keeps all: see
  `hears_all` in the node table.

Every policy can be overridden for each node, the ROS way: parameters `qos_overrides./TOPIC.publisher.*` and
`qos_overrides./TOPIC.subscription.*` with `history`, `depth`, `reliability`, `durability`.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Topic:
    """A topic.

    Attributes:
        name: relative name.
        type: ROS 2 message type; `std_msgs/msg/String` holds a JSON payload, see messages.PAYLOADS.
        reliable: reliability offered by publishers.
        asks_reliable: reliability asked for by subscriptions.
        latched: durability transient local instead of volatile, offered and asked for.
        depth: messages that a publisher keeps.
        lease_s: liveliness lease that publishers offer, seconds: they assert their liveliness within it, for
            who asks for that (see `nodes.ros.liveliness`); None: none is offered, and one that was killed is
            missed after tens of seconds.
        recorded: does the recorder write it?
        exclusive: does a mission have one publisher of it, and none beside it?
    """

    name: str
    type: str
    reliable: bool = True
    asks_reliable: bool = True
    latched: bool = False
    depth: int = 1000
    lease_s: float | None = None
    recorded: bool = True
    exclusive: bool = False


# What flies: the world node's own vehicle, or the way to a real one.
SIMULATED = "simulated"
VEHICLES = ("mavlink", "mavros", "px4")
SYSTEM_MAX = 255  # the highest number that a vehicle has on MAVLink

JSON = "std_msgs/msg/String"
POSE = "geometry_msgs/msg/PoseStamped"
PATH = "nav_msgs/msg/Path"
MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
CLOCK = "rosgraph_msgs/msg/Clock"

TOPICS: dict[str, Topic] = {
    topic.name: topic
    for topic in (
        Topic(name="pose", type=POSE, asks_reliable=False, exclusive=True),
        Topic(name="users", type=JSON, latched=True, depth=500, exclusive=True),
        Topic(name="rates", type=JSON, latched=True, depth=500, exclusive=True),
        Topic(name="mission", type=JSON, latched=True, exclusive=True),
        Topic(name="move", type=JSON, lease_s=0.25, exclusive=True),
        Topic(name="target", type=POSE, latched=True, exclusive=True),
        Topic(name="ready", type=JSON, latched=True, depth=10, recorded=False),
        Topic(name="path", type=PATH, latched=True, depth=1),
        Topic(name="markers", type=MARKERS, latched=True, depth=1),
        Topic(name="diagnostics", type=DIAGNOSTICS, depth=10),
        Topic(
            name="clock",
            type=CLOCK,
            reliable=False,
            asks_reliable=False,
            depth=1,
            recorded=False,
            exclusive=True,
        ),
    )
}
