"""What a part of a bag holds, and metadata.yaml over all parts of a bag, as rosbag2 of Jazzy writes it."""

import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from uav_dc_ros import files
from uav_dc_ros.errors import BagError, UavDcError

METADATA_NAME = "uav_dc_ros"  # of our record inside an MCAP file: what the bag is about
LOST = "lost_bytes"  # its key for what recovering a part could not use
# Messages at the head of a file that an earlier file of the bag holds already, by topic; their sequence is 0.
REPEATED_NAME = "uav_dc_ros_repeated"
DROPPED_NAME = "uav_dc_ros_dropped"  # messages that were lost while a file was written, by topic
FILE_NAME = "metadata.yaml"


@dataclass
class Part:
    """What one MCAP file of a bag holds.

    Attributes:
        name: its file's name.
        about: what the bag is about, text by key.
        topics: `topic_metadata` of metadata.yaml by topic.
        counts: messages by topic.
        published_ns: latest publish time by topic, of topics with messages, nanoseconds since the epoch.
        first_ns: earliest log time; None without messages.
        last_ns: latest log time.
        repeated: messages by topic that repeat latched ones of earlier parts; `counts` has them, too.
        dropped: messages by topic that were published but never reached the recorder; None: nobody counted.
        latest: last message and its publish time by topic, of latched topics; only what was read has it.
    """

    name: str
    about: dict[str, str] = field(default_factory=dict)
    topics: dict[str, dict[str, Any]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    published_ns: dict[str, int] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int = 0
    repeated: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] | None = None
    latest: dict[str, tuple[bytes, int]] = field(default_factory=dict)

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(self.counts.values())

    def announce(self, topic: str, type: str, encoding: str, channel: Mapping[str, str]) -> None:
        """Enter a topic; a second time changes nothing.

        Args:
            topic: full name.
            type: ROS 2 message type.
            encoding: of its messages, such as `cdr`.
            channel: metadata of its MCAP channel; the keys are rosbag2's.

        Raises:
            BagError: the channel's QoS is not what rosbag2 writes.
        """
        if topic in self.topics:
            return
        offers = channel.get("offered_qos_profiles", "")
        try:
            qos = dump_qos_v9(parse_qos(offers))
        except (ReaderError, KeyError, TypeError, AttributeError):
            raise BagError(f"QoS of topic {topic} is {offers!r}; expected rosbag2's YAML") from None
        self.topics[topic] = {
            "name": topic,
            "type": type,
            "serialization_format": encoding,
            "offered_qos_profiles": qos,
            "type_description_hash": channel.get("topic_type_hash", ""),
        }
        self.counts[topic] = 0

    def learn(self, name: str, content: Mapping[str, str]) -> None:
        """Enter a metadata record; those of others say nothing here."""
        if name == METADATA_NAME:
            self.about |= content
        elif name == REPEATED_NAME:
            self.repeated |= _numbers(content)
        elif name == DROPPED_NAME:
            self.dropped = (self.dropped or {}) | _numbers(content)

    def count(self, topic: str, *, log_time_ns: int, publish_time_ns: int) -> None:
        """Enter a message of a topic that was announced; times in nanoseconds since the epoch."""
        self.counts[topic] += 1
        self.published_ns[topic] = max(publish_time_ns, self.published_ns.get(topic, publish_time_ns))
        self.first_ns = log_time_ns if self.first_ns is None else min(self.first_ns, log_time_ns)
        self.last_ns = max(self.last_ns, log_time_ns)


def is_latched(row: Mapping[str, Any]) -> bool:
    """Whether all publishers of a topic, by its row of metadata.yaml, offer old messages to newcomers."""
    offers = row["offered_qos_profiles"]
    return bool(offers) and all(offer["durability"] == "transient_local" for offer in offers)


def total(parts: Sequence[Part]) -> Part:
    """All parts as one, nameless.

    A topic appears once, as the first part with messages of it has it: rosbags reads only messages whose
    channel offers exactly the QoS that metadata.yaml tells, and a topic without messages loses none.
    """
    whole = Part("")
    for part in parts:
        whole.about = part.about | whole.about  # what was said first stays
        for topic, row in part.topics.items():
            if not whole.counts.get(topic) and (part.counts[topic] or row["offered_qos_profiles"]):
                whole.topics[topic] = row
            whole.topics.setdefault(topic, row)
            whole.counts[topic] = whole.counts.get(topic, 0) + part.counts[topic]
            whole.repeated[topic] = whole.repeated.get(topic, 0) + part.repeated.get(topic, 0)
        if part.dropped is not None:
            lost = Counter(whole.dropped or {})
            lost.update(part.dropped)
            whole.dropped = dict(lost)
        whole.latest |= part.latest
        for topic, published_ns in part.published_ns.items():
            whole.published_ns[topic] = max(published_ns, whole.published_ns.get(topic, published_ns))
        if part.first_ns is not None:
            whole.first_ns = part.first_ns if whole.first_ns is None else min(whole.first_ns, part.first_ns)
            whole.last_ns = max(whole.last_ns, part.last_ns)
    return whole


def information(parts: Sequence[Part]) -> dict[str, Any]:
    """The content of metadata.yaml, version 9 (Jazzy), over some parts."""
    whole = total(parts)
    start_ns = time.time_ns() if whole.first_ns is None else whole.first_ns
    return {
        "version": 9,
        "storage_identifier": "mcap",
        **_times(whole, start_ns),
        "topics_with_message_count": [
            {"topic_metadata": row, "message_count": whole.counts[topic]}
            for topic, row in whole.topics.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [part.name for part in parts],
        "files": [{"path": part.name, **_times(part, start_ns)} for part in parts],
        "custom_data": whole.about
        | ({} if whole.dropped is None else {"dropped": json.dumps(whole.dropped, sort_keys=True)}),
        "ros_distro": "jazzy",
    }


def _numbers(content: Mapping[str, str]) -> dict[str, int]:
    return {topic: int(count) for topic, count in content.items() if count.isdecimal()}


def _times(part: Part, otherwise_ns: int) -> dict[str, Any]:
    start_ns = otherwise_ns if part.first_ns is None else part.first_ns
    return {
        "duration": {"nanoseconds": max(0, part.last_ns - start_ns)},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "message_count": part.message_count,
    }


def write_metadata(folder: Path, parts: Sequence[Part]) -> None:
    """Write metadata.yaml in one move.

    Raises:
        BagError: the disk is full, or gone.
    """
    text = to_yaml({"rosbag2_bagfile_information": information(parts)}) + "\n"
    try:
        files.write(folder / FILE_NAME, text.encode())
    except UavDcError as error:
        raise BagError(str(error)) from None


def read_metadata(folder: Path) -> dict[str, Any] | None:
    """What metadata.yaml says; None if it is missing, or says nothing of a bag.

    Raises:
        BagError: it is there, and cannot be read.
    """
    try:
        told = YAML(typ="safe").load(folder / FILE_NAME)["rosbag2_bagfile_information"]
    except FileNotFoundError:
        return None
    except OSError as error:
        raise BagError(f"{folder / FILE_NAME} cannot be read: {error.strerror}") from None
    except (ValueError, YAMLError, KeyError, TypeError, RecursionError):
        return None
    return told if isinstance(told, dict) else None


def is_told(folder: Path, parts: Sequence[Part]) -> bool:
    """Whether metadata.yaml tells these parts, and as many messages of each topic."""
    told = read_metadata(folder)
    if told is None:
        return False  # it is to be written
    try:
        counts = {
            row["topic_metadata"]["name"]: row["message_count"] for row in told["topics_with_message_count"]
        }
        names = [Path(name).name for name in told["relative_file_paths"]]  # some writers put folders before
    except (KeyError, TypeError):
        return False
    return names == [part.name for part in parts] and counts == total(parts).counts


def to_yaml(value: Any) -> str:
    """YAML in block style, without anchors, keys in their order."""
    text = StringIO()
    yaml = YAML(typ="safe")
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.representer.ignore_aliases = lambda *_: True
    yaml.dump(value, text)
    return text.getvalue().strip()
