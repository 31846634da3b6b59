"""An executor that handles what is ready straight from the wait set.

rclpy's SingleThreadedExecutor makes a task, a coroutine and three guard triggers of every callback, and wakes
itself once more for each; in a lockstep of small messages that takes longer than the messages. rclpy's
EventsExecutor is experimental, and called no callback in the wheels of 7.1.6. `benchmarks/lockstep.py`
compares this executor with rclpy's own.
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

# Limits of one topic's messages in a turn, by number and time, so that the other topics are handled, too.
TURN_MAX, TURN_MAX_S = 100, 0.2
# Turns without a message that count as quiet: on a busy computer the middleware's thread may be delayed.
QUIET_TURNS = 10
BUSY_S = 0.003  # while messages keep coming, timers and services are checked this often
BUSY_NS = round(BUSY_S * 1e9)
# A kind of entities, as the wait set names it, the entities, and what handles one that is ready.
_Kind = tuple[str, list[Any], Callable[[Any], None]]


class DirectExecutor:
    """Runs callbacks one after the other in one thread: timers, subscriptions, services, clients.

    Callbacks are plain functions. Event callbacks of publishers and subscriptions are not handled:
    `qos.incompatible` finds peers that do not match.

    It pauses for `pause_s` seconds after each turn that handled all messages. A node that need not respond at
    once handles the messages of the pause in one turn, and leaves the cores to the other nodes.
    """

    def __init__(self, pause_s: float = 0.0, context: Context | None = None) -> None:
        self.pause_s = pause_s
        self._messages_max = TURN_MAX if pause_s else 1  # of a topic in a turn
        self._is_behind = False  # messages wait for the next turn
        self._context: Any = context or get_default_context()
        self._guard = GuardCondition(callback=None, callback_group=None, context=self._context)
        self._nodes: list[Node] = []
        self._wait_set: Any = None
        self._subscriptions_wait_set: Any = None
        self._subscriptions: list[Any] = []  # as of the last full wait
        self._capacity: tuple[int, ...] = (0,) * 5  # of the wait set
        self._full_wait_s = 0.0  # time of the last full wait
        self._received_s = 0.0  # time of the last message

    def add_node(self, node: Node) -> None:
        """Handle a node's callbacks from now on."""
        self._nodes.append(node)

    def wake(self) -> None:
        """End the wait of `spin`, from any thread, so that it checks its condition."""
        self._guard.trigger()

    def spin(self, stop: Callable[[], bool], quiet_s: float | None = None) -> None:
        """Run callbacks until `stop` holds, or no message came for `quiet_s` seconds."""
        received_s = self._received_s = time.monotonic()
        quiet_turns = 0
        with self._context.handle:
            while not stop():
                self._turn(None if quiet_s is None else quiet_s / QUIET_TURNS)
                if quiet_s is not None:
                    quiet_turns = quiet_turns + 1 if received_s == self._received_s else 0
                    received_s = self._received_s
                    if quiet_turns >= QUIET_TURNS and time.monotonic() - received_s > quiet_s:
                        return
                elif self.pause_s and not self._is_behind:
                    time.sleep(self.pause_s)
                self._is_behind = False

    def spin_once(self, timeout_s: float) -> None:
        """Run the callbacks that are ready, or become so within `timeout_s` seconds."""
        with self._context.handle:
            self._turn(timeout_s)

    def _turn(self, timeout_s: float | None) -> None:
        """Wait for at most `timeout_s` seconds, and run all callbacks that are ready.

        Each entity in a wait set costs time, and most of a node's are services that are rarely called. So
        while messages keep coming, it waits for subscriptions only, for at most `BUSY_S`.
        """
        is_busy = self._subscriptions and time.monotonic() - self._full_wait_s < BUSY_S
        if is_busy:
            subscriptions: _Kind = "subscription", self._subscriptions, self._take_messages
            if self._wait(self._subscriptions_wait_set, [subscriptions], BUSY_NS):
                return
        kinds: list[_Kind] = [
            ("timer", self._entities("timers"), _call_timer),
            ("subscription", self._entities("subscriptions"), self._take_messages),
            ("service", self._entities("services"), _serve),
            ("client", self._entities("clients"), _complete),
        ]
        n_timers, n_subscriptions, n_services, n_clients = (len(entities) for _, entities, _ in kinds)
        capacity = n_subscriptions, 1, n_timers, n_clients, n_services
        if any(has < needed for has, needed in zip(self._capacity, capacity, strict=True)):
            self._capacity = capacity
            self._wait_set = rclpy_private.wait_set(self._context, *capacity)
        timeout_ns = -1 if timeout_s is None else round(timeout_s * 1e9)
        self._wait(self._wait_set, kinds, timeout_ns)
        self._full_wait_s = time.monotonic()
        present = self._entities("subscriptions")
        if len(present) > len(self._subscriptions):
            self._subscriptions_wait_set = rclpy_private.wait_set(self._context, len(present), 1, 0, 0, 0)
        self._subscriptions = present

    def _entities(self, kinds: str) -> list[Any]:
        return [entity for node in self._nodes for entity in getattr(node, kinds)]

    def _wait(self, wait_set: Any, kinds: list[_Kind], timeout_ns: int) -> bool:
        """Wait for entities, handle those that are ready; false after the timeout, but true after `wake`."""
        wait_set.clear_entities()
        places = []
        for kind, entities, _ in kinds:
            add = getattr(wait_set, f"add_{kind}")
            places.append([add(entity.handle) for entity in entities])
        wait_set.add_guard_condition(self._guard.handle)
        wait_set.wait(timeout_ns)
        is_ready = wait_set.is_ready
        # All that is ready is listed before a callback may create or destroy entities.
        ready = [
            (handle, entity)
            for (kind, entities, handle), at in zip(kinds, places, strict=True)
            for entity, place in zip(entities, at, strict=True)
            if is_ready(kind, place)
        ]
        is_woken: bool = is_ready("guard_condition", 0)
        for handle, entity in ready:
            try:
                handle(entity)
            except InvalidHandle:  # destroyed by an earlier callback of this turn
                continue
        return bool(ready) or is_woken

    def _take_messages(self, subscription: Any) -> None:
        handle = subscription.handle
        with_info = rclpy_private.takes_info(subscription)
        until_s = time.monotonic() + TURN_MAX_S
        with handle:  # raises InvalidHandle, if it was destroyed since it became ready
            for _ in range(self._messages_max):
                taken = handle.take_message(subscription.msg_type, subscription.raw)
                if taken is None:
                    return
                self._received_s = time.monotonic()
                if with_info:
                    subscription.callback(*taken)
                else:
                    subscription.callback(taken[0])
                if self._received_s > until_s:
                    break
        self._is_behind = True


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


def _complete(client: Any) -> None:
    with client.handle:
        header, response = client.handle.take_response(client.srv_type.Response)
    if header is None:
        return
    try:
        future = client.get_pending_request(header.request_id.sequence_number)
    except KeyError:
        return  # the request was removed
    future.set_result(response)


def shut_down(context: Context, timeout_s: float, nodes: list[Any] | None = None) -> None:
    """Destroy nodes, which are removed from the list, and shut their context down.

    It happens in a thread: the middleware was seen to hang while several participants leave.
    """

    def leave() -> None:
        while nodes:
            nodes.pop(0).destroy_node()
        gc.collect()  # the middleware's part of a node ends with the last reference to it
        context.try_shutdown()
        context.destroy()

    thread = threading.Thread(target=leave, daemon=True)
    thread.start()
    thread.join(timeout_s)
