"""rclpy's private API, as far as it is in use. A test of its own uses all of it, and tells what changed.

It is also why the extra `ros` has an upper bound.
"""

from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.event_handler import QoSSubscriptionEventType, UnsupportedEventTypeError
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.subscription import Subscription

RCLError: type[Exception] = _rclpy.RCLError  # an error of the library below rclpy


def wait_set(context: Any, subscriptions: int, guards: int, timers: int, clients: int, services: int) -> Any:
    """A wait set, empty, with room for so many of each."""
    return _rclpy.WaitSet(subscriptions, guards, timers, clients, services, 0, context.handle)


def takes_info(subscription: Any) -> bool:
    """Does the callback of a subscription take a message's info, too."""
    return bool(subscription._callback_type is Subscription.CallbackType.WithMessageInfo)


def overrides(node: Node) -> dict[str, rclpy.Parameter]:
    """Parameters that were given to a node, by name; what is changed here, it declares changed."""
    given: dict[str, rclpy.Parameter] = node._parameter_overrides
    return given


def state(node: LifecycleNode) -> str:
    """The state of a node's life cycle."""
    return str(node._state_machine.current_state[1])


def answer_transitions(node: LifecycleNode, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Have requests for transitions answered by `answer`; returns what answered them until now."""
    before: Callable[[Any, Any], Any] = node._service_change_state.callback
    node._service_change_state.callback = answer
    return before


class EventCount:
    """What the middleware counts of a subscription: lost messages, living publishers.

    Args:
        subscription: of a node.
        kind: what is counted.
    """

    def __init__(self, subscription: Any, kind: QoSSubscriptionEventType) -> None:
        try:
            self._event: Any = _rclpy.EventHandle(subscription.handle, kind)
        except UnsupportedEventTypeError:
            self._event = None

    def take(self) -> Any:
        """The counts now; None with a middleware that does not count, and after `close`."""
        if self._event is None:
            return None
        with self._event:
            return self._event.take_event()

    def close(self) -> None:
        """Count no more."""
        if self._event is not None:
            self._event.destroy_when_not_in_use()
            self._event = None
