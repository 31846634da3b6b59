"""Copies messages of bags into a new bag, one at a time, for `cut`, `merge`, `filter` and `convert`.

The new bag has the QoS, message definitions, metadata records and attachments of its sources, and begins with
the latched messages that held. It is written under a temporary name, and renamed once it is complete and on
disk. Messages are numbered anew; those that rosbag2 compressed one by one are decompressed.
"""

import argparse
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from uav_dc_ros import cdr, cli, files, messages
from uav_dc_ros.bags import COMPRESSIONS, json_channels
from uav_dc_ros.bags.message_definitions import ENCODING, have_same_fields, typestore
from uav_dc_ros.bags.metadata import MADE_BY_KEY, offered_qos, read_metadata
from uav_dc_ros.bags.read import BagMessage, BagReader, RecordedTopic
from uav_dc_ros.bags.unreadable import Unreadable
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.errors import BagError, MessageError

if TYPE_CHECKING:
    from rosbags.interfaces import Qos

NAMED_MAX = 5  # sources


@dataclass(frozen=True, kw_only=True)
class NewBag:
    """Folder and format of a new bag; see `BagWriter`."""

    folder: Path
    compression: str = "zstd"
    split_bytes: int = 0
    split_s: float = 0.0
    json_channels: bool | None = None  # whether payloads become `json_channels`; None: as in the source


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options of `NewBag`, except `json_channels`."""
    add, size = parser.add_argument, cli.whole_number(0)
    add("--out", type=Path, required=True, metavar="DIR", help="folder of the new bag")
    add("--compression", choices=COMPRESSIONS, default="zstd", help="of its chunks (default: %(default)s)")
    add("--split-bytes", type=size, default=0, metavar="N", help="size at which its next file begins")
    seconds = cli.number(0.0, 1e9, "seconds from 0 to 1e9")
    add("--split-s", type=seconds, default=0.0, metavar="S", help="seconds after which its next file begins")


def output(options: argparse.Namespace) -> NewBag:
    """The options as `add_output` adds them."""
    names = ("compression", "split_bytes", "split_s")
    return NewBag(folder=options.out, **{name: getattr(options, name) for name in names})


@dataclass(kw_only=True)
class _CopiedTopic:
    """A topic of all sources."""

    topic: RecordedTopic  # of the first source that has it
    source: Path
    offered: "list[Qos]" = field(default_factory=list)  # of all sources
    repeated: int = 0  # most messages of it at the head of a source


class BagCopy:
    """A new bag that is being written."""

    def __init__(self, writer: BagWriter, output: NewBag, topics: Mapping[str, _CopiedTopic]) -> None:
        self.duplicates: set[str] = set()  # topics with messages of several sources that are written once
        self.unreadable = Unreadable()  # messages on channels for JSON that are no payloads
        self._writer = writer
        self._payloads: dict[str, type[messages.RunPayload]] = {}  # by topic, of those that become JSON
        for name, copied in topics.items():
            topic = copied.topic
            kind = json_channels.payload(name, topic.type)
            if kind and (topic.is_json if output.json_channels is None else output.json_channels):
                self._payloads[name] = kind
                type_name, definition = json_channels.name(kind), json_channels.schema(kind)
                encoding, serialization = json_channels.ENCODING, json_channels.SERIALIZATION
            else:
                type_name, definition, serialization = topic.type, topic.definition, topic.serialization
                is_defined = definition or type_name in typestore().fielddefs
                encoding = topic.encoding or ENCODING if is_defined else ""
            writer.add_topic(
                name,
                type_name,
                copied.offered,
                definition=definition,
                encoding=encoding,
                type_hash=topic.type_hash,
                serialization=serialization,
            )
            writer.keep_latched(name, copied.repeated)

    def add_about(self, about: Mapping[str, str]) -> None:
        """Add to the description of the new bag."""
        self._writer.add_about(about)

    def hold(self, held: Iterable[BagMessage]) -> None:
        """Repeat latched messages from before the new bag at its head; see `BagWriter.hold`."""
        for message in held:
            if message.topic in self._writer.topics:
                self._writer.hold(message.topic, self._data(message), message.publish_time_ns)

    def holds(self, message: BagMessage) -> bool:
        """Whether a message is among the last ones of a latched topic."""
        return self._writer.holds(message.topic, self._data(message), message.publish_time_ns)

    def write(self, copied: Iterable[BagMessage]) -> None:
        """Append messages of the sources' topics."""
        write, payloads = self._writer.write, self._payloads
        for message in copied:
            topic, _, data, log_ns, publish_ns = message
            if topic in payloads:
                data = self._data(message)
            write(topic, data, log_time_ns=log_ns, publish_time_ns=publish_ns)

    def _data(self, message: BagMessage) -> bytes:
        """The data of a message in the new bag. A text that is no payload stays as it is, and is counted."""
        kind = self._payloads.get(message.topic)
        if kind is None:
            return message.data
        try:
            text = cdr.decode_string(message.data)
        except MessageError as error:
            raise BagError(
                f"a message of {message.topic} at {message.log_time_ns} ns is no {message.type}: {error}; "
                "expected a text, or a conversion without this topic (bag filter)"
            ) from None
        try:
            messages.decode(text, kind)
        except MessageError as error:
            self.unreadable.add(message.topic, error)
        return text


@contextmanager
def copying(
    sources: Sequence[BagReader],
    output: NewBag,
    *,
    topics: Collection[str] | None = None,
    about: Mapping[str, str] | None = None,
    made_by: str,
) -> Iterator[BagCopy]:
    """A new bag with some topics of its sources (None: all), their metadata, and no messages yet.

    `about` replaces the sources' description; `made_by` names the verb and its options. Prints what the bag
    holds. Raises BagError if the folder exists, the sources contradict each other, no message was written, or
    the disk is full.
    """
    folder = output.folder
    taken = f"bag folder {folder} exists already; expected a new one"
    if folder.exists() or folder.is_symlink():
        raise BagError(taken)
    copied = _topics(sources, topics)
    named = ", ".join(dict.fromkeys(source.path.absolute().name for source in sources[:NAMED_MAX]))
    more = f" and {len(sources) - NAMED_MAX} more" if len(sources) > NAMED_MAX else ""
    about = {
        **(merged_about(sources) if about is None else about),
        MADE_BY_KEY: f"{made_by} of {named}{more}",
    }
    formats = {
        "compression": output.compression,
        "split_bytes": output.split_bytes,
        "split_s": output.split_s,
    }
    try:
        with files.building(folder) as temporary:
            with BagWriter(temporary, about, name=folder.name, **formats) as writer:  # type: ignore[arg-type]
                copy = BagCopy(writer, output, copied)
                _copy_records(sources, writer)
                yield copy
                dropped = Counter[str]()
                for source in sources:
                    dropped.update({name: n for name, n in (source.dropped or {}).items() if name in copied})
                if any(source.dropped is not None for source in sources):
                    writer.set_dropped(dropped)
            if not writer.message_count:
                listed = ", ".join(sorted(copied)) or "none"
                raise BagError(f"no message is left for bag {folder}; expected one of its topics ({listed})")
            if folder.exists():  # made in the meantime
                raise BagError(taken)
            size = sum(path.stat().st_size for path in temporary.iterdir())
    except OSError as error:
        raise BagError(f"bag folder {folder} cannot be written: {error.strerror}") from None
    parts = f"{writer.part_count} part{'s' * (writer.part_count != 1)}"
    print(f"{folder}: {writer.message_count:,} messages of {len(copied)} topics in {parts}, {size:,} bytes")
    for line in copy.unreadable.lines():
        print(f"  {line}")


def _topics(sources: Sequence[BagReader], wanted: Collection[str] | None) -> dict[str, _CopiedTopic]:
    """Topics by name; raises BagError for one that has two types, or two definitions of its type."""
    found: dict[str, _CopiedTopic] = {}
    for source in sources:
        heads = Counter(message.topic for message in source.held())
        for name, topic in source.topics.items():
            if wanted is not None and name not in wanted:
                continue
            known = found.setdefault(name, _CopiedTopic(topic=topic, source=source.path))
            types = {known.topic.type, topic.type, *topic.other_types}
            remedy = "; expected one, or a copy without this topic (bag filter)"
            if len(types) > 1:
                raise BagError(f"topic {name} has the types {', '.join(sorted(types))}{remedy}")
            one, other = ((at.encoding, at.definition) for at in (known.topic, topic))
            if not have_same_fields(topic.type, one, other):
                where = f"in {known.source} and {source.path}"
                raise BagError(f"topic {name} has two definitions of {topic.type}, {where}{remedy}")
            if other[1] and not one[1]:
                known.topic = topic
            offered = offered_qos(name, topic.offered_qos)
            known.offered += [qos for qos in offered if qos not in known.offered]
            known.repeated = max(known.repeated, heads[name])
    return found


def merged_about(sources: Sequence[BagReader]) -> dict[str, str]:
    """The description of several bags: what they agree on, the number of missions of all, the first seed."""
    abouts = [_about(source) for source in sources]
    first = abouts[0]
    agreed = {key: first[key] for key in first if all(one.get(key) == first[key] for one in abouts)}
    if all(one.get("missions", "").isdecimal() for one in abouts):
        agreed["missions"] = str(sum(int(one["missions"]) for one in abouts))
    if all("seed" in one for one in abouts):
        agreed["seed"] = first["seed"]
    return agreed


def _about(source: BagReader) -> dict[str, str]:
    """The description of a bag; of another recorder's, the custom data of its metadata.yaml."""
    if source.about or not source.path.is_dir():
        return source.about
    custom = (read_metadata(source.path) or {}).get("custom_data")
    given = custom if isinstance(custom, dict) else {}
    return {key: value for key, value in given.items() if isinstance(key, str) and isinstance(value, str)}


def _copy_records(sources: Sequence[BagReader], writer: BagWriter) -> None:
    """Copy metadata records of other software, and attachments, each once."""
    known: set[object] = set()
    for storage in (storage for source in sources for storage in source.storages):
        for record in storage.metadata:
            content = record.name, *sorted(record.metadata.items())
            if content not in known:
                writer.add_metadata(record.name, record.metadata)
            known.add(content)
        for attachment in storage.attachments():
            times = attachment.create_time, attachment.log_time
            key = (*times, attachment.name, attachment.media_type, hash(attachment.data))
            if key not in known:
                writer.add_attachment(attachment)
            known.add(key)
