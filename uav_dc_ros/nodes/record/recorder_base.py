"""What nodes that write bags share: they hear whatever is published, and write it, serialised as it came.

Messages that were lost on the way are counted by the middleware: what a best-effort reader sees missing
between two messages, and what a reliable publisher no longer had when it was to send it again. Subscriptions
keep all; those of Fast DDS hold five thousand messages, so only who reads too slowly for long loses any.
What nobody can count: the last messages of a best-effort publisher, if none comes after them, and what was
published before a topic was found, a fifth of a second at most, unless it is latched.
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
from uav_dc_ros.nodes.ros import message_types, qos, rclpy_private
from uav_dc_ros.topics import TOPICS, Topic

if TYPE_CHECKING:  # what writes bags is slow to import: see `prepare`
    from uav_dc_ros.bags.write import BagWriter

LOOK_S = 0.2  # for new topics
SYNC_S = 0.5  # what a kill takes at most is what came since, and what waits to be handled
DRAIN_S = 2.0  # for messages that have arrived when the node is deactivated
HOUSEKEEPING = ("/parameter_events", "/rosout", "/transition_event")  # of ROS: not unless asked for by name


class RecorderBase(MissionNode):
    """Records the topics of its row, and whatever else it is to.

    Attributes:
        writer: the bag; None without one.
        looks_twice: does it wait a moment before it records a new topic?
        asked: full names of the topics to record; empty: all in the node's namespace.
    """

    drains = True
    rest_s = 0.005  # nobody waits for it
    looks_twice = False

    def __init__(self, name: str, *arguments: Any) -> None:
        super().__init__(name, *arguments)
        self.writer: BagWriter | None = None
        self.asked: set[str] = set()
        self._hearings: dict[str, AdaptiveSubscription] = {}  # by full name
        self._announced: set[str] = set()
        self._not_recorded: dict[str, str] = {}  # reasons
        self._seen: Set[str] = set()  # topics at the last look
        self._undrained: dict[str, int] = {}

    def about(self) -> Mapping[str, str]:
        """What the bag is about.

        Raises:
            UavDcError: it cannot be told.
        """
        raise NotImplementedError

    # The life cycle.

    def prepare(self) -> None:
        """Import what writes bags."""
        importlib.import_module("uav_dc_ros.bags.write")
        importlib.import_module("uav_dc_ros.nodes.ros.recorded_qos")

    def configure(self) -> None:
        """Make the bag."""
        from uav_dc_ros.bags.write import BagWriter

        given = self.values
        if not given["bag"]:
            raise ParameterError("bag: ''; expected the folder of a new bag (-p bag:=FOLDER)")
        self.asked = {self._full(name) for name in given["topics"]}
        about, folder = self.about(), Path(given["bag"])
        self._check_space(folder)
        self.writer = BagWriter(
            folder,
            about,
            resume=given["resume"] and folder.exists(),
            compression=given["compression"],
            split_bytes=given["split_bytes"],
            split_s=given["split_s"],
        )
        for kept in (self._announced, self._not_recorded, self._undrained):
            kept.clear()
        self._seen = set()

    def _full(self, name: str) -> str:
        try:
            return self.resolve_topic_name(name)
        except Exception as error:  # rclpy has one for each way in which a name can be wrong
            told = str(error).splitlines()[0]
            raise ParameterError(f"topics: {name!r}: {told}; expected the name of a topic") from None

    def activate(self) -> None:
        """Record.

        Raises:
            ParameterError: the bag of this configuration is closed.
        """
        if self.writer is None:
            raise ParameterError(
                f"bag: {self.values['bag']} is closed; clean the node up, and configure it with a new folder"
            )
        self.timer(LOOK_S, self._look)
        self.timer(SYNC_S, self._sync)

    def deactivate(self) -> None:
        """Write what has arrived by now, and close the bag."""
        if self.writer is not None and not self.writer.closed:
            self._drain()
            dropped = self.dropped()
            self.writer.tell_dropped(dropped)
            for name in self.asked - self._hearings.keys() - self._not_recorded.keys():
                self._not_recorded[name] = "nobody published it"
            if self._not_recorded:
                self.writer.tell({"not_recorded": json.dumps(self._not_recorded, sort_keys=True)})
            if dropped:
                told = ", ".join(f"{name} {n}" for name, n in sorted(dropped.items()))
                self.get_logger().warning(f"dropped messages: {told}")
        self.cleanup()

    def cleanup(self) -> None:
        """Close the bag."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None

    def _fall_silent(self) -> None:
        for hearing in self._hearings.values():
            hearing.close()
        self._hearings.clear()
        super()._fall_silent()

    # What is heard.

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row, for its bytes.

        Also of a pose it asks for all that our nodes offer: best effort, a busy computer loses some. When one
        comes that offers less, as an autopilot's does, it asks for less, unless that was overridden.
        """
        assert self.writer is not None, "it was configured"
        name = self.resolve_topic_name(topic.name)
        hearing = AdaptiveSubscription(self, name, topic.type, self._hear(name, topic.name, topic))
        override = f"qos_overrides.{name}.subscription."
        overridden = any(given.startswith(override) for given in rclpy_private.overrides(self))
        all_of_it = replace(topic, requests_reliable=topic.reliable)
        subscription = self.create_raw_subscription(all_of_it, hearing.callback)
        hearing.add(subscription, adapts=not (topic.requests_reliable or overridden))
        self._hearings[name] = hearing
        return hearing.subscription

    def _hear(self, name: str, label: str, topic: Topic | None) -> Any:
        """What is done with each message of a topic; `label` is its name in diagnostics."""
        writer = self.writer
        assert writer is not None, "it was configured"
        if self.asked and name not in self.asked:
            return lambda data, info: None  # a mission's peers count on the subscription
        already_ns = writer.already_written.get(name, -1)
        heard, write, announced = self.meter.heard, writer.write, self._announced
        other_run = self.is_of_another_run

        def hear(data: bytes, info: Any) -> None:
            if topic is not None and other_run(topic.name, data):
                return
            published_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
            if name not in announced and topic is not None:
                self.announce(name, topic)
            if published_ns > already_ns:
                write(name, data, log_time_ns=received_ns, publish_time_ns=published_ns)
            heard(label, info)

        return hear

    def announce(self, name: str, topic: Topic) -> None:
        """Enter a topic of the row into the bag, once, with the QoS that its publishers offer by now.

        Of a topic that nobody publishes yet it is the table's.
        """
        if name not in self._announced and (not self.asked or name in self.asked):
            self._announce(name, topic.type, topic)

    def _announce(self, name: str, type: str, topic: Topic | None) -> None:
        """Enter a topic into the bag.

        Raises:
            BagError: earlier parts of the bag have it with another type; or the disk is full, or gone.
            LookupError: a type inside its type is not installed.
        """
        from uav_dc_ros.nodes.ros import recorded_qos

        ends = [end for end in self.get_publishers_info_by_topic(name) if end.topic_type == type]
        profiles = [end.qos_profile for end in ends] or ([] if topic is None else [qos.offered(topic)])
        depth = None if topic is None else topic.depth
        hashes = {str(end.topic_type_hash) for end in ends}
        assert self.writer is not None, "subscriptions end with the bag"
        self.writer.add_topic(
            name,
            type,
            sorted({recorded_qos.offered(profile, depth) for profile in profiles}, key=str),
            definition=message_types.definition(type),
            type_hash=min(hashes, default=""),
        )
        self.writer.keep_latched(name, len(ends))
        self._announced.add(name)

    def _look(self) -> None:
        """Hear topics that are new, and adapt to new publishers of those that are not."""
        found = dict(self.get_topic_names_and_types())
        others = tuple(f"{place}/" for place in self.other_missions(found))
        for name, types in found.items():
            if name in self._hearings:
                self._keep_up(self._hearings[name])
            elif name in self._not_recorded or (self.looks_twice and name not in self._seen):
                continue
            elif self._is_wanted(name, others):
                self._take_up(name, types)
        self._seen = found.keys()

    def other_missions(self, found: Mapping[str, list[str]]) -> set[str]:
        """Namespaces inside ours that are not ours to record; `found` are topics with their types."""
        return set()

    def _keep_up(self, hearing: AdaptiveSubscription) -> None:
        """Adapt to publishers that came or went."""
        hearing.settle()
        publishers = self.count_publishers(hearing.name)
        if publishers == hearing.publishers:
            return
        ends = self.get_publishers_info_by_topic(hearing.name)
        hearing.adapt([end for end in ends if end.topic_type == hearing.type])
        for label, ours in self.subscriptions_of.items():
            if ours.topic_name == hearing.name:
                self.subscriptions_of[label] = hearing.subscription
        if hearing.name in self._announced:
            hearing.publishers = publishers
            assert self.writer is not None, "timers end with the bag"
            self.writer.keep_latched(hearing.name, publishers)

    def _is_wanted(self, name: str, others: tuple[str, ...]) -> bool:
        if self.asked:
            return name in self.asked
        inside = self.get_namespace().rstrip("/") + "/"
        if name.endswith(HOUSEKEEPING) or not name.startswith(inside) or name.startswith(others):
            return False
        row = TOPICS.get(name.removeprefix(inside))
        hidden = any(part.startswith("_") for part in name.split("/"))
        return not hidden and (row is None or row.recorded)

    def _take_up(self, name: str, types: list[str]) -> None:
        """Subscribe to a topic that somebody else publishes."""
        ends = self.get_publishers_info_by_topic(name)
        us = (self.get_namespace(), self.get_name())
        if all((end.node_namespace, end.node_name) == us for end in ends):
            return
        type = types[0]
        kind = message_types.find(type)
        if len(types) > 1 or kind is None:
            several = f"it has several types: {', '.join(types)}"
            self._leave_out(name, several if len(types) > 1 else f"type {type} is not installed here")
            return
        hearing = AdaptiveSubscription(self, name, type, self._hear(name, name, None))
        hearing.publishers = len(ends)
        try:
            hearing.subscribe(kind, ends)
        except Exception as error:  # of rclpy and of what a package's own type support raises
            self._leave_out(name, f"type {type} cannot be used: {error}")
            return
        try:
            self._announce(name, type, None)
        except (BagError, LookupError) as error:
            hearing.close()
            assert self.writer is not None, "timers end with the bag"
            if self.writer.closed:
                raise
            self._leave_out(
                name, f"{error} is not installed" if isinstance(error, LookupError) else str(error)
            )
            return
        self._hearings[name] = hearing

    def _leave_out(self, name: str, why: str) -> None:
        self._not_recorded[name] = why
        self.get_logger().warning(f"{name} is not recorded: {why}")

    # What is kept.

    def _sync(self) -> None:
        """Have the bag reach the disk, as long as there is room.

        Raises:
            NodeError: the disk is nearly full.
            BagError: it is full, or gone.
        """
        assert self.writer is not None, "timers end with the bag"
        self.writer.sync()
        self._check_space(self.writer.folder)

    def _check_space(self, folder: Path) -> None:
        """Stop before the disk is full: the bag's end needs room, too.

        Raises:
            NodeError: there is less than `min_free_bytes`.
        """
        above = next((one for one in (folder, *folder.absolute().parents) if one.exists()), Path("/"))
        free, least = shutil.disk_usage(above).free, self.values["min_free_bytes"]
        if free < least:
            raise NodeError(
                f"bag {folder}: its disk has {free} bytes left; expected at least {least} (min_free_bytes). "
                "Recording stops here, and what was recorded is whole"
            )

    def _drain(self) -> None:
        """Write what was published until now, as far as it has arrived; count what there is no time for."""
        now_ns, deadline_s = time.time_ns(), time.monotonic() + DRAIN_S
        for name, hearing in self._hearings.items():
            left = hearing.drain(now_ns, deadline_s)
            if left:
                self._undrained[name] = left

    def dropped(self) -> dict[str, int]:
        """Messages that were lost until now, by full name of topics that lost any."""
        lost = {name: each.lost() + self._undrained.get(name, 0) for name, each in self._hearings.items()}
        return {name: n for name, n in lost.items() if n}

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """What was recorded, and what was not."""
        if self.writer is None or self.writer.closed:
            return [], {}
        dropped = self.dropped()
        if dropped:
            self.writer.tell_dropped(dropped)
        warnings = ["messages were dropped"] if dropped else []
        values = {"messages": str(self.writer.message_count), "parts": str(self.writer.part_count)}
        values |= {f"{name} dropped": str(n) for name, n in dropped.items()}
        return warnings, values | {f"{name} not recorded": why for name, why in self._not_recorded.items()}
