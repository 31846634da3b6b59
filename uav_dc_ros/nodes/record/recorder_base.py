"""Base of nodes that write bags: they record serialized messages as received.

The middleware counts lost messages: gaps in a best-effort topic, and messages that a reliable publisher could
not resend. Subscriptions keep all; Fast DDS limits them to five thousand messages, so only a slow recorder
loses any. Not counted: the last messages of a best-effort publisher, and what was published before a topic
was discovered (up to a fifth of a second), unless it is latched.
"""

import importlib
import json
import shutil
import time
from collections.abc import Mapping, Set
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uav_dc_ros.errors import BagError, NodeError, ParameterError
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.record.adaptive_subscription import AdaptiveSubscription
from uav_dc_ros.nodes.record.gate import RecordingGate
from uav_dc_ros.nodes.ros import message_types, qos, rclpy_private
from uav_dc_ros.topics import TOPICS, Topic

if TYPE_CHECKING:  # what writes bags is slow to import: see `prepare`
    from uav_dc_ros.bags.write import BagWriter

SCAN_S = 0.2  # period of scans for new topics
SYNC_S = 0.5  # a kill loses at most the messages of this time, and those not handled yet
DRAIN_S = 2.0  # for received messages, at deactivation
HOUSEKEEPING = ("/parameter_events", "/rosout", "/transition_event")  # of ROS: recorded only by name


class RecorderBase(MissionNode):
    """Records the topics of its row, and other topics that it discovers."""

    drain_quiet_s = 0.2  # a lost message is sent again within a tenth of a second
    pause_s = 0.005  # no node waits for the recorder
    delays_new_topics = False  # whether a topic is recorded only from the second scan on

    def __init__(self, name: str, *arguments: Any) -> None:
        super().__init__(name, *arguments)
        self.writer: BagWriter | None = None
        self.selected: set[str] = set()  # full names of the topics to record; empty: all in the namespace
        self._recorded: dict[str, AdaptiveSubscription] = {}  # by full name
        self._announced: set[str] = set()
        self._not_recorded: dict[str, str] = {}  # reasons
        self._scanned: Set[str] = set()  # topics at the last scan
        self._undrained: dict[str, int] = {}
        self.newest: dict[str, bytes] = {}  # last message by topic of the row

    def about(self) -> Mapping[str, str]:
        """Custom data of the bag."""
        raise NotImplementedError

    def missing(self) -> Mapping[str, str]:
        """Messages that are expected and have not arrived, described, by full name of their topic."""
        return {}

    def is_awaiting(self) -> bool:
        """Whether an expected message may still arrive."""
        return any(self._recorded[name].may_receive for name in self.missing())

    # Life cycle.

    def prepare(self) -> None:
        """Import the bag writer."""
        importlib.import_module("uav_dc_ros.bags.write")
        importlib.import_module("uav_dc_ros.bags.message_definitions").typestore()
        importlib.import_module("uav_dc_ros.nodes.ros.recorded_qos")

    def configure(self) -> None:
        """Create the bag."""
        from uav_dc_ros.bags.write import BagWriter

        given = self.values
        if not given["bag"]:
            raise ParameterError("bag: ''; expected the folder of a new bag (-p bag:=FOLDER)")
        self.selected = {self._full_name(name) for name in given["topics"]}
        about, folder = self.about(), Path(given["bag"])
        self._check_space(folder)
        options = {name: given[name] for name in ("compression", "split_bytes", "split_s")}
        if given["keep_last_s"]:
            about = {**about, "keep_last_s": f"{given['keep_last_s']:g}"}
        self.writer = BagWriter(folder, about, resume=given["resume"] and folder.exists(), **options)
        self.gate = RecordingGate(self.writer, given["keep_last_s"])
        for kept in (self._announced, self._not_recorded, self._undrained):
            kept.clear()
        self._scanned = set()

    def _full_name(self, name: str) -> str:
        try:
            return self.resolve_topic_name(name)
        except Exception as error:  # rclpy has an error class for each rule of names
            reason = str(error).splitlines()[0]
            raise ParameterError(f"topics: {name!r}: {reason}; expected the name of a topic") from None

    def activate(self) -> None:
        """Start recording; raises ParameterError if the bag of this configuration is closed."""
        if self.writer is None:
            raise ParameterError(
                f"bag: {self.values['bag']} is closed; clean the node up, and configure it with a new folder"
            )
        self.timer(SCAN_S, self._scan)
        self.timer(SYNC_S, self._sync)

    def deactivate(self) -> None:
        """Write all received messages, and close the bag."""
        if self.writer is not None and not self.writer.closed:
            now_ns, deadline_s = time.time_ns(), time.monotonic() + DRAIN_S
            for name, topic in self._recorded.items():
                self._undrained[name] = topic.drain(now_ns, deadline_s)
            if self.gate.is_paused:
                self.gate.resume(now_ns)
            if self.gate.kept:
                why = "no fault, no abort and no call of snapshot"
                self.get_logger().info(f"{self.gate.kept} messages in memory are not written: {why}")
            dropped = self.dropped()
            self.writer.set_dropped(dropped)
            if missing := self.missing():
                self.writer.add_about({"not_received": json.dumps(missing, sort_keys=True)})
                lacks = ", ".join(f"{name} {which}" for name, which in sorted(missing.items()))
                self.get_logger().warning(f"the bag lacks messages that did not arrive: {lacks}")
            for name in self.selected - self._recorded.keys() - self._not_recorded.keys():
                self._not_recorded[name] = "it has no publisher"
            if self._not_recorded:
                self.writer.add_about({"not_recorded": json.dumps(self._not_recorded, sort_keys=True)})
            if dropped:
                counts = ", ".join(f"{name} {n}" for name, n in sorted(dropped.items()))
                self.get_logger().warning(f"dropped messages: {counts}")
        self.cleanup()

    def cleanup(self) -> None:
        """Close the bag."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None

    def _undo_activation(self) -> None:
        for topic in self._recorded.values():
            topic.close()
        self._recorded.clear()
        self.newest.clear()
        super()._undo_activation()

    # Messages.

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row, serialized.

        It requests the table's QoS even for poses, since best effort loses some on a busy machine. For a
        publisher that offers less, such as an autopilot's, it adapts unless the QoS was overridden.
        """
        name = self.resolve_topic_name(topic.name)
        recorded = AdaptiveSubscription(self, name, topic.type, self._handler(name, topic))
        override = f"qos_overrides.{name}.subscription."
        overridden = any(given.startswith(override) for given in rclpy_private.parameter_overrides(self))
        full_qos = replace(topic, requests_reliable=topic.reliable)
        subscription = self.create_raw_subscription(full_qos, recorded.callback)
        recorded.use(subscription, adapts=not (topic.requests_reliable or overridden))
        self._recorded[name] = recorded
        return subscription

    def _handler(self, name: str, topic: Topic | None) -> Any:
        """The callback of a topic: of the table, or None."""
        writer = self.writer
        assert writer is not None, "configure created it"
        if self.selected and name not in self.selected:
            return lambda data, info: None  # the peers of a mission wait for the subscription
        already_ns = writer.already_written.get(name, -1)
        label = name if topic is None else topic.name
        count, write, announced = self.statistics.count_received, self.gate.write, self._announced
        newest = self.newest

        def handle(data: bytes, info: Any) -> None:
            if topic is not None:
                if self.is_of_another_run(topic.name, data):
                    return
                if name not in announced:
                    self.announce(name, topic)
                newest[label] = data
            published_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
            if published_ns > already_ns:
                write(name, data, log_time_ns=received_ns, publish_time_ns=published_ns)
            count(label, info)

        return handle

    def announce(self, name: str, topic: Topic) -> None:
        """Add a topic of the row to the bag, once, with its publishers' QoS, or without any the table's."""
        if name not in self._announced and (not self.selected or name in self.selected):
            self._announce(name, topic.type, topic)

    def _announce(self, name: str, type: str, topic: Topic | None) -> None:
        """Add a topic to the bag; raises BagError, or LookupError for a nested type that is not installed."""
        from uav_dc_ros.nodes.ros import recorded_qos

        ends = [end for end in self.get_publishers_info_by_topic(name) if end.topic_type == type]
        profiles = [end.qos_profile for end in ends] or ([] if topic is None else [qos.offered(topic)])
        depth = None if topic is None else topic.depth
        offers = sorted({recorded_qos.offered(profile, depth) for profile in profiles}, key=str)
        type_hash = min((str(end.topic_type_hash) for end in ends), default="")
        assert self.writer is not None, "subscriptions end with the bag"
        definition = message_types.definition(type)
        self.writer.add_topic(name, type, offers, definition=definition, type_hash=type_hash)
        self.writer.keep_latched(name, len(ends))
        self._announced.add(name)

    def _scan(self) -> None:
        """Record new topics, and adapt to new publishers of recorded ones."""
        found = dict(self.get_topic_names_and_types())
        others = tuple(f"{namespace}/" for namespace in self.other_missions(found))
        for name, types in found.items():
            if name in self._recorded:
                self._update(self._recorded[name])
            elif name in self._not_recorded or (self.delays_new_topics and name not in self._scanned):
                continue
            elif self._is_selected(name, others):
                self._record(name, types)
        self._scanned = found.keys()

    def other_missions(self, found: Mapping[str, list[str]]) -> set[str]:
        """Nested namespaces to leave out; `found` holds the types of each topic."""
        return set()

    def _update(self, topic: AdaptiveSubscription) -> None:
        """Adapt to a changed set of publishers."""
        topic.settle()
        publishers = self.count_publishers(topic.name)
        if publishers == topic.publishers:
            return
        ends = self.get_publishers_info_by_topic(topic.name)
        topic.adapt([end for end in ends if end.topic_type == topic.type])
        for label, subscription in self.subscriptions_of.items():
            if subscription.topic_name == topic.name:
                self.subscriptions_of[label] = topic.subscription
        if topic.name in self._announced:
            topic.publishers = publishers
            assert self.writer is not None, "timers end with the bag"
            self.writer.keep_latched(topic.name, publishers)

    def _is_selected(self, name: str, others: tuple[str, ...]) -> bool:
        if self.selected:
            return name in self.selected
        inside = self.get_namespace().rstrip("/") + "/"
        if name.endswith(HOUSEKEEPING) or not name.startswith(inside) or name.startswith(others):
            return False
        row = TOPICS.get(name.removeprefix(inside))
        hidden = any(part.startswith("_") for part in name.split("/"))
        return not hidden and (row is None or row.recorded)

    def _record(self, name: str, types: list[str]) -> None:
        """Subscribe to a topic that another node publishes."""
        ends = self.get_publishers_info_by_topic(name)
        if all(qos.full_name(end) == self.get_fully_qualified_name() for end in ends):
            return
        type, message_class = types[0], message_types.find(types[0])
        if len(types) > 1 or message_class is None:
            several = f"it has several types: {', '.join(types)}"
            self._exclude(name, several if len(types) > 1 else f"type {type} is not installed here")
            return
        topic = AdaptiveSubscription(self, name, type, self._handler(name, None))
        topic.publishers = len(ends)
        try:
            topic.subscribe(message_class, ends)
        except Exception as error:  # of rclpy, or of a package's type support
            self._exclude(name, f"type {type} cannot be used: {error}")
            return
        try:
            self._announce(name, type, None)
        except (BagError, LookupError) as error:
            topic.close()
            assert self.writer is not None, "timers end with the bag"
            if self.writer.closed:
                raise
            missing = " is not installed" if isinstance(error, LookupError) else ""
            self._exclude(name, f"{error}{missing}")
            return
        self._recorded[name] = topic

    def _exclude(self, name: str, reason: str) -> None:
        self._not_recorded[name] = reason
        self.get_logger().warning(f"{name} is not recorded: {reason}")

    # Services.

    def call_pause(self) -> str:
        """Record nothing but marks from now on."""
        self.gate.pause(time.time_ns())
        return "recording is paused"

    def call_resume(self) -> str:
        """Go on recording."""
        self.gate.resume(time.time_ns())
        return "recording goes on"

    def call_split(self) -> str:
        """Begin the next part of the bag."""
        assert self.writer is not None, "services end with the bag"
        if not self.writer.split():
            raise NodeError("this part of the bag has no message yet")
        return f"part {self.writer.part_count} of the bag begins"

    def call_snapshot(self) -> str:
        """Write the messages in memory."""
        return f"{self.gate.save('snapshot')} messages were written"

    # The bag.

    def _sync(self) -> None:
        assert self.writer is not None, "timers end with the bag"
        self.writer.sync()
        self._check_space(self.writer.folder)

    def _check_space(self, folder: Path) -> None:
        """Raise NodeError before the disk is full, since closing the bag needs space."""
        existing = next((one for one in (folder, *folder.absolute().parents) if one.exists()), Path("/"))
        free, minimum = shutil.disk_usage(existing).free, self.values["min_free_bytes"]
        if free < minimum:
            raise NodeError(
                f"bag {folder}: its disk has {free} bytes left; expected at least {minimum} "
                "(min_free_bytes). Recording stops here, and what was recorded is whole"
            )

    def dropped(self) -> dict[str, int]:
        """Number of lost messages, by full name of the topics that lost any."""
        lost = {name: topic.lost() + self._undrained.get(name, 0) for name, topic in self._recorded.items()}
        return {name: n for name, n in lost.items() if n}

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """Numbers of recorded and dropped messages, and topics that are not recorded."""
        if self.writer is None or self.writer.closed:
            return [], {}
        dropped = self.dropped()
        if dropped:
            self.writer.set_dropped(dropped)
        warnings = ["messages were dropped"] if dropped else []
        warnings += ["recording is paused"] if self.gate.is_paused else []
        values = {"messages": str(self.writer.message_count), "parts": str(self.writer.part_count)}
        if self.gate.omitted or self.gate.kept:
            values |= {"messages in memory": str(self.gate.kept), "omitted": str(self.gate.omitted)}
        values |= {f"{name} dropped": str(n) for name, n in dropped.items()}
        return warnings, values | {f"{name} not recorded": why for name, why in self._not_recorded.items()}
