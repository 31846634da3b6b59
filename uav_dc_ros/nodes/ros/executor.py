"""An executor that handles what is ready straight from the wait set.

rclpy's SingleThreadedExecutor makes a task, a coroutine and three guard triggers of every callback, and wakes
itself once more for each; in a lockstep of small messages that is more than the messages themselves take.
rclpy's EventsExecutor would be the one to use, but it is experimental, and called no callback in the wheels
of 7.1.6. `benchmarks/lockstep.py` measures this one beside rclpy's own.
"""

import gc
import threading
import time
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.utilities import get_default_context

from uav_dc_ros.nodes.ros import rclpy_private

TURN_MAX, TURN_MAX_S = 100, 0.2  # messages of one topic, and their time, before the others get their turn
# Quiet is what was so in as many turns: on a busy computer the middleware's thread may have had no time yet.
QUIET_TURNS = 10
BUSY_S = 0.003  # while messages keep coming, timers and services are looked at this often
BUSY_NS = round(BUSY_S * 1e9)


class DirectExecutor:
    """One thread, in which callbacks run one after the other: timers, subscriptions, services, clients.

    Callbacks may be plain functions only. Event callbacks of publishers and subscriptions are not handled:
    `qos.incompatible` looks for peers that do not match.

    Args:
        rest_s: pause after each turn that handled all there was, seconds. Who need not answer at once takes
            what came meanwhile in one turn, and leaves the cores to those who must.
        context: of ROS; None: the process's own.
    """

    def __init__(self, rest_s: float = 0.0, context: Context | None = None) -> None:
        self.rest_s = rest_s
        self._at_once = TURN_MAX if rest_s else 1
        self._behind = False  # did messages wait for another turn
        self._context: Any = context or get_default_context()
        self._guard = GuardCondition(callback=None, callback_group=None, context=self._context)
        self._nodes: list[Node] = []
        self._wait_set: Any = None
        self._few: Any = None  # a wait set for subscriptions alone
        self._subscriptions: list[Any] = []  # as of the last look at everything
        self._capacity: tuple[int, ...] = ()
        self._looked_s = 0.0  # when everything was last looked at
        self._heard_s = 0.0  # when a message was last handled

    def add_node(self, node: Node) -> None:
        """Handle a node's callbacks from now on."""
        self._nodes.append(node)

    def wake(self) -> None:
        """End the wait of `spin`, from any thread, so that it looks at its condition."""
        self._guard.trigger()

    def spin(self, stop: Callable[[], bool], quiet_s: float | None = None) -> None:
        """Handle what comes until `stop` holds, or no message came for `quiet_s` seconds.

        Raises:
            Exception: whatever a callback raises.
        """
        heard_s = self._heard_s = time.monotonic()
        quiet_turns = 0
        with self._context.handle:
            while not stop():
                self._turn(None if quiet_s is None else quiet_s / QUIET_TURNS)
                if quiet_s is not None:
                    quiet_turns = quiet_turns + 1 if heard_s == self._heard_s else 0
                    heard_s = self._heard_s
                    if quiet_turns >= QUIET_TURNS and time.monotonic() - heard_s > quiet_s:
                        return
                if self.rest_s and not self._behind and quiet_s is None:  # to wait for quiet is a rest
                    time.sleep(self.rest_s)
                self._behind = False

    def spin_once(self, timeout_s: float) -> None:
        """Handle what is ready, or becomes so within `timeout_s` seconds."""
        with self._context.handle:
            self._turn(timeout_s)

    def _turn(self, timeout_s: float | None) -> None:
        """Wait for what comes within `timeout_s` seconds, and handle all that is ready.

        Each entity in a wait costs time, and most of a node's are services that hardly anybody calls. So
        while messages keep coming, only subscriptions are waited for, until that has been so for `BUSY_S`.
        """
        busy = self._subscriptions and time.monotonic() - self._looked_s < BUSY_S
        if busy and self._take_what_comes():
            return
        self._look_at_all(timeout_s)
        self._looked_s = time.monotonic()
        subscriptions = [entity for node in self._nodes for entity in node.subscriptions]
        if len(subscriptions) > len(self._subscriptions):
            self._few = rclpy_private.wait_set(self._context, len(subscriptions), 1, 0, 0, 0)
        self._subscriptions = subscriptions

    def _take_what_comes(self) -> bool:
        """Wait for messages, and handle them; False if none came within `BUSY_S`.

        Whoever wakes us has ended this wait: no other may follow before `spin` has looked at its condition.
        """
        wait_set = self._few
        wait_set.clear_entities()
        for subscription in self._subscriptions:
            wait_set.add_subscription(subscription.handle)
        wait_set.add_guard_condition(self._guard.handle)
        wait_set.wait(BUSY_NS)
        ready = [
            entity for at, entity in enumerate(self._subscriptions) if wait_set.is_ready("subscription", at)
        ]
        for subscription in ready:
            self._take_messages(subscription)
        return bool(ready) or wait_set.is_ready("guard_condition", 0)

    def _look_at_all(self, timeout_s: float | None) -> None:
        """Wait for anything, and handle it."""
        timers = [timer for node in self._nodes for timer in node.timers]
        subscriptions = [subscription for node in self._nodes for subscription in node.subscriptions]
        services = [service for node in self._nodes for service in node.services]
        clients = [client for node in self._nodes for client in node.clients]
        wait_set = self._emptied(len(subscriptions), 1, len(timers), len(clients), len(services))
        timer_at = [wait_set.add_timer(timer.handle) for timer in timers]
        subscription_at = [wait_set.add_subscription(entity.handle) for entity in subscriptions]
        service_at = [wait_set.add_service(entity.handle) for entity in services]
        client_at = [wait_set.add_client(entity.handle) for entity in clients]
        wait_set.add_guard_condition(self._guard.handle)
        wait_set.wait(-1 if timeout_s is None else round(timeout_s * 1e9))
        # All that is ready is noted before any callback may change what there is.
        ready = [
            *((_call_timer, timers[i]) for i, at in enumerate(timer_at) if wait_set.is_ready("timer", at)),
            *(
                (self._take_messages, subscriptions[i])
                for i, at in enumerate(subscription_at)
                if wait_set.is_ready("subscription", at)
            ),
            *((_serve, services[i]) for i, at in enumerate(service_at) if wait_set.is_ready("service", at)),
            *((_answer, clients[i]) for i, at in enumerate(client_at) if wait_set.is_ready("client", at)),
        ]
        for handle, entity in ready:
            try:
                handle(entity)
            except InvalidHandle:  # an earlier callback of this turn has destroyed it
                continue

    def _take_messages(self, subscription: Any) -> None:
        handle = subscription.handle
        with_info = rclpy_private.takes_info(subscription)
        until_s = time.monotonic() + TURN_MAX_S
        with handle:  # raises InvalidHandle, if it was destroyed since it became ready
            for _ in range(self._at_once):
                taken = handle.take_message(subscription.msg_type, subscription.raw)
                if taken is None:
                    return
                self._heard_s = time.monotonic()
                if with_info:
                    subscription.callback(*taken)
                else:
                    subscription.callback(taken[0])
                if self._heard_s > until_s:
                    break
        self._behind = True

    def _emptied(self, *capacity: int) -> Any:
        """The wait set, empty, with room for subscriptions, guards, timers, clients, services."""
        if any(has < wants for has, wants in zip(self._capacity or (0,) * 5, capacity, strict=True)):
            self._capacity = capacity
            self._wait_set = rclpy_private.wait_set(self._context, *capacity)
        self._wait_set.clear_entities()
        return self._wait_set


def _call_timer(timer: Any) -> None:
    with timer.handle:
        if not timer.handle.is_timer_ready():
            return
        timer.handle.call_timer()
    timer.callback()


def _serve(service: Any) -> None:
    with service.handle:
        request, header = service.handle.service_take_request(service.srv_type.Request)
    if header is not None:
        service.send_response(service.callback(request, service.srv_type.Response()), header)


def _answer(client: Any) -> None:
    with client.handle:
        header, response = client.handle.take_response(client.srv_type.Response)
    if header is None:
        return
    try:
        future = client.get_pending_request(header.request_id.sequence_number)
    except KeyError:
        return  # nobody waits for it any more
    future.set_result(response)


def shut_down(context: Context, timeout_s: float) -> None:
    """Shut a context down in a thread: the middleware was seen to hang while several participants leave."""

    def leave() -> None:
        gc.collect()  # the middleware's part of a node ends with the last reference to it
        context.try_shutdown()
        context.destroy()

    thread = threading.Thread(target=leave, daemon=True)
    thread.start()
    thread.join(timeout_s)
