"""Notices within a fraction of a second that the only publisher of a topic has been killed.

A publisher that offers a lease (see `topics.Topic.lease_s`) gives a sign of life within it, from a thread of
the middleware: busy or loading, it lives; killed, it does not. A second subscription asks for that sign
alone: one that asked for the messages, too, would be deaf to publishers that offer none.
"""

from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import (
    QoSSubscriptionEventType,
    SubscriptionEventCallbacks,
    UnsupportedEventTypeError,
)
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node

from uav_dc_ros.nodes import qos
from uav_dc_ros.topics import Topic

LATE = 1.4  # of the lease, after which a sign of life is missed


class Lease:
    """Whether anybody who publishes a topic lives.

    Args:
        node: that wants to know.
        topic: with a lease.
    """

    def __init__(self, node: Node, topic: Topic) -> None:
        assert topic.lease_s is not None, "otherwise nobody gives a sign"
        profile = qos.requested(topic, all=False)
        profile.liveliness_lease_duration = Duration(seconds=LATE * topic.lease_s)
        self._node = node
        self._was_there = False
        self._subscription = node.create_subscription(
            qos.MESSAGE_TYPES[topic.type],
            topic.name,
            _ignore,
            profile,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=True,
        )
        kind = QoSSubscriptionEventType.RCL_SUBSCRIPTION_LIVELINESS_CHANGED
        try:
            self._event: Any = _rclpy.EventHandle(self._subscription.handle, kind)
        except UnsupportedEventTypeError:
            self._event = None

    def is_gone(self) -> bool:
        """Was somebody there who is not any more. Never so with publishers that offer no lease."""
        if self._event is None:
            return False
        with self._event:
            alive = bool(self._event.take_event().alive_count)
        self._was_there |= alive
        return self._was_there and not alive

    def hear(self) -> None:
        """Note that somebody has published: one that offers no lease, maybe, in place of one that did."""
        self._was_there = False

    def close(self) -> None:
        """Look no more."""
        if self._event is not None:
            self._event.destroy_when_not_in_use()
            self._event = None
        self._node.destroy_subscription(self._subscription)


def _ignore(message: bytes) -> None:
    """Whoever wants the messages has a subscription of its own."""
