"""The private API of rclpy that is in use. Its test uses all of it, and shows what a new version changed.

It is why the extra `ros` has an upper bound.
"""

import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.event_handler import QoSSubscriptionEventType, UnsupportedEventTypeError
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.subscription import Subscription

RCLError: type[Exception] = _rclpy.RCLError  # an error of the library below rclpy
# Errors of `rclpy.init` for invalid arguments.
INIT_ERRORS: tuple[type[Exception], ...] = (
    *(_rclpy.RCLInvalidROSArgsError, _rclpy.UnknownROSArgsError),
    RCLError,
)


def skip_message_generator() -> None:
    """Keep the first message of this process from importing what generates Python classes of messages.

    The package whose function loads type support imports that, too, and goes on without it: a twentieth of a
    node's start.
    """
    sys.modules.setdefault("rosidl_generator_py.generate_py_impl", None)  # type: ignore[arg-type]


def wait_set(context: Any, subscriptions: int, guards: int, timers: int, clients: int, services: int) -> Any:
    """An empty wait set with a capacity for each kind."""
    return _rclpy.WaitSet(subscriptions, guards, timers, clients, services, 0, context.handle)


def takes_info(subscription: Any) -> bool:
    """Whether a subscription's callback takes the message info, too."""
    return bool(subscription._callback_type is Subscription.CallbackType.WithMessageInfo)


def parameter_overrides(node: Node) -> dict[str, rclpy.Parameter]:
    """A node's parameter overrides by name; a change of this dict changes what the node declares."""
    overrides: dict[str, rclpy.Parameter] = node._parameter_overrides
    return overrides


def state(node: LifecycleNode) -> str:
    """The state of a node's life cycle."""
    return str(node._state_machine.current_state[1])


def replace_change_state(
    node: LifecycleNode, callback: Callable[[Any, Any], Any]
) -> Callable[[Any, Any], Any]:
    """Replace the callback of the service `change_state`; returns the former one."""
    former: Callable[[Any, Any], Any] = node._service_change_state.callback
    node._service_change_state.callback = callback
    return former


class EventCount:
    """An event count of the middleware for a subscription: lost messages, or live publishers."""

    def __init__(self, subscription: Any, kind: QoSSubscriptionEventType) -> None:
        try:
            self._event: Any = _rclpy.EventHandle(subscription.handle, kind)
        except UnsupportedEventTypeError:
            self._event = None

    def take(self) -> Any:
        """The event status; None after `close`, or if the middleware does not support it."""
        if self._event is None:
            return None
        with self._event:
            return self._event.take_event()

    def close(self) -> None:
        """Stop counting."""
        if self._event is not None:
            self._event.destroy_when_not_in_use()
            self._event = None
