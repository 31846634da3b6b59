"""The subscription of one recorded topic: adapts to its publishers' QoS, and counts lost messages."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.event_handler import QoSSubscriptionEventType, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from uav_dc_ros.nodes.ros.rclpy_private import EventCount

Callback = Callable[[bytes, Any], None]


def common_qos(ends: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """The strictest QoS that matches all publishers."""
    offers = [end.qos_profile for end in ends]
    reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class _CountedSubscription:
    """A subscription, and the middleware's count of its lost messages."""

    def __init__(self, subscription: Any) -> None:
        self.subscription = subscription
        self._losses = EventCount(subscription, QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST)
        self.close = self._losses.close

    def lost(self) -> int:
        """Number of lost messages; 0 with a middleware that does not count."""
        count = self._losses.take()
        return 0 if count is None else int(count.total_count)

    def take(self) -> Any:
        """The next message and its info, or None."""
        with self.subscription.handle:
            return self.subscription.handle.take_message(self.subscription.msg_type, True)


class AdaptiveSubscription:
    """Subscribes to a recorded topic.

    Args:
        name: full name.
        type: ROS 2 message type.
        callback: receives each message and its info.

    Attributes:
        publishers: number of publishers at the last scan of the graph.
    """

    def __init__(self, node: Node, name: str, type: str, callback: Callback) -> None:
        self.name = name
        self.type = type
        self.callback = callback
        self.publishers = 0
        self._node = node
        self._current: _CountedSubscription
        self._previous: _CountedSubscription | None = None  # until the current one has matched as many
        self._class: Any = None  # of the messages; None: the subscription does not adapt
        self._profile: QoSProfile
        self._received: set[tuple[int, int]] = set()  # messages, while there are two subscriptions
        self._lost = 0  # by closed subscriptions

    @property
    def subscription(self) -> Any:
        """The current subscription."""
        return self._current.subscription

    def use(self, subscription: Any, *, adapts: bool) -> None:
        """Use an existing subscription."""
        self._current = _CountedSubscription(subscription)
        self._class = subscription.msg_type if adapts else None
        self._profile = subscription.qos_profile

    def subscribe(self, message_class: Any, ends: Sequence[TopicEndpointInfo]) -> None:
        """Create a subscription that matches all these publishers."""
        self._class = message_class
        self._profile = common_qos(ends)
        self._current = self._create(self.callback)

    def _create(self, callback: Callback) -> _CountedSubscription:
        handler: Any = callback  # rclpy detects a second parameter, which its types lack
        return _CountedSubscription(
            self._node.create_subscription(
                self._class,
                self.name,
                handler,
                self._profile,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                raw=True,
            )
        )

    def adapt(self, ends: Sequence[TopicEndpointInfo]) -> None:
        """Match new publishers, too, with a second subscription if they offer less than the first requests.

        While there are two subscriptions, each message is handled once.
        """
        if self._class is None or self._previous is not None:
            return
        profile = common_qos(ends)
        if not _requests_less(profile, self._profile):
            return
        self._profile = profile
        self._previous = self._current
        self._previous.subscription.callback = self._once
        self._current = self._create(self._once)

    def _once(self, data: bytes, info: Any) -> None:
        key = (info["publication_sequence_number"], info["source_timestamp"])
        if key not in self._received:
            self._received.add(key)
            self.callback(data, info)

    def settle(self) -> None:
        """Close the previous subscription, once the current one has matched all its publishers."""
        previous = self._previous
        if (
            previous is None
            or self.subscription.get_publisher_count() < previous.subscription.get_publisher_count()
        ):
            return
        for each in self._all:
            while (taken := each.take()) is not None:
                self._once(*taken)
        self._lost += previous.lost()
        previous.close()
        self._node.destroy_subscription(previous.subscription)
        self._previous = None
        self.subscription.callback = self.callback
        self._received.clear()

    def lost(self) -> int:
        """Number of published messages that did not arrive."""
        return self._lost + sum(each.lost() for each in self._all)

    @property
    def _all(self) -> list[_CountedSubscription]:
        return [self._current] if self._previous is None else [self._previous, self._current]

    def drain(self, until_ns: int, deadline_s: float) -> int:
        """Handle messages that have arrived; returns the number of unhandled ones at the deadline.

        Args:
            until_ns: latest publication time, nanoseconds since the epoch.
            deadline_s: on the monotonic clock.
        """
        unhandled = 0
        for each in self._all:
            while (taken := each.take()) is not None and taken[1]["source_timestamp"] <= until_ns:
                if time.monotonic() < deadline_s:
                    each.subscription.callback(*taken)
                else:
                    unhandled += 1
        return unhandled

    def close(self) -> None:
        """Destroy the subscriptions."""
        for each in self._all:
            each.close()
            self._node.destroy_subscription(each.subscription)
        self._previous = None


def _requests_less(new: QoSProfile, old: QoSProfile) -> bool:
    return (old.reliability == ReliabilityPolicy.RELIABLE and new.reliability != old.reliability) or (
        old.durability == DurabilityPolicy.TRANSIENT_LOCAL and new.durability != old.durability
    )
