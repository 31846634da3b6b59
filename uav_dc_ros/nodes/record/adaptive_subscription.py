"""One recorded topic: its subscription, changed when publishers come that offer less, and what it lost."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.event_handler import QoSSubscriptionEventType, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from uav_dc_ros.nodes.ros.rclpy_private import EventCount

Callback = Callable[[bytes, Any], None]


def union(ends: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """The QoS with which all publishers are heard, and those that resend or keep messages do so."""
    offers = [end.qos_profile for end in ends]
    reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class _Subscription:
    """A subscription, and the middleware's count of what it lost."""

    def __init__(self, subscription: Any) -> None:
        self.subscription = subscription
        self._losses = EventCount(subscription, QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST)
        self.close = self._losses.close

    def lost(self) -> int:
        """Messages that were lost until now; 0 with a middleware that does not count."""
        count = self._losses.take()
        return 0 if count is None else int(count.total_count)

    def take(self) -> Any:
        """The next message and its info; None if there is none now."""
        with self.subscription.handle:
            return self.subscription.handle.take_message(self.subscription.msg_type, True)


class AdaptiveSubscription:
    """A topic that is recorded.

    Args:
        node: that records it.
        name: full name.
        type: ROS 2 message type.
        callback: takes each message and its info.

    Attributes:
        publishers: how many there were when somebody last looked.
    """

    def __init__(self, node: Node, name: str, type: str, callback: Callback) -> None:
        self.name = name
        self.type = type
        self.callback = callback
        self.publishers = 0
        self._node = node
        self._ear: _Subscription
        self._kind: Any = None  # the class of its messages; None: it is not to adapt
        self._profile: QoSProfile
        self._leaving: _Subscription | None = None
        self._seen: set[tuple[int, int]] = set()  # messages, while two subscriptions hear them
        self._lost = 0  # by subscriptions that are gone

    @property
    def subscription(self) -> Any:
        """The subscription."""
        return self._ear.subscription

    def add(self, subscription: Any, *, adapts: bool) -> None:
        """Use a subscription that somebody else has made; one that does not adapt stays as it is."""
        self._ear = _Subscription(subscription)
        self._kind = subscription.msg_type if adapts else None
        self._profile = subscription.qos_profile

    def subscribe(self, kind: Any, ends: Sequence[TopicEndpointInfo]) -> None:
        """Make a subscription that hears all of these publishers."""
        self._kind = kind
        self._profile = union(ends)
        self._ear = self._made(self.callback)

    def _made(self, callback: Callback) -> _Subscription:
        handler: Any = callback  # rclpy sees by the signature what it takes; its types do not
        return _Subscription(
            self._node.create_subscription(
                self._kind,
                self.name,
                handler,
                self._profile,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                raw=True,
            )
        )

    def adapt(self, ends: Sequence[TopicEndpointInfo]) -> None:
        """Hear new publishers, too, if they offer less than was asked for.

        A new subscription takes over from the old one; while there are two, each message is taken once.
        """
        if self._kind is None or self._leaving is not None:
            return
        wanted = union(ends)
        if not _asks_less(wanted, self._profile):
            return
        self._profile = wanted
        self._leaving = self._ear
        self._leaving.subscription.callback = self._once
        self._ear = self._made(self._once)

    def _once(self, data: bytes, info: Any) -> None:
        key = (info["publication_sequence_number"], info["source_timestamp"])
        if key not in self._seen:
            self._seen.add(key)
            self.callback(data, info)

    def settle(self) -> None:
        """End the time of two subscriptions, once the new one hears all that the old one does."""
        if self._leaving is None:
            return
        if self.subscription.get_publisher_count() < self._leaving.subscription.get_publisher_count():
            return
        for ear in (self._leaving, self._ear):
            while (taken := ear.take()) is not None:
                self._once(*taken)
        self._lost += self._leaving.lost()
        self._leaving.close()
        self._node.destroy_subscription(self._leaving.subscription)
        self._leaving = None
        self.subscription.callback = self.callback
        self._seen.clear()

    def lost(self) -> int:
        """Messages that were published, and lost before they came here."""
        return self._lost + sum(ear.lost() for ear in self._ears)

    @property
    def _ears(self) -> list[_Subscription]:
        return [self._ear] if self._leaving is None else [self._leaving, self._ear]

    def drain(self, until_ns: int, deadline_s: float) -> int:
        """Handle what has arrived; how many of these messages there was no time for.

        Args:
            until_ns: messages published later do not count, nanoseconds since the epoch.
            deadline_s: of the monotonic clock.
        """
        left = 0
        for ear in self._ears:
            while (taken := ear.take()) is not None and taken[1]["source_timestamp"] <= until_ns:
                if time.monotonic() < deadline_s:
                    ear.subscription.callback(*taken)
                else:
                    left += 1
        return left

    def close(self) -> None:
        """Let go of the subscriptions."""
        for ear in self._ears:
            ear.close()
            self._node.destroy_subscription(ear.subscription)
        self._leaving = None


def _asks_less(wanted: QoSProfile, asked: QoSProfile) -> bool:
    return (wanted.reliability != asked.reliability and asked.reliability == ReliabilityPolicy.RELIABLE) or (
        wanted.durability != asked.durability and asked.durability == DurabilityPolicy.TRANSIENT_LOCAL
    )
