"""What all nodes share: a life cycle, topics and parameters from the tables, peers, diagnostics."""

import difflib
import os
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher

from uav_dc_ros import messages
from uav_dc_ros.errors import MessageError, ParameterError, UavDcError
from uav_dc_ros.nodes import convert, diagnostics, qos
from uav_dc_ros.nodes.diagnostics import Meter
from uav_dc_ros.nodes.parameters import EVERY, Parameter
from uav_dc_ros.nodes.table import NODES
from uav_dc_ros.topics import TOPICS, Topic

SUPERVISED = "UAV_DC_ROS_SUPERVISED"  # set by run_all: how often this node has been started again
PEERS_PERIOD_S = 0.02
# For the last words to be acknowledged: a bad link takes a while, and a peer that was killed never does.
ACKNOWLEDGE_S = 1.5
ANOTHER_MISSION = (
    "another mission is being flown here: somebody else publishes `mission`. Give this one a network of its "
    "own (export ROS_DOMAIN_ID=1, or any number up to 101), or a namespace"
)


class MissionNode(LifecycleNode):
    """A managed node of the table: its row says what it publishes, hears and is told by parameters.

    `configure` loads and checks, `activate` starts, `deactivate` is a safe stop, `cleanup` forgets. A
    UavDcError in `configure` or `activate` refuses the transition and is told. Each topic that the node
    hears is a method `on_TOPIC`, called while it is active with the checked payload (a JSON topic) or the
    message (any other). What does not check is counted by reason, told once, and dropped.

    Args:
        name: of its row.
        overrides: values of parameters, over those of the command line.

    Attributes:
        drains: does the node still handle, when asked to stop, what has arrived by then?
        rest_s: pause after each turn of its executor: see there.
        values: values of its parameters; they are checked when it is configured.
        failure: why the last transition was refused.
        published_ns: when the message that is being handled was published, nanoseconds since the epoch.
    """

    drains = False
    rest_s = 0.0

    def __init__(self, name: str, overrides: Sequence[rclpy.Parameter] = ()) -> None:
        super().__init__(name, parameter_overrides=list(overrides))
        self.row = NODES[name]
        self.meter = Meter()
        self.restarts = int(os.environ.get(SUPERVISED) or 0)
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.values: dict[str, Any] = {}
        self.failure: UavDcError | None = None
        self.published_ns = 0
        self.publishers_of: dict[str, Publisher] = {}
        self.subscriptions_of: dict[str, Any] = {}
        self._timers_active: list[Any] = []
        self._diagnostics_timer: Any = None
        self._told_incompatible: set[tuple[str, str]] = set()
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._refuse_impossible
        self._declare()
        self.peers = [peer for peer in self.values["peers"] if peer != name]

    # Parameters.

    def _declare(self) -> None:
        """Declare the row's parameters.

        Raises:
            ParameterError: a value that cannot be, or a parameter that the node does not have.
        """
        rows = {row.name: row for row in (*EVERY, *self.row.parameters)}
        for row in rows.values():
            try:
                given = self.declare_parameter(row.name, row.default, _descriptor(row)).value
            except (InvalidParameterTypeException, InvalidParameterValueException):
                given = self._parameter_overrides[row.name].value
            self.values[row.name] = row.value(given)
        self._refuse_unknown("", list(rows))
        for peer in self.values["peers"]:
            if peer not in NODES:
                raise ParameterError(f"peers: {peer!r}; expected some of {', '.join(NODES)}")
        self.add_on_set_parameters_callback(self._on_set)

    def _refuse_unknown(self, kind: str, known: Sequence[str]) -> None:
        """Refuse parameters that were given, and that the node has not declared: typing errors, mostly."""
        for name in self._parameter_overrides:
            if name.startswith("qos_overrides.") == bool(kind) and not self.has_parameter(name):
                close = difflib.get_close_matches(name, known, 1)
                meant = f"did you mean {close[0]!r}?" if close else f"expected some of {', '.join(known)}"
                raise ParameterError(f"{name}: no such parameter of node {self.row.name}; {meant}")

    def _on_set(self, given: list[Any]) -> SetParametersResult:
        """Refuse values that make no sense, and all while the node works with what it has read."""
        rows = {row.name: row for row in self.row.parameters}
        for parameter in given:
            row = rows.get(parameter.name)
            if row is None:
                continue
            if self.state != "unconfigured":
                return SetParametersResult(
                    successful=False,
                    reason=f"{row.name}: the node is {self.state}; expected it to be unconfigured, "
                    "since what it has checked and loaded does not change under it",
                )
            try:
                row.value(parameter.value)
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # The life cycle.

    @property
    def state(self) -> str:
        """State of the life cycle: `unconfigured`, `inactive`, `active` or `finalized`."""
        return str(self._state_machine.current_state[1])

    def configure(self) -> None:
        """Load and check what the parameters name.

        Raises:
            UavDcError: it cannot be flown.
        """

    def activate(self) -> None:
        """Start. The topics work from here on."""

    def deactivate(self) -> None:
        """Stop safely. The topics still work."""

    def cleanup(self) -> None:
        """Let go of what `configure` made."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to inactive: parameters are read, everything is loaded, publishers are there."""
        return self._attempt(self._configure, undo=self._cleanup)

    def _configure(self) -> None:
        for row in self.row.parameters:
            self.values[row.name] = row.value(self.get_parameter(row.name).value)
        self.configure()
        for name in self.row.publishes:
            topic = TOPICS[name]
            with qos.overridden(name):
                self.publishers_of[name] = self.create_publisher(
                    qos.MESSAGE_TYPES[topic.type],
                    name,
                    qos.offered(topic),
                    event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
                    qos_overriding_options=qos.OVERRIDES,
                )
        self._diagnostics_timer = self.create_timer(
            diagnostics.PERIOD_S, self._tell_diagnostics, clock=self.steady
        )

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to active: subscriptions are made, and peers looked for."""
        return self._attempt(self._activate, undo=self._fall_silent)

    def _activate(self) -> None:
        self.activate()
        for name in self.row.subscribes:
            self.subscriptions_of[name] = self.subscribe(TOPICS[name])
        given = [*self.subscriptions_of.values(), *self.publishers_of.values()]
        self._refuse_unknown("qos", [f"qos_overrides.{end.topic_name}" for end in given])
        self._peers_timer = self.timer(PEERS_PERIOD_S, self._look_for_peers)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to inactive: a safe stop; nothing is heard any more."""
        return self._attempt(self._deactivate)

    def _deactivate(self) -> None:
        self.deactivate()
        deadline_s = time.monotonic() + ACKNOWLEDGE_S
        for publisher in self.publishers_of.values():
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline_s - time.monotonic())))
        self._fall_silent()

    def _fall_silent(self) -> None:
        """Hear nothing any more, and act on no timer."""
        for timer in self._timers_active:
            self.destroy_timer(timer)
        for subscription in self.subscriptions_of.values():
            self.destroy_subscription(subscription)
        self._timers_active.clear()
        self.subscriptions_of.clear()

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to unconfigured."""
        return self._attempt(self._cleanup)

    def _cleanup(self) -> None:
        self.cleanup()
        if self._diagnostics_timer is not None:
            self.destroy_timer(self._diagnostics_timer)
            self._diagnostics_timer = None
        for publisher in self.publishers_of.values():
            self.destroy_publisher(publisher)
        self.publishers_of.clear()

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to finalized, from wherever the node is."""
        return self._attempt(self._shut_down)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a transition that failed in a way nobody thought of: back to unconfigured."""
        return self._attempt(self._shut_down)

    def _shut_down(self) -> None:
        if self.subscriptions_of:
            self._deactivate()
        self._cleanup()

    def _attempt(
        self, act: Callable[[], None], undo: Callable[[], None] = lambda: None
    ) -> TransitionCallbackReturn:
        """Do what a transition asks for; what goes wrong is told, undone, and refuses the transition."""
        self.failure = None
        try:
            act()
        except UavDcError as error:
            self.failure = error
            self.get_logger().error(str(error))
            undo()
            return TransitionCallbackReturn.FAILURE
        except Exception:  # the caller would swallow it
            self.get_logger().fatal(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _refuse_impossible(self, request: Any, response: Any) -> Any:
        """Answer a wish for a transition that this state does not have: rclpy would end the node."""
        try:
            return self._change_state(request, response)
        except _rclpy.RCLError:
            wanted = request.transition.label or request.transition.id
            self.get_logger().warning(f"transition {wanted}: not one from the state {self.state}")
            response.success = False
            return response

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

        def hear(message: Any, info: Any) -> None:
            self.published_ns = info["source_timestamp"]
            try:
                if payload is not None:
                    message = messages.decode(convert.text_in_cdr(message), payload)
                handle(message)
            except MessageError as error:
                self.reject(topic.name, error)
            self.meter.heard(topic.name, time.time_ns() - self.published_ns)

        return self.create_quiet_subscription(topic, hear, raw=payload is not None)

    def create_quiet_subscription(
        self, topic: Topic, callback: Callable[[Any, Any], None], *, raw: bool
    ) -> Any:
        """A subscription with the table's QoS, as overridden; `callback` takes the message and its info."""
        handler: Any = callback  # rclpy sees by the signature what it takes; its types do not
        with qos.overridden(topic.name):
            return self.create_subscription(
                qos.MESSAGE_TYPES[topic.type],
                topic.name,
                handler,
                qos.requested(topic, all=self.row.hears_all),
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                qos_overriding_options=qos.OVERRIDES,
                raw=raw,
            )

    def say(self, topic: str, payload: messages.Payload) -> None:
        """Publish a checked payload on a JSON topic."""
        self.say_encoded(topic, messages.encode(payload))

    def say_encoded(self, topic: str, text: bytes) -> None:
        """Publish a payload that was checked and encoded."""
        self.publish(topic, convert.cdr_of_text(text))

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
            hearing = sum(topic in NODES[peer].subscribes for peer in self.peers)
            if publisher.get_subscription_count() < hearing:
                return
        for topic, subscription in self.subscriptions_of.items():
            saying = sum(topic in NODES[peer].publishes for peer in self.peers)
            if subscription.get_publisher_count() < saying:
                return
        self._peers_timer.cancel()
        self.on_peers()

    def on_peers(self) -> None:
        """All peers are there."""
        if "ready" in self.row.publishes:
            self.say("ready", messages.Ready(node=self.row.name))

    # Diagnostics.

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """What this kind of node adds to its diagnostics: warnings, and values by name."""
        return [], {}

    def _tell_diagnostics(self) -> None:
        rejected, values = self.meter.report()
        warnings, own = self.diagnose()
        ends = self.publishers_of.values(), self.subscriptions_of.values()
        for topic, peer, reason in qos.incompatible(self, *ends):
            if (topic, peer) not in self._told_incompatible:
                self._told_incompatible.add((topic, peer))
                self.get_logger().warning(f"{topic}: QoS does not match that of {peer}: {reason} (told once)")
        mismatches = [
            f"QoS of {topic} does not match that of {peer}" for topic, peer in self._told_incompatible
        ]
        status = diagnostics.status(
            self.get_fully_qualified_name()[1:],
            [*warnings, *mismatches, *(["messages were rejected"] if rejected else [])],
            self.state,
            {"state": self.state, "restarts": str(self.restarts)} | own | values,
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self.publish("diagnostics", message)


def _descriptor(row: Parameter) -> ParameterDescriptor:
    """What ROS tells about a parameter, and checks itself."""
    unit = f" [{row.unit}]" if row.unit else ""
    descriptor = ParameterDescriptor(
        description=f"{row.description}{unit}",
        additional_constraints=row.expected,
        read_only=row.read_only,
        dynamic_typing=isinstance(row.default, str),  # `-p pace:=90` arrives as a number
    )
    if isinstance(row.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=row.least, to_value=row.most)]
    elif row.least is not None:
        descriptor.integer_range = [IntegerRange(from_value=int(row.least), to_value=int(row.most or 0))]
    return descriptor
