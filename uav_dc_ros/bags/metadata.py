"""The contents of a part of a bag, and metadata.yaml over all parts, in the format of rosbag2 of Jazzy."""

import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from uav_dc_ros import files
from uav_dc_ros.errors import BagError, UavDcError

if TYPE_CHECKING:
    from rosbags.interfaces import Qos

# Names of this package's metadata records in an MCAP file.
ABOUT_RECORD = "uav_dc_ros"  # the bag's description, text by key
REPEATED_RECORD = "uav_dc_ros_repeated"  # messages at the head that an earlier part has, by topic; sequence 0
DROPPED_RECORD = "uav_dc_ros_dropped"  # messages lost while the part was recorded, by topic
LOST_BYTES_KEY = "lost_bytes"  # of ABOUT_RECORD: bytes of the source that could not be recovered
MADE_BY_KEY = "made_by"  # of ABOUT_RECORD: the verb that made the bag, and the names of its sources
ROSBAG2_RECORD = "rosbag2"  # rosbag2's own: metadata.yaml of the part
METADATA_FILE = "metadata.yaml"


@dataclass
class Part:
    """The contents of one MCAP file of a bag."""

    name: str  # of the file
    about: dict[str, str] = field(default_factory=dict)  # description of the bag, text by key
    topics: dict[str, dict[str, Any]] = field(default_factory=dict)  # `topic_metadata` of metadata.yaml
    counts: dict[str, int] = field(default_factory=dict)  # messages by topic
    published_ns: dict[str, int] = field(default_factory=dict)  # latest publish time by topic with messages
    first_ns: int | None = None  # earliest log time; None without messages
    last_ns: int = 0  # latest log time; 0 without messages
    # Messages by topic that repeat latched ones of earlier parts; included in `counts`.
    repeated: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] | None = None  # messages that the recorder lost, by topic; None: not counted
    # Last message and its publish time by latched topic; only of a part that was read.
    latest: dict[str, tuple[bytes, int]] = field(default_factory=dict)

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(self.counts.values())

    def add_topic(self, topic: str, type: str, encoding: str, channel: Mapping[str, str]) -> None:
        """Add a topic, unless it is known; raises BagError if its QoS is not in rosbag2's format."""
        if topic in self.topics:
            return
        qos = dump_qos_v9(offered_qos(topic, channel.get("offered_qos_profiles", "")))
        self.topics[topic] = {
            "name": topic,
            "type": type,
            "serialization_format": encoding,
            "offered_qos_profiles": qos,
            "type_description_hash": channel.get("topic_type_hash", ""),
        }
        self.counts[topic] = 0

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Add a metadata record; records of other software are ignored."""
        if name == ABOUT_RECORD:
            self.about |= content
        elif name == REPEATED_RECORD:
            self.repeated |= _counts(content)
        elif name == DROPPED_RECORD:
            self.dropped = (self.dropped or {}) | _counts(content)

    def add_message(self, topic: str, log_time_ns: int, publish_time_ns: int) -> None:
        """Count a message of a known topic."""
        self.counts[topic] += 1
        self.published_ns[topic] = max(publish_time_ns, self.published_ns.get(topic, publish_time_ns))
        self.first_ns = log_time_ns if self.first_ns is None else min(self.first_ns, log_time_ns)
        self.last_ns = max(self.last_ns, log_time_ns)


def _counts(content: Mapping[str, str]) -> dict[str, int]:
    return {topic: int(count) for topic, count in content.items() if count.isdecimal()}


def offered_qos(topic: str, text: str) -> "list[Qos]":
    """The QoS of a topic's publishers; raises BagError if the text is not in rosbag2's format."""
    try:
        return list(parse_qos(text))
    except (ReaderError, KeyError, TypeError, AttributeError):
        raise BagError(f"QoS of topic {topic} is {text!r}; expected rosbag2's YAML") from None


def is_latched(topic: Mapping[str, Any]) -> bool:
    """Whether all publishers of a topic, by its `topic_metadata`, are transient local."""
    offered = topic["offered_qos_profiles"]
    return bool(offered) and all(profile["durability"] == "transient_local" for profile in offered)


def merged(parts: Sequence[Part]) -> Part:
    """All parts as one, without a name.

    A topic has the metadata of the first part with messages of it: rosbags skips the messages of a channel
    whose QoS differs from that in metadata.yaml.
    """
    whole = Part("")
    for part in parts:
        whole.about = part.about | whole.about  # the first value stays
        for topic, row in part.topics.items():
            if not whole.counts.get(topic) and (part.counts[topic] or row["offered_qos_profiles"]):
                whole.topics[topic] = row
            whole.topics.setdefault(topic, row)
            whole.counts[topic] = whole.counts.get(topic, 0) + part.counts[topic]
            whole.repeated[topic] = whole.repeated.get(topic, 0) + part.repeated.get(topic, 0)
        if part.dropped is not None:
            dropped = Counter(whole.dropped or {})
            dropped.update(part.dropped)
            whole.dropped = dict(dropped)
        whole.latest |= part.latest
        for topic, published_ns in part.published_ns.items():
            whole.published_ns[topic] = max(published_ns, whole.published_ns.get(topic, published_ns))
    whole.first_ns = min((part.first_ns for part in parts if part.first_ns is not None), default=None)
    whole.last_ns = max((part.last_ns for part in parts), default=0)
    return whole


def information(parts: Sequence[Part]) -> dict[str, Any]:
    """The content of metadata.yaml, version 9 (Jazzy)."""
    whole = merged(parts)
    start_ns = time.time_ns() if whole.first_ns is None else whole.first_ns
    dropped = {} if whole.dropped is None else {"dropped": json.dumps(whole.dropped, sort_keys=True)}
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
        "custom_data": whole.about | dropped,
        "ros_distro": "jazzy",
    }


def _times(part: Part, default_ns: int) -> dict[str, Any]:
    start_ns = default_ns if part.first_ns is None else part.first_ns
    return {
        "duration": {"nanoseconds": max(0, part.last_ns - start_ns)},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "message_count": part.message_count,
    }


def write_metadata(folder: Path, parts: Sequence[Part]) -> None:
    """Write metadata.yaml; BagError if the disk is full or gone."""
    text = to_yaml({"rosbag2_bagfile_information": information(parts)}) + "\n"
    try:
        files.write(folder / METADATA_FILE, text.encode())
    except UavDcError as error:
        raise BagError(str(error)) from None


def read_metadata(folder: Path) -> dict[str, Any] | None:
    """The content of metadata.yaml; None if it is missing or describes no bag, BagError if unreadable."""
    try:
        content = YAML(typ="safe").load(folder / METADATA_FILE)["rosbag2_bagfile_information"]
    except FileNotFoundError:
        return None
    except OSError as error:
        raise BagError(f"{folder / METADATA_FILE} cannot be read: {error.strerror}") from None
    except (ValueError, YAMLError, KeyError, TypeError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def matches_metadata(folder: Path, parts: Sequence[Part]) -> bool:
    """Whether metadata.yaml lists exactly these parts and their messages by topic."""
    content = read_metadata(folder) or {}
    try:
        rows = content["topics_with_message_count"]
        counts = {row["topic_metadata"]["name"]: row["message_count"] for row in rows}
        names = [Path(name).name for name in content["relative_file_paths"]]  # may have folders before it
    except (KeyError, TypeError):
        return False
    return names == [part.name for part in parts] and counts == merged(parts).counts


def to_yaml(value: Any) -> str:
    """YAML in block style, without anchors, keys in their order."""
    text = StringIO()
    yaml = YAML(typ="safe")
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.representer.ignore_aliases = lambda *_: True
    yaml.dump(value, text)
    return text.getvalue().strip()
