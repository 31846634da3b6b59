"""What all nodes share: topics from the tables, checked payloads, peers, and the way to the end."""

import contextlib
import os
import select
import signal
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

import rclpy
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.executors import ConditionReachedException, SingleThreadedExecutor, TimeoutException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from uav_dc_ros import messages, scenarios, topics
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError, ParameterError, UavDcError
from uav_dc_ros.nodes.table import NODES
from uav_dc_ros.topics import TOPICS, Topic

SUPERVISED = "UAV_DC_ROS_SUPERVISED"  # set by run_all: the node ends when its standard input does
PEERS_PERIOD_S = 0.02
# Messages arrive at once, but the middleware may ask for receipts every three seconds only.
ACKNOWLEDGE_S = 0.5
DRAIN_S = 2.0
DRAIN_QUIET_S = 0.05
LEAVE_S = 1.0
# Messages kept by a subscription that acts on them: a burst of rubbish must not push out a real one.
NEWEST = 100
MESSAGE_TYPES: dict[str, type] = {topics.JSON: String, topics.POSE: PoseStamped}
ANOTHER_MISSION = (
    "another mission is being flown here: somebody else publishes `mission`. Give this one a network of its "
    "own (export ROS_DOMAIN_ID=1, or any number up to 101), or a namespace"
)
EXPECTED: dict[type, str] = {int: "a whole number", str: "text", list: "a list of texts"}

V = TypeVar("V")


def offered_qos(topic: Topic) -> QoSProfile:
    """The QoS that a topic's publisher offers, from its row."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=topic.depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def requested_qos(topic: Topic, *, all: bool) -> QoSProfile:
    """The QoS that a subscription asks for; `all` as in the node table's `hears_all`."""
    profile = offered_qos(topic)
    profile.depth = NEWEST
    if all:
        profile.history = HistoryPolicy.KEEP_ALL
    return profile


class MissionNode(Node):
    """A node of the table: its row says what it publishes and what it hears.

    Each topic that it hears is a method `on_TOPIC`, called with the checked payload (a JSON topic) or
    the message (any other). What does not check is counted by reason, told once, and dropped.

    Attributes:
        drains: does the node still handle, when asked to stop, what has arrived by then?
        rejected: refused messages, by topic and reason.
    """

    drains = False

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.row = NODES[name]
        self.rejected: Counter[tuple[str, str]] = Counter()
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._publishers_of: dict[str, Publisher] = {}
        self._subscriptions_of: dict[str, Any] = {}
        self._peers = self._peers_parameter()
        for topic in self.row.publishes:
            row = TOPICS[topic]
            self._publishers_of[topic] = self.create_publisher(
                MESSAGE_TYPES[row.type], topic, offered_qos(row)
            )

    def listen(self) -> None:
        """Subscribe to the row's topics and look for peers: the last act of a node's `__init__`."""
        for topic in self.row.subscribes:
            self._subscriptions_of[topic] = self._subscribe(TOPICS[topic])
        self._peers_timer = self.create_timer(PEERS_PERIOD_S, self._look_for_peers, clock=self.steady)

    def _subscribe(self, topic: Topic) -> Any:
        handle = getattr(self, f"on_{topic.name}")

        def hear(message: Any) -> None:
            try:
                if topic.type == topics.JSON:
                    message = messages.decode(message.data, messages.PAYLOADS[topic.name])
                handle(message)
            except MessageError as error:
                self.reject(topic.name, error)

        qos = requested_qos(topic, all=self.row.hears_all)
        return self.create_subscription(MESSAGE_TYPES[topic.type], topic.name, hear, qos)

    def say(self, topic: str, payload: messages.Payload) -> None:
        """Publish a checked payload on a JSON topic."""
        self._publishers_of[topic].publish(String(data=messages.encode(payload)))

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message on any other topic."""
        self._publishers_of[topic].publish(message)

    def reject(self, topic: str, error: MessageError) -> None:
        """Count a message that was refused, and tell the first of its kind."""
        kind = (topic, error.reason)
        self.rejected[kind] += 1
        if self.rejected[kind] == 1:
            self.get_logger().warning(f"{topic}: {error.reason}: {error} (told once, then counted)")

    # Peers: a node is ready once each of its topics reaches every peer that takes part.

    def _peers_parameter(self) -> list[str]:
        default = [name for name, row in NODES.items() if row.process and name != "recorder"]
        peers = self.parameter(
            "peers", default, "nodes of this mission, by name; it starts when all of them are there"
        )
        for peer in peers:
            if peer not in NODES:
                raise ParameterError(f"peers: {peer!r}; expected some of {', '.join(NODES)}")
        return [peer for peer in peers if peer != self.row.name]

    def _look_for_peers(self) -> None:
        for topic, publisher in self._publishers_of.items():
            hearing = sum(topic in NODES[peer].subscribes for peer in self._peers)
            if publisher.get_subscription_count() < hearing:
                return
        for topic, subscription in self._subscriptions_of.items():
            saying = sum(topic in NODES[peer].publishes for peer in self._peers)
            if subscription.get_publisher_count() < saying:
                return
        self._peers_timer.cancel()
        self.on_peers()

    def on_peers(self) -> None:
        """All peers are there."""
        self.say("ready", messages.Ready(node=self.row.name))

    # Parameters: declared once, with a description, read once.

    def parameter(self, name: str, default: V, description: str) -> V:
        """Declare a read-only parameter of the default's type, and return its value.

        Raises:
            ParameterError: a value of another type.
        """
        descriptor = ParameterDescriptor(description=description, read_only=True, dynamic_typing=True)
        value: Any = self.declare_parameter(name, default, descriptor).value
        if isinstance(default, list):
            value = list(value) if isinstance(value, list | tuple) else value
        elif isinstance(default, str) and isinstance(value, bool | int | float):
            value = str(value)  # `-p pace:=90` arrives as a number
        if type(value) is not type(default):
            raise ParameterError(f"{name}: {value!r}; expected {EXPECTED[type(default)]}")
        return value

    def whole_number(self, name: str, default: int, least: int, description: str) -> int:
        """Declare a parameter that is a whole number of at least `least`."""
        value = self.parameter(name, default, description)
        if value < least:
            raise ParameterError(f"{name}: {value}; expected a whole number of at least {least}")
        return value

    def scenario_parameter(self, default: str = "five_clusters") -> Scenario:
        """Declare the parameter `scenario`, and load what it names."""
        return scenarios.load(
            self.parameter("scenario", default, "name of a shipped scenario, or path of a TOML file")
        )

    # The way to the end.

    def on_stop(self) -> None:
        """Act once more before the node ends: the topics still work."""

    def finish(self) -> None:
        """Say the last word, and give everyone the time to hear it."""
        self.on_stop()
        deadline_s = time.monotonic() + ACKNOWLEDGE_S
        for publisher in self._publishers_of.values():
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline_s - time.monotonic())))
        if self.rejected:
            told = ", ".join(f"{topic} {reason} {n}" for (topic, reason), n in self.rejected.items())
            self.get_logger().warning(f"rejected messages: {told}")


class Stopper:
    """Turns SIGINT, SIGTERM and, under run_all, the end of standard input into a wish to stop.

    A waiting executor sleeps in C, where Python's handlers do not run: signals arrive through a file
    descriptor in a thread that wakes it.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self.requested = False
        self._wake = wake
        self._ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        self._theirs = theirs
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        sources: list[Any] = [self._ours]
        if os.environ.get(SUPERVISED):
            sources.append(open(0, "rb", buffering=0, closefd=False))  # noqa: SIM115  (for life)
        while True:
            for source in select.select(sources, [], [])[0]:
                told = source.recv(1) if source is self._ours else source.read(1)
                if source is self._ours or not told:
                    self.requested = True
                    self._wake()
                if not told:
                    sources.remove(source)


def _spin(executor: SingleThreadedExecutor, stop: Callable[[], bool], timeout_s: float | None = None) -> None:
    """Handle what comes until `stop` holds, or nothing came for `timeout_s`.

    The executor's own spin looks at no condition, and its wait for a future leaks a callback a turn.
    """
    with contextlib.suppress(ConditionReachedException, TimeoutException):
        while not stop():
            handler, _, _ = executor.wait_for_ready_callbacks(timeout_s, None, stop)
            handler()
            if handler.exception() is not None:
                raise handler.exception()


def main(make: Callable[[], MissionNode]) -> NoReturn:
    """Run one node until it is asked to stop: the body of `python -m uav_dc_ros.nodes.NAME`."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor()
    stopper = Stopper(executor.wake)
    status, failed = 0, 2  # 2: it never began
    try:
        node = make()
        failed = 1
        executor.add_node(node)
        try:
            _spin(executor, lambda: stopper.requested)
            if node.drains:
                deadline_s = time.monotonic() + DRAIN_S
                _spin(executor, lambda: time.monotonic() > deadline_s, DRAIN_QUIET_S)
        finally:
            node.finish()  # also when it failed: a recorder still closes its bag
    except UavDcError as error:
        print(f"error: {error}", file=sys.stderr)
        status = failed
    # All is said and written. The middleware has been seen to hang while several of its participants leave
    # at once; that must not turn a good ending into a killed process.
    sys.stderr.flush()
    threading.Timer(LEAVE_S, os._exit, (status,)).start()
    rclpy.try_shutdown()
    os._exit(status)
