"""The topics, one row each: the only list. Names are relative, so a namespace carries a whole mission.

Quality of service, with reasons:

- `reliable` everywhere: a lost message would end a lockstep, and leave a hole in a bag.
- `latched` (transient local) for what describes the state: whoever joins late learns it at once. A pose is
  not latched, since an autopilot's is not, and a subscriber may not ask for more than is offered; a move
  is not, since an old one is worth nothing.
- Publishers keep 1000 messages for readers that fall behind. Who acts on messages keeps the newest hundred;
  who must miss nothing (the recorder, while the disk is busy) keeps all: see `hears_all` in the node table.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Topic:
    """A topic.

    Attributes:
        name: relative name.
        type: ROS 2 message type; `std_msgs/msg/String` holds a JSON payload, see messages.PAYLOADS.
        latched: durability transient local instead of volatile.
        depth: messages that a publisher keeps.
        recorded: does the recorder write it?
    """

    name: str
    type: str
    latched: bool
    depth: int = 1000
    recorded: bool = True


JSON = "std_msgs/msg/String"
POSE = "geometry_msgs/msg/PoseStamped"

TOPICS: dict[str, Topic] = {
    topic.name: topic
    for topic in (
        Topic(name="pose", type=POSE, latched=False),
        Topic(name="users", type=JSON, latched=True),
        Topic(name="rates", type=JSON, latched=True),
        Topic(name="mission", type=JSON, latched=True),
        Topic(name="move", type=JSON, latched=False),
        Topic(name="target", type=POSE, latched=True),
        Topic(name="ready", type=JSON, latched=True, recorded=False),
    )
}
