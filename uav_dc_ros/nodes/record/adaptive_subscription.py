"""The subscription of one recorded topic: adapts to its publishers' QoS, and counts lost messages."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.event_handler import QoSSubscriptionEventType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from uav_dc_ros.nodes.ros import qos
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


class AdaptiveSubscription:
    """Subscribes to a recorded topic; passes each serialized message and its info to the callback."""

    def __init__(self, node: Node, name: str, type: str, callback: Callback) -> None:
        self.name, self.type, self.callback = name, type, callback
        self.publishers = 0  # at the last scan of the graph
        self._node = node
        self._losses: dict[Any, EventCount] = {}  # by subscription; two while a new one takes over
        self._class: Any = None  # of the messages; None: the subscription does not adapt
        self._profile: QoSProfile
        self._received: set[tuple[int, int]] = set()  # messages, while there are two subscriptions
        self._lost = 0  # by closed subscriptions

    @property
    def subscription(self) -> Any:
        """The newest subscription."""
        return list(self._losses)[-1]

    def use(self, subscription: Any, *, adapts: bool) -> None:
        """Use an existing subscription."""
        self._class = subscription.msg_type if adapts else None
        self._profile = subscription.qos_profile
        self._add(subscription)

    def subscribe(self, message_class: Any, ends: Sequence[TopicEndpointInfo]) -> None:
        """Create a subscription that matches all these publishers."""
        self._class = message_class
        self._profile = common_qos(ends)
        self._add(qos.create_subscription(self._node, self._class, self.name, self.callback, self._profile))

    def _add(self, subscription: Any) -> None:
        event = QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST
        self._losses[subscription] = EventCount(subscription, event)

    def _remove(self, subscription: Any) -> None:
        self._losses.pop(subscription).close()
        self._node.destroy_subscription(subscription)

    def adapt(self, ends: Sequence[TopicEndpointInfo]) -> None:
        """Match new publishers, too, with a second subscription if they offer less than the first requests.

        While there are two subscriptions, each message is handled once.
        """
        if self._class is None or len(self._losses) > 1:
            return
        profile = common_qos(ends)
        if _requests_less(profile, self._profile):
            self._profile = profile
            self.subscription.callback = self._once
            self._add(qos.create_subscription(self._node, self._class, self.name, self._once, profile))

    def _once(self, data: bytes, info: Any) -> None:
        key = (info["publication_sequence_number"], info["source_timestamp"])
        if key not in self._received:
            self._received.add(key)
            self.callback(data, info)

    def settle(self) -> None:
        """Close the first of two subscriptions, once the second one has matched all its publishers."""
        if len(self._losses) < 2:
            return
        first, second = self._losses
        if second.get_publisher_count() < first.get_publisher_count():
            return
        for subscription in self._losses:
            while (taken := _take(subscription)) is not None:
                self._once(*taken)
        self._lost += _count(self._losses[first])
        self._remove(first)
        second.callback = self.callback
        self._received.clear()

    @property
    def may_receive(self) -> bool:
        """Whether a message that was lost may be sent again: a publisher is there, and it is reliable."""
        is_reliable = self._profile.reliability == ReliabilityPolicy.RELIABLE
        return is_reliable and any(one.get_publisher_count() for one in self._losses)

    def lost(self) -> int:
        """Number of published messages that did not arrive; 0 with a middleware that does not count."""
        return self._lost + sum(map(_count, self._losses.values()))

    def drain(self, until_ns: int, deadline_s: float) -> int:
        """Handle messages published by `until_ns`; the number that a (monotonic) deadline left unhandled."""
        unhandled = 0
        for subscription in self._losses:
            while (taken := _take(subscription)) is not None and taken[1]["source_timestamp"] <= until_ns:
                if time.monotonic() < deadline_s:
                    subscription.callback(*taken)
                else:
                    unhandled += 1
        return unhandled

    def close(self) -> None:
        """Destroy the subscriptions."""
        for subscription in list(self._losses):
            self._remove(subscription)


def _take(subscription: Any) -> Any:
    """The next message and its info, or None."""
    with subscription.handle:
        return subscription.handle.take_message(subscription.msg_type, True)


def _count(losses: EventCount) -> int:
    count = losses.take()
    return 0 if count is None else int(count.total_count)


def _requests_less(new: QoSProfile, old: QoSProfile) -> bool:
    return (old.reliability == ReliabilityPolicy.RELIABLE and new.reliability != old.reliability) or (
        old.durability == DurabilityPolicy.TRANSIENT_LOCAL and new.durability != old.durability
    )
