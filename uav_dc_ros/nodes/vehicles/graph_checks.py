"""Checks of the ROS graph, which are costly: each is repeated at most once a second."""

import time
from collections.abc import Callable

from rclpy.node import Node

CHECK_S = 1.0
FORGOTTEN_S = 30.0  # after which the graph no longer lists a process that was killed


class PeriodicCheck:
    """Calls a check at most every `CHECK_S`, and returns its last result: a problem, or None."""

    def __init__(self, check: Callable[[], str | None], delay_s: float = 0.0) -> None:
        self._check, self._due_s = check, time.monotonic() + delay_s
        self._problem: str | None = None

    def __call__(self) -> str | None:
        """The last result."""
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + CHECK_S
            self._problem = self._check()
        return self._problem


def other_publishers(node: Node, topic: str, *, restarted: bool) -> PeriodicCheck:
    """A check for other publishers of a topic of setpoints; a bridge that was killed does not count."""

    def check() -> str | None:
        count = node.count_publishers(topic)
        return f"{count} nodes publish {topic}; expected one bridge only" if count > 1 else None

    return PeriodicCheck(check, FORGOTTEN_S if restarted else 0.0)
