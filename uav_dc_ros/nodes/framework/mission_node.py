"""What all nodes share beside their life cycle: topics from the table, peers, diagnostics."""

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rclpy.topic_endpoint_info import TopicEndpointInfo

from uav_dc_ros import cdr, messages, topics
from uav_dc_ros.errors import MessageError
from uav_dc_ros.nodes.framework import diagnostics, other_publishers
from uav_dc_ros.nodes.framework.diagnostics import MessageStatistics
from uav_dc_ros.nodes.framework.lifecycle_node import ManagedNode
from uav_dc_ros.nodes.framework.node_table import rows
from uav_dc_ros.nodes.framework.process_control import SUPERVISED
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS, Topic

CDR_HEAD = 8  # bytes before the text of a serialised std_msgs/String
PEERS_PERIOD_S = 0.02
# For the last words to be acknowledged: a bad link takes a while, and a peer that was killed never does.
ACKNOWLEDGE_S = 1.5


class MissionNode(ManagedNode):
    """A node that its row tells what to publish and what to hear.

    Each topic that it hears is a method `on_TOPIC`, called while it is active with the checked payload (a
    JSON topic) or the pose (a pose topic). What does not check is counted by reason, told once, and dropped.
    All messages are taken serialised, so that what cannot be decoded is counted, too.

    Args:
        name: of its row.
        overrides: values of parameters, over those of the command line.
        context: of ROS; None: the process's own.

    Messages of another run of missions are counted and dropped. A node that was given no run has, as the
    vehicle, one of its own, and otherwise that of the only publisher which it receives from.

    Attributes:
        run: identity of the run that is flown; empty while it is not known.
        drains: does the node still handle, when asked to stop, what has arrived by then?
        rest_s: pause after each turn of its executor: see there.
        meter: what it counts for its diagnostics.
        is_supervised: does run_all look after it?
        restarts: how often it has been started again.
        peers: the other nodes of the mission.
        rows: the node table, as it is in this mission.
        message_bytes: about how large a message is that it publishes, by topic, where that may be much;
            to be told when it is configured.
        published_ns: when the message that is being handled was published, nanoseconds since the epoch.
        serve: handles what comes within so many seconds: for who has to wait inside a callback, and depends
            on what comes. Set by `runtime`.
    """

    drains = False
    rest_s = 0.0

    def __init__(
        self, name: str, overrides: Sequence[rclpy.Parameter] = (), context: Context | None = None
    ) -> None:
        super().__init__(name, overrides, context)
        self.meter = MessageStatistics()
        self.is_supervised = SUPERVISED in os.environ
        self.restarts = int(os.environ.get(SUPERVISED) or 0)
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.message_bytes: dict[str, int] = {}
        self.published_ns = 0
        self.serve: Callable[[float], None] = time.sleep
        self.publishers_of: dict[str, Publisher] = {}
        self.subscriptions_of: dict[str, Any] = {}
        self.run: str = self.values["run"]
        self._given_run = f'{{"run":"{self.run}"'.encode() if self.run else b""  # as our own payloads begin
        self.peers = [peer for peer in self.values["peers"] if peer != name]
        self.rows = rows([name, *self.peers])
        self._timers_active: list[Any] = []
        self._diagnostics_timer: Any = None
        self._seen_incompatible: set[tuple[str, str, str]] = set()  # at the last look: topic, peer, reason
        self._told_incompatible: set[tuple[str, str]] = set()

    def prepare(self) -> None:
        """Import what configuring needs, while the node waits to be configured: not every node has any."""

    # What the life cycle brings and takes.

    def _configure(self) -> None:
        super()._configure()
        for name in self.row.publishes:
            topic = TOPICS[name]
            with qos.overridden(name):
                self.publishers_of[name] = self.create_publisher(
                    qos.MESSAGE_TYPES[topic.type],
                    name,
                    qos.offered(topic, self.message_bytes.get(name, 0)),
                    event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
                    qos_overriding_options=qos.OVERRIDES,
                )
        self._diagnostics_timer = self.create_timer(
            diagnostics.PERIOD_S, self._tell_diagnostics, clock=self.steady
        )

    @property
    def is_vehicle(self) -> bool:
        """Is it this node that says where the mission stands."""
        return "mission" in self.row.publishes

    def _activate(self) -> None:
        self.run = self.values["run"] or (messages.new_run() if self.is_vehicle else "")
        super()._activate()
        for name in self.row.subscribes:
            self.subscriptions_of[name] = self.subscribe(TOPICS[name])
        given = [*self.subscriptions_of.values(), *self.publishers_of.values()]
        self._refuse_unknown("qos", [f"qos_overrides.{end.topic_name}" for end in given])
        self._peers_timer = self.timer(PEERS_PERIOD_S, self._look_for_peers)

    def _say_all(self) -> None:
        super()._say_all()
        deadline_s = time.monotonic() + ACKNOWLEDGE_S
        for publisher in self.publishers_of.values():
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline_s - time.monotonic())))

    def _fall_silent(self) -> None:
        super()._fall_silent()
        for timer in self._timers_active:
            self.destroy_timer(timer)
        for subscription in self.subscriptions_of.values():
            self.destroy_subscription(subscription)
        self._timers_active.clear()
        self.subscriptions_of.clear()

    def _cleanup(self) -> None:
        super()._cleanup()
        if self._diagnostics_timer is not None:
            self.destroy_timer(self._diagnostics_timer)
            self._diagnostics_timer = None
        for publisher in self.publishers_of.values():
            self.destroy_publisher(publisher)
        self.publishers_of.clear()

    # Topics.

    def timer(self, period_s: float, callback: Callable[[], None], clock: Clock | None = None) -> Any:
        """A timer that lives until the node is deactivated; on the steady clock unless told."""
        timer = self.create_timer(period_s, callback, clock=clock or self.steady)
        self._timers_active.append(timer)
        return timer

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row."""
        handle = getattr(self, f"on_{topic.name}")
        payload = messages.PAYLOADS.get(topic.name)
        assert payload is not None or topic.type == topics.POSE, "there is no other border than these two"

        def hear(data: bytes, info: Any) -> None:
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
            self.meter.heard(topic.name, info)

        return self.create_raw_subscription(topic, hear)

    def check_run(self, topic: str, run: str) -> None:
        """Refuse a message of another run; adopt the run of the only publisher, where none was given.

        Raises:
            MessageError: the message belongs to another run.
        """
        if run == self.run or (topic == "ready" and not run):
            return
        if self.is_vehicle or self.values["run"] or self.count_publishers(topic) > 1:
            raise MessageError(
                "another_run", f"it belongs to run {run!r}; expected {self.run!r}, the run of this mission"
            )
        self.run = run

    def is_of_another_run(self, topic: str, data: bytes) -> bool:
        """Belongs a serialised message to another run than the one that was given? Such a one is counted.

        For nodes that handle messages as bytes. Without a given run they take whatever is published.
        """
        if not self._given_run or topic not in messages.PAYLOADS:
            return False
        if data.startswith(self._given_run, CDR_HEAD):
            return False
        other = messages.read_run(data[CDR_HEAD:].rstrip(b"\0"))
        if other is None:
            return False  # whoever decodes it refuses it
        try:
            self.check_run(topic, other)
        except MessageError as error:
            self.reject(topic, error)
            return True
        return False

    def create_raw_subscription(self, topic: Topic, callback: Callable[[bytes, Any], None]) -> Any:
        """A subscription with the table's QoS, as overridden, for the bytes of messages and their info."""
        handler: Any = callback  # rclpy sees by the signature what it takes; its types do not
        with qos.overridden(topic.name):
            return self.create_subscription(
                qos.MESSAGE_TYPES[topic.type],
                topic.name,
                handler,
                qos.requested(topic, all=self.row.hears_all),
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                qos_overriding_options=qos.OVERRIDES,
                raw=True,
            )

    def say(self, topic: str, payload: messages.Payload) -> None:
        """Publish a checked payload on a JSON topic."""
        self.say_encoded(topic, messages.encode(payload))

    def say_encoded(self, topic: str, text: bytes) -> None:
        """Publish a payload that was checked and encoded."""
        self.publish(topic, cdr.encode_string(text))

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message, or its serialised form, on any topic."""
        self.meter.said(topic)
        self.publishers_of[topic].publish(message)

    def reject(self, topic: str, error: MessageError) -> None:
        """Count a message that was refused, and tell the first of its kind."""
        kind = (topic, error.reason)
        self.meter.rejected[kind] += 1
        if self.meter.rejected[kind] == 1:
            self.get_logger().warning(f"{topic}: {error.reason}: {error} (told once, then counted)")

    # Peers: a node is ready once each of its topics reaches every peer that takes part.

    def _look_for_peers(self) -> None:
        for topic, publisher in self.publishers_of.items():
            hearing = [peer for peer in self.peers if topic in self.rows[peer].subscribes]
            if publisher.get_subscription_count() < len(hearing):
                return
            if hearing and not self._are_all_in(hearing, self.get_subscriptions_info_by_topic(topic)):
                return
        for topic, subscription in self.subscriptions_of.items():
            saying = [peer for peer in self.peers if topic in self.rows[peer].publishes]
            if subscription.get_publisher_count() < len(saying):
                return
            if saying and not self._are_all_in(saying, self.get_publishers_info_by_topic(topic)):
                return
        self._peers_timer.cancel()
        self.on_peers()

    def _are_all_in(self, peers: Sequence[str], ends: Sequence[TopicEndpointInfo]) -> bool:
        """Are these peers among the nodes behind the ends of a topic: any stranger adds to their count."""
        inside = self.get_namespace().rstrip("/")
        return {f"{inside}/{peer}" for peer in peers} <= {qos.full_name(end) for end in ends}

    def check_alone(self) -> None:
        """Refuse to begin a mission where somebody else publishes what it has one publisher of.

        Only of this node itself two are one too many: the graph may still tell of another that was killed.

        Raises:
            AnotherMissionError: who does.
        """
        others = [name for name in self.rows if name != self.row.name]
        found = other_publishers.find(
            other_publishers.publishers(self), self.get_namespace(), self.rows, restarted=others
        )
        if found:
            raise other_publishers.AnotherMissionError(found.told())

    def check_peer(self, payload: messages.Ready) -> None:
        """Refuse what nobody of the table says.

        Raises:
            MessageError: no node has that name.
        """
        if payload.node not in self.rows:
            known = ", ".join(self.rows)
            raise MessageError("unknown_node", f"{payload.node!r}; expected some of {known}")

    def on_peers(self) -> None:
        """All peers are there."""
        if "ready" in self.row.publishes:
            # An adopted run may be over: the vehicle of the next one takes a node without any.
            self.say("ready", messages.Ready(run=self.values["run"], node=self.row.name))

    # Diagnostics.

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """What this kind of node adds to its diagnostics: warnings, and values by name."""
        return [], {}

    def _tell_diagnostics(self) -> None:
        rejected, values = self.meter.report()
        warnings, own = self.diagnose()
        ends = self.publishers_of.values(), self.subscriptions_of.values()
        found = set(qos.incompatible(self, *ends))
        # Once is no matter: a recorder that meets a pose of lower quality asks for less a moment later.
        lasting, self._seen_incompatible = found & self._seen_incompatible, found
        for topic, peer, reason in sorted(lasting):
            if (topic, peer) not in self._told_incompatible:
                self._told_incompatible.add((topic, peer))
                self.get_logger().warning(f"{topic}: {peer} does not match: {reason} (told once)")
        mismatches = [f"{peer} does not match on {topic}" for topic, peer in self._told_incompatible]
        status = diagnostics.status(
            self.get_fully_qualified_name()[1:],
            [*warnings, *mismatches, *(["messages were rejected"] if rejected else [])],
            self.state,
            {"state": self.state, "restarts": str(self.restarts)} | own | values,
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self.publish("diagnostics", message)
