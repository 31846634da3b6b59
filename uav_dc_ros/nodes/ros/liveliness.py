"""Detects within two seconds that the only publisher of a topic was killed.

A publisher that offers a lease (`topics.Topic.lease_s`) asserts its liveliness several times a second, from a
thread of the middleware, also while its node is busy. A busy computer delays that thread, so many assertions
in a row must be missing; and it may delay this process instead, so the loss must last for a moment. A second
subscription requests liveliness alone: with it, the first would not match publishers that offer none.
"""

import time
from collections.abc import Callable

from rclpy.duration import Duration
from rclpy.event_handler import QoSSubscriptionEventType
from rclpy.node import Node

from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.nodes.ros.rclpy_private import EventCount
from uav_dc_ros.topics import Topic

MISSED_S = 1.25  # without an assertion, after which the middleware reports the liveliness as lost
CONFIRMED_S = 0.25  # for which it then has to stay lost


class LivelinessFilter:
    """Confirms a loss of liveliness. To be updated several times in `CONFIRMED_S`; the clock is steady."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._was_alive = False
        self._lost_s: float | None = None  # beginning of a loss without a gap between updates
        self._updated_s = 0.0

    def is_lost(self, alive: bool) -> bool:
        """Update with the reported liveliness: whether a publisher that was alive is lost."""
        now_s, before_s = self._clock(), self._updated_s
        self._updated_s = now_s
        self._was_alive |= alive
        if alive or not self._was_alive:
            self._lost_s = None
            return False
        if self._lost_s is None or now_s - before_s > CONFIRMED_S:  # this process itself was delayed
            self._lost_s = now_s
        return now_s - self._lost_s >= CONFIRMED_S

    def reset(self) -> None:
        """Wait for the next publisher."""
        self._was_alive = False


class LivelinessMonitor:
    """Monitors the liveliness of the publishers of a topic that has a lease."""

    def __init__(self, node: Node, topic: Topic) -> None:
        assert topic.lease_s is not None, "a topic with a lease"
        assert topic.lease_s < MISSED_S, "otherwise they do not match"
        profile = qos.requested(topic, keep_all=False)
        profile.liveliness_lease_duration = Duration(seconds=MISSED_S)
        self._node = node
        self._filter = LivelinessFilter()
        message_class = qos.MESSAGE_TYPES[topic.type]  # another subscription handles the messages
        self._subscription = qos.create_subscription(node, message_class, topic.name, lambda _: None, profile)
        kind = QoSSubscriptionEventType.RCL_SUBSCRIPTION_LIVELINESS_CHANGED
        self._liveliness = EventCount(self._subscription, kind)

    def is_lost(self) -> bool:
        """Whether all publishers are lost. Always false for publishers that offer no lease."""
        count = self._liveliness.take()
        return count is not None and self._filter.is_lost(bool(count.alive_count))

    def reset(self) -> None:
        """Note a message: a publisher without a lease may have replaced one that offered it."""
        self._filter.reset()

    def close(self) -> None:
        """Stop monitoring."""
        self._liveliness.close()
        self._node.destroy_subscription(self._subscription)
