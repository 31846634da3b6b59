"""Notices within two seconds that the only publisher of a topic has been killed.

A publisher that offers a lease (see `topics.Topic.lease_s`) asserts its liveliness several times a second,
from a thread of the middleware: busy or loading, it lives; killed, it does not. On a busy computer that
thread waits, too, so many assertions in a row have to be missed; and since the one that waited may be this
process, liveliness that comes back within a moment was not lost. A second subscription asks for liveliness
alone: one that asked for the messages, too, would not match publishers that offer none.
"""

import time
from collections.abc import Callable

from rclpy.duration import Duration
from rclpy.event_handler import QoSSubscriptionEventType, SubscriptionEventCallbacks
from rclpy.node import Node

from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.nodes.ros.rclpy_private import EventCount
from uav_dc_ros.topics import Topic

MISSED_S = 1.25  # without an assertion, after which the middleware reports liveliness as lost
CONFIRMED_S = 0.25  # that it then has to stay lost


class Confirmed:
    """Liveliness as the middleware reports it, confirmed. To be asked several times in `CONFIRMED_S`.

    Args:
        clock: steady, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._was_there = False
        self._lost_s: float | None = None  # since when it is lost, without a gap between the looks
        self._looked_s = 0.0

    def is_gone(self, alive: bool) -> bool:
        """Is somebody gone who was there."""
        now_s, before_s = self._clock(), self._looked_s
        self._looked_s = now_s
        self._was_there |= alive
        if alive or not self._was_there:
            self._lost_s = None
            return False
        if self._lost_s is None or now_s - before_s > CONFIRMED_S:  # this process itself had to wait
            self._lost_s = now_s
        return now_s - self._lost_s >= CONFIRMED_S

    def forget(self) -> None:
        """Wait for somebody anew."""
        self._was_there = False


class LivelinessMonitor:
    """Whether anybody who publishes a topic lives.

    Args:
        node: that wants to know.
        topic: with a lease.
    """

    def __init__(self, node: Node, topic: Topic) -> None:
        assert topic.lease_s is not None, "otherwise nobody asserts liveliness"
        assert topic.lease_s < MISSED_S, "otherwise they do not match"
        profile = qos.requested(topic, all=False)
        profile.liveliness_lease_duration = Duration(seconds=MISSED_S)
        self._node = node
        self._confirmed = Confirmed()
        self._subscription = node.create_subscription(
            qos.MESSAGE_TYPES[topic.type],
            topic.name,
            _ignore,
            profile,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=True,
        )
        kind = QoSSubscriptionEventType.RCL_SUBSCRIPTION_LIVELINESS_CHANGED
        self._liveliness = EventCount(self._subscription, kind)

    def is_gone(self) -> bool:
        """Was somebody there who is not any more. Never so with publishers that offer no lease."""
        count = self._liveliness.take()
        return count is not None and self._confirmed.is_gone(bool(count.alive_count))

    def hear(self) -> None:
        """Note that somebody has published: one that offers no lease, maybe, in place of one that did."""
        self._confirmed.forget()

    def close(self) -> None:
        """Look no more."""
        self._liveliness.close()
        self._node.destroy_subscription(self._subscription)


def _ignore(message: bytes) -> None:
    """Whoever wants the messages has a subscription of its own."""
