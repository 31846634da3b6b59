"""What all nodes have besides their life cycle: topics from the table, peers, diagnostics."""

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_srvs.srv import Trigger

from uav_dc_ros import cdr, messages, topics
from uav_dc_ros.errors import MessageError, UavDcError
from uav_dc_ros.nodes.framework import diagnostics, other_publishers
from uav_dc_ros.nodes.framework.diagnostics import MessageStatistics
from uav_dc_ros.nodes.framework.lifecycle_node import ManagedNode
from uav_dc_ros.nodes.framework.node_table import mission_rows
from uav_dc_ros.nodes.framework.process_control import SUPERVISED
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS, Topic

CDR_HEADER = 8  # bytes before the text of a serialised std_msgs/String
PEERS_PERIOD_S = 0.02
# For the acknowledgement of the last messages: a bad link delays it, and a peer that was killed sends none.
ACKNOWLEDGE_S = 1.5


class MissionNode(ManagedNode):
    """A node that publishes and subscribes to the topics of its row.

    While the node is active, each topic calls a method `on_TOPIC` with the checked payload (a JSON topic) or
    the pose (a pose topic). Invalid messages are counted by reason, logged once, and dropped. Subscriptions
    take messages serialised, so that those that cannot be decoded are counted, too.

    Each service of its row calls a method `call_SERVICE`, which returns the message of the response. After a
    UavDcError the response is without success.

    Messages of another run are counted and dropped. Without the parameter `run` the vehicle draws a run, and
    another node adopts that of the only publisher that it receives from.
    """

    drain_quiet_s = 0.0  # before it stops it handles messages until none came for so long
    pause_s = 0.0  # of its executor, see `DirectExecutor`

    def __init__(
        self, name: str, overrides: Sequence[rclpy.Parameter] = (), context: Context | None = None
    ) -> None:
        super().__init__(name, overrides, context)
        self.statistics = MessageStatistics()
        self.is_supervised = SUPERVISED in os.environ  # by run_all
        self.restarts = int(os.environ.get(SUPERVISED) or 0)  # of its process
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.message_bytes: dict[str, int] = {}  # about, of large messages, by topic; `configure` sets it
        self.not_published: set[str] = set()  # topics of the row that do not apply; `configure` sets it
        self.published_ns = 0  # publication time of the message being handled, nanoseconds since the epoch
        # Handles callbacks for so many seconds, inside a callback; `node_main` sets it.
        self.spin_once: Callable[[float], None] = time.sleep
        self.publishers_of: dict[str, Publisher] = {}
        self.subscriptions_of: dict[str, Any] = {}
        self.run: str = self.values["run"]  # empty while it is not known
        self._given_run = f'{{"run":"{self.run}"'.encode() if self.run else b""  # as our own payloads begin
        self.peers = [peer for peer in self.values["peers"] if peer != name]
        self.rows = mission_rows([name, *self.peers])  # the node table of this mission
        self._peers_found, self._ready_peers = False, set[str]()
        self._incompatible: set[tuple[str, str, str]] = set()  # at the last check: topic, peer, reason
        self._logged_incompatible: set[tuple[str, str]] = set()

    def prepare(self) -> None:
        """Import what `configure` needs, while the node waits for it."""

    # The life cycle.

    def _configure(self) -> None:
        super()._configure()
        self._until_cleanup.callback(self.publishers_of.clear)
        for name in self.row.publishes:
            topic = TOPICS[name]
            kind, profile = qos.message_class(topic), qos.offered(topic, self.message_bytes.get(name, 0))
            if kind is None or name in self.not_published:
                continue
            with qos.overridable(name) as options:
                publisher = qos.create_publisher(self, kind, name, profile, **options)
            self.publishers_of[name] = publisher
            self._until_cleanup.callback(self.destroy_publisher, publisher)
        timer = self.create_timer(diagnostics.PERIOD_S, self._publish_diagnostics, clock=self.steady)
        self._until_cleanup.callback(self.destroy_timer, timer)

    @property
    def is_vehicle(self) -> bool:
        """Whether this node is the vehicle of the mission."""
        return "mission" in self.row.publishes

    def _activate(self) -> None:
        self.run = self.values["run"] or (messages.new_run() if self.is_vehicle else "")
        self._peers_found, self._ready_peers = False, set[str]()
        super()._activate()
        self._until_inactive.callback(self.subscriptions_of.clear)
        for name in self.row.subscribes:
            if qos.message_class(TOPICS[name]) is None:
                continue
            subscription = self.subscribe(TOPICS[name])
            self.subscriptions_of[name] = subscription
            self._until_inactive.callback(self.destroy_subscription, subscription)
        for name in self.row.services:
            service = self.create_service(Trigger, name, partial(self._serve, name.removeprefix("~/")))
            self._until_inactive.callback(self.destroy_service, service)
        endpoints = [*self.subscriptions_of.values(), *self.publishers_of.values()]
        self._reject_unknown("qos", [f"qos_overrides.{end.topic_name}" for end in endpoints])
        self._peers_timer = self.timer(PEERS_PERIOD_S, self._find_peers)

    def _flush(self) -> None:
        deadline_s = time.monotonic() + ACKNOWLEDGE_S
        for publisher in self.publishers_of.values():
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline_s - time.monotonic())))

    def _serve(self, name: str, request: Any, response: Any) -> Any:
        try:
            response.message, response.success = getattr(self, f"call_{name}")(), True
            self.get_logger().info(f"service {name}: {response.message}")
        except UavDcError as error:
            response.message, response.success = str(error), False
            self.get_logger().warning(f"service {name}: refused: {response.message}")
        return response

    def is_awaiting(self) -> bool:
        """Whether messages are still expected after `drain_quiet_s`: the node then stops later."""
        return False

    def is_caught_up(self) -> bool:
        """Whether the node is active and connected to all peers, also after a restart."""
        return self._is_active and self._peers_found

    # Topics.

    def timer(self, period_s: float, callback: Callable[[], None], clock: Clock | None = None) -> Any:
        """Create a timer that ends with the node's activity; default: on the steady clock."""
        timer = self.create_timer(period_s, callback, clock=clock or self.steady)
        self._until_inactive.callback(self.destroy_timer, timer)
        return timer

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row."""
        handle = getattr(self, f"on_{topic.name}")
        payload = messages.PAYLOADS.get(topic.name)
        assert payload is not None or topic.type == topics.POSE, "no other type has a decoder here"

        def receive(data: bytes, info: Any) -> None:
            self.published_ns = info["source_timestamp"]
            try:
                if payload is None:
                    handle(cdr.Pose(data))
                else:
                    decoded = messages.decode(cdr.decode_string(data), payload)
                    self.check_run(topic.name, decoded.run)
                    handle(decoded)
            except MessageError as error:
                self.reject(topic.name, error)
            self.statistics.count_received(topic.name, info)

        return self.create_raw_subscription(topic, receive)

    def check_run(self, topic: str, run: str) -> None:
        """Raise MessageError for another run. Without a run, adopt that of the only publisher."""
        if run == self.run or (topic == "ready" and not run):
            return
        if self.is_vehicle or self.values["run"] or self.count_publishers(topic) > 1:
            raise MessageError(
                "another_run", f"it belongs to run {run!r}; expected {self.run!r}, the run of this mission"
            )
        self.run = run

    def is_of_another_run(self, topic: str, data: bytes) -> bool:
        """Whether a serialised message belongs to another run than the parameter `run`; then it is counted.

        For nodes that handle messages as bytes. Without the parameter they accept every run.
        """
        if not self._given_run or topic not in messages.PAYLOADS:
            return False
        if data.startswith(self._given_run, CDR_HEADER):
            return False
        other = messages.read_run(data[CDR_HEADER:].rstrip(b"\0"))
        try:
            if other is not None:  # otherwise it is malformed: its decoder rejects it
                self.check_run(topic, other)
        except MessageError as error:
            self.reject(topic, error)
            return True
        return False

    def create_raw_subscription(self, topic: Topic, callback: Callable[[bytes, Any], None]) -> Any:
        """Subscribe with the table's QoS, as overridden; the callback takes serialised messages and info."""
        kind, profile = qos.message_class(topic), qos.requested(topic, keep_all=self.row.keeps_all)
        with qos.overridable(topic.name) as options:
            return qos.create_subscription(self, kind, topic.name, callback, profile, **options)

    def subscribe_serialised(self, topic: Topic, handle: Callable[[bytes, Any], None]) -> Any:
        """Subscribe to the serialised messages of this run; `handle` takes a message and its info."""

        def receive(data: bytes, info: Any) -> None:
            if self.is_of_another_run(topic.name, data):
                return
            try:
                handle(data, info)
            except MessageError as error:
                self.reject(topic.name, error)
            self.statistics.count_received(topic.name, info)

        return self.create_raw_subscription(topic, receive)

    def publish_payload(self, topic: str, payload: messages.Payload) -> None:
        """Check and publish a payload on a JSON topic."""
        self.publish_encoded(topic, messages.encode(payload))

    def publish_encoded(self, topic: str, text: bytes) -> None:
        """Publish an encoded payload on a JSON topic."""
        self.publish(topic, cdr.encode_string(text))

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message, or its serialised form, on a topic that applies."""
        self.statistics.published[topic] += 1
        self.publishers_of[topic].publish(message)

    def reject(self, topic: str, error: MessageError) -> None:
        """Count a rejected message, and log the first one of its topic and reason."""
        kind = (topic, error.reason)
        self.statistics.rejected[kind] += 1
        if self.statistics.rejected[kind] == 1:
            self.get_logger().warning(f"{topic}: {error.reason}: {error} (logged once, then counted)")

    # Peers: a node is ready once each of its topics has matched every peer that takes part in it.

    def _find_peers(self) -> None:
        for topic, publisher in self.publishers_of.items():
            peers = [peer for peer in self.peers if topic in self.rows[peer].subscribes]
            if publisher.get_subscription_count() < len(peers):
                return
            if peers and not self._are_matched(peers, self.get_subscriptions_info_by_topic(topic)):
                return
        for topic, subscription in self.subscriptions_of.items():
            peers = [peer for peer in self.peers if topic in self.rows[peer].publishes]
            if subscription.get_publisher_count() < len(peers):
                return
            if peers and not self._are_matched(peers, self.get_publishers_info_by_topic(topic)):
                return
        self._peers_timer.cancel()
        self._peers_found = True
        self.on_peers()

    def _are_matched(self, peers: Sequence[str], endpoints: Sequence[TopicEndpointInfo]) -> bool:
        """Whether the endpoints of a topic include these peers; other nodes have endpoints, too."""
        namespace = self.get_namespace().rstrip("/")
        return {f"{namespace}/{peer}" for peer in peers} <= {qos.full_name(end) for end in endpoints}

    def check_other_publishers(self) -> None:
        """Raise AnotherMissionError if other nodes publish this mission's topics.

        The graph may still list nodes that were killed: a second node of a name counts only for this one.
        """
        others = [name for name in self.rows if name != self.row.name]
        publishers = other_publishers.publishers(self)
        if found := other_publishers.find(publishers, self.get_namespace(), self.rows, restarted=others):
            raise other_publishers.AnotherMissionError(found.description())

    def on_ready(self, payload: messages.Ready) -> None:
        """Note that a peer is ready; raises MessageError for a node that is not in the table."""
        if payload.node not in self.rows:
            raise MessageError("unknown_node", f"{payload.node!r}; expected some of {', '.join(self.rows)}")
        self._ready_peers.add(payload.node)

    @property
    def all_ready(self) -> bool:
        """Whether this vehicle has found its peers, and all of them are ready."""
        return self._peers_found and self._ready_peers.issuperset(self.peers)

    def on_peers(self) -> None:
        """Publish `ready`: all peers have been found."""
        if "ready" in self.row.publishes:
            # Not an adopted run, which may be over: the vehicle of the next run accepts `ready` without one.
            self.publish_payload("ready", messages.Ready(run=self.values["run"], node=self.row.name))

    # Diagnostics.

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """Warnings and values by name that this node adds to its diagnostics."""
        return [], {}

    def _publish_diagnostics(self) -> None:
        has_rejected, values = self.statistics.report()
        warnings, own = self.diagnose()
        found = set(qos.incompatible(self, self.publishers_of.values(), self.subscriptions_of.values()))
        # Only a lasting mismatch counts: a recorder adapts to a best-effort publisher within a moment.
        lasting, self._incompatible = found & self._incompatible, found
        for topic, peer, reason in sorted(lasting):
            if (topic, peer) not in self._logged_incompatible:
                self._logged_incompatible.add((topic, peer))
                self.get_logger().warning(f"{topic}: {peer} does not match: {reason} (logged once)")
        warnings = [*warnings, *(f"{peer} does not match on {at}" for at, peer in self._logged_incompatible)]
        if has_rejected:
            warnings.append("messages were rejected")
        values = {"state": self.state, "restarts": str(self.restarts)} | own | values
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK,
            name=self.get_fully_qualified_name()[1:],
            message="; ".join(warnings) or self.state,
            hardware_id="uav_dc_ros",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self.publish("diagnostics", message)
