"""Whether another node publishes setpoints for the same vehicle."""

import time

from rclpy.node import Node

LOOK_S = 1.0  # between two looks at the graph
FORGOTTEN_S = 30.0  # after which the graph has forgotten a bridge that was killed


class OtherSetpointPublishers:
    """Looks at the graph now and then.

    Args:
        node: that publishes the one stream that there should be.
        restarted: was a bridge killed before it? The graph still tells of that one for a while.
    """

    def __init__(self, node: Node, *, restarted: bool) -> None:
        self._node = node
        self._look_s = time.monotonic() + (FORGOTTEN_S if restarted else 0.0)
        self._found: str | None = None

    def on(self, topic: str) -> str | None:
        """Who else publishes on a topic of setpoints, in words; None: nobody does."""
        if time.monotonic() >= self._look_s:
            self._look_s = time.monotonic() + LOOK_S
            count = self._node.count_publishers(topic)
            self._found = f"{count} nodes publish {topic}; expected one bridge only" if count > 1 else None
        return self._found
