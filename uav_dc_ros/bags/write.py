"""Write a rosbag2 folder: MCAP files, and metadata.yaml.

Messages are stored as they came, serialised; nothing is decoded. An MCAP file tells the whole story
by itself, so a folder whose metadata.yaml was never written loses nothing but convenience.

A bag has one part, `<folder>_0.mcap`, unless it is split, or its writer was killed: who goes on writes the
next part. Each part after the first begins with the last messages of each latched topic, one for each of its
publishers, so that it can be understood alone. They have their own publish time, the log time of the part's
first new message, and the sequence 0; a metadata record counts them.
"""

import os
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Self

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

from uav_dc_ros.bags import definitions
from uav_dc_ros.bags.mend import mend_parts
from uav_dc_ros.bags.metadata import (
    DROPPED_NAME,
    FILE_NAME,
    METADATA_NAME,
    REPEATED_NAME,
    Part,
    is_latched,
    to_yaml,
    total,
    write_metadata,
)
from uav_dc_ros.bags.part import CHUNK_BYTES, FolderLock, PartWriter, number, part_paths
from uav_dc_ros.bags.sync import DiskSync
from uav_dc_ros.errors import BagError

CHUNKS_OF_A_PART = 8  # at least, so that its size comes near to what was asked for
CHUNK_LEAST_BYTES = 1024


@dataclass
class _Row:
    """A topic of the bag: how it is announced, and, if it is latched, its last messages with publish time."""

    type: str
    definition: bytes
    channel: Mapping[str, str]
    latest: deque[tuple[bytes, int]] | None
    sequence: int
    number: int = field(default=0)


class BagWriter:
    """A bag that is being written; a context manager that closes it.

    Args:
        folder: the bag's folder; must not exist, unless its writing is resumed.
        about: what the bag is about, stored inside as text by key. What earlier parts say of a key stays.
        resume: go on with a bag whose writer was killed: its parts are mended, and a new one is begun.
        compression: of its chunks: one of part.COMPRESSIONS.
        split_bytes: size of a part's file after which the next one is begun; 0: never. A part is larger by
            no more than a chunk, one message and its index.
        split_s: log time after which the next part is begun, seconds; 0: never.

    Raises:
        BagError: the folder exists, or cannot be made. When resuming: there is no such folder, the bag was
            closed (so it is finished, and no bag is ever overwritten), it is still being written, or it
            cannot be mended.
    """

    def __init__(
        self,
        folder: Path,
        about: Mapping[str, str],
        *,
        resume: bool = False,
        compression: str = "zstd",
        split_bytes: int = 0,
        split_s: float = 0.0,
    ) -> None:
        self.folder = folder
        self._about = dict(about)
        self._compression = compression
        self._split_bytes = split_bytes
        self._split_ns = round(split_s * 1e9)
        self._rows: dict[str, _Row] = {}
        self._parts: list[Part] = []  # that are closed
        self._dropped_before: Counter[str] = Counter()  # in closed parts, since this writer began
        self._counts_dropped = False
        self._disk = DiskSync()
        if not resume:
            if folder.exists():
                raise BagError(f"bag folder {folder} exists already; expected a new one")
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise BagError(f"bag folder {folder} cannot be made: {error.strerror}") from None
        self._lock = FolderLock(folder)
        try:
            if resume:
                self._parts = _earlier_parts(folder)
            self._resumed = total(self._parts)
            self._begin()
        except BaseException:
            self._lock.release()
            raise

    def _begin(self) -> None:
        """Begin the next part."""
        n = max((number(self.folder / part.name) for part in self._parts), default=-1) + 1
        small = self._split_bytes // CHUNKS_OF_A_PART if self._split_bytes else CHUNK_BYTES
        self._chunk_bytes = min(CHUNK_BYTES, max(small, CHUNK_LEAST_BYTES))
        self._begun_ns: int | None = None  # log time of its first message
        self._unlooked_bytes = 0  # written since its size was looked at
        self._schemas: dict[str, int] = {}
        self._head: list[str] = []  # topics of which it has yet to repeat the last messages
        try:
            self._writer = PartWriter(
                self.folder / f"{self.folder.name}_{n}.mcap",
                compression=self._compression,
                chunk_bytes=self._chunk_bytes,
            )
            self._writer.add_metadata(METADATA_NAME, self._about)
        except OSError as error:
            raise BagError(f"bag {self.folder} cannot be written: {error.strerror}") from None

    @property
    def message_count(self) -> int:
        """Messages in the bag so far, those of earlier parts and repeated ones included."""
        return sum(part.message_count for part in self._parts) + self._writer.part.message_count

    @property
    def closed(self) -> bool:
        """Whether it was closed, or given up."""
        return self._writer.closed

    @property
    def topics(self) -> list[str]:
        """Topics that were added, by full name."""
        return list(self._rows)

    @property
    def part_count(self) -> int:
        """Parts of the bag so far."""
        return len(self._parts) + 1

    @property
    def already_written(self) -> Mapping[str, int]:
        """Latest publish time of each topic that a killed writer's parts hold, nanoseconds since the epoch.

        Latched topics come again to who subscribes again: what is not newer than this is in the bag.
        """
        return MappingProxyType(self._resumed.published_ns)

    def add_topic(
        self,
        name: str,
        type: str,
        offered_qos: Iterable[Qos] = (),
        *,
        definition: bytes = b"",
        type_hash: str = "",
    ) -> None:
        """Announce a topic, once, before its first message.

        A topic of which earlier parts hold messages keeps the QoS that they tell: metadata.yaml has one
        QoS for a topic, and rosbags reads no message whose channel tells another.

        Args:
            name: full name, with its namespace.
            type: ROS 2 message type, such as `std_msgs/msg/String`.
            offered_qos: QoS that the topic's publishers offer.
            definition: of a type that ROS 2 itself does not have, with all types inside it, as `ros2msg`.
            type_hash: of such a type (REP-2011).

        Raises:
            BagError: ROS 2 has no such type, the topic has another one in earlier parts, or the disk is full.
        """
        qos = dump_qos_v9(list(offered_qos))
        if name in self._resumed.topics:
            earlier = self._resumed.topics[name]
            if earlier["type"] != type:
                raise BagError(
                    f"topic {name} is of type {type}; expected {earlier['type']}, as in earlier parts"
                )
            if self._resumed.counts[name]:
                qos = earlier["offered_qos_profiles"]
        if not definition:
            definition = _definition(name, type)
            type_hash = definitions.TYPESTORE.hash_rihs01(type)
        row = _Row(
            type,
            definition,
            {"offered_qos_profiles": to_yaml(qos), "topic_type_hash": type_hash},
            deque(maxlen=len(qos)) if is_latched({"offered_qos_profiles": qos}) else None,
            self._resumed.counts.get(name, 0) - self._resumed.repeated.get(name, 0),
        )
        if row.latest is not None and name in self._resumed.latest:
            row.latest.append(self._resumed.latest[name])
        self._announce(name, row)
        self._rows[name] = row

    def _announce(self, name: str, row: _Row) -> None:
        """Enter a topic into the part."""
        try:
            if row.type not in self._schemas:
                self._schemas[row.type] = self._writer.add_schema(
                    row.type, definitions.ENCODING, row.definition
                )
            row.number = self._writer.add_channel(name, "cdr", self._schemas[row.type], row.channel)
        except OSError as error:  # a definition may be what fills the chunk
            raise self._failure(error) from None
        if row.latest:
            self._head.append(name)

    def keep_latched(self, topic: str, n: int) -> None:
        """Repeat the last `n` messages of a latched topic at the head of the next part: one a publisher."""
        row = self._rows[topic]
        if row.latest is not None and row.latest.maxlen != n > 0:
            row.latest = deque(row.latest, maxlen=n)

    def write(self, topic: str, data: bytes, *, log_time_ns: int, publish_time_ns: int) -> None:
        """Append a message.

        Args:
            topic: full name of a topic that was added.
            data: the message, serialised (CDR).
            log_time_ns: when it was received, nanoseconds since the epoch.
            publish_time_ns: when it was published.

        Raises:
            BagError: the disk is full, or gone.
        """
        row = self._rows[topic]
        try:
            if self._begun_ns is None:
                self._begun_ns = log_time_ns
            elif (self._split_ns or self._split_bytes) and self._is_full(log_time_ns, len(data)):
                self._split()
                self._begun_ns = log_time_ns
            if self._head:
                self._repeat(log_time_ns)
            row.sequence += 1
            self._writer.add_message(
                row.number,
                data,
                log_time_ns=log_time_ns,
                publish_time_ns=publish_time_ns,
                sequence=row.sequence,
            )
        except OSError as error:
            raise self._failure(error) from None
        if row.latest is not None:
            row.latest.append((data, publish_time_ns))

    def _is_full(self, log_time_ns: int, size: int) -> bool:
        """Whether the part has reached one of its limits."""
        assert self._begun_ns is not None, "it has a message"
        if self._split_ns and log_time_ns - self._begun_ns >= self._split_ns:
            return True
        if not self._split_bytes:
            return False
        self._unlooked_bytes += size
        if self._unlooked_bytes < self._chunk_bytes:  # no more than that was finished meanwhile
            return False
        self._unlooked_bytes = 0
        return self._writer.size >= self._split_bytes

    def _split(self) -> None:
        """End the part, and begin the next one with the same topics."""
        self._writer.finish()
        self._parts.append(self._writer.part)
        self._dropped_before.update(self._writer.part.dropped or {})
        self._begin()
        if self._counts_dropped:
            self._writer.add_metadata(DROPPED_NAME, {})
        for name, row in self._rows.items():
            self._announce(name, row)

    def _repeat(self, log_time_ns: int) -> None:
        """Write the last messages of latched topics at the head of a part."""
        rows = {name: self._rows[name] for name in self._head}
        self._head.clear()
        counts = {name: str(len(row.latest or ())) for name, row in rows.items()}
        self._writer.add_metadata(REPEATED_NAME, counts)
        for row in rows.values():
            for data, publish_time_ns in row.latest or ():
                self._writer.add_message(
                    row.number, data, log_time_ns=log_time_ns, publish_time_ns=publish_time_ns, sequence=0
                )

    def tell_dropped(self, dropped: Mapping[str, int]) -> None:
        """Note how many messages of each topic were lost by now, since this writer began.

        Raises:
            BagError: the disk is full, or gone.
        """
        here = {topic: n - self._dropped_before[topic] for topic, n in dropped.items()}
        told = self._writer.part.dropped
        news = {topic: str(n) for topic, n in here.items() if n != (told or {}).get(topic, 0)}
        if not news and told is not None:
            return
        self._counts_dropped = True
        self._add_metadata(DROPPED_NAME, news)

    def tell(self, about: Mapping[str, str]) -> None:
        """Add to what the bag is about.

        Raises:
            BagError: the disk is full, or gone.
        """
        self._about |= about
        self._add_metadata(METADATA_NAME, about)

    def _add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        try:
            self._writer.add_metadata(name, content)
        except OSError as error:
            raise self._failure(error) from None

    def sync(self) -> None:
        """Hand over all that was written: to the operating system now, and to the disk soon, by a thread.

        What a kill can take is then what came since the last call; what a power cut can take, what came since
        the last one but one, if the disk keeps up.

        Raises:
            BagError: the disk is full, or gone.
        """
        try:
            self._writer.flush()
            if self._disk.is_free:
                folder = os.open(self.folder, os.O_RDONLY)  # the names of new parts, too
                self._disk.begin([self._writer.descriptor(), folder])
        except OSError as error:
            raise self._failure(error) from None

    def close(self) -> None:
        """Finish the part and write metadata.yaml over all parts. Closing twice does nothing.

        Raises:
            BagError: the disk is full, or gone.
        """
        if self._writer.closed:
            return
        try:
            self._disk.wait()
            self._writer.finish()
            write_metadata(self.folder, [*self._parts, self._writer.part])
        except OSError as error:
            raise self._failure(error) from None
        finally:
            self._disk.close()
            self._lock.release()

    def _failure(self, error: OSError) -> BagError:
        """Give the file up as it is: what was written until now stays."""
        self._writer.abandon()
        self._disk.close()
        self._lock.release()
        return BagError(
            f"bag {self.folder} cannot be written any further: {error.strerror}; its MCAP file has no index, "
            "and holds what was written until now"
        )

    def __enter__(self) -> Self:
        """Use the writer in a `with` statement."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag, also when the block failed: what was recorded stays readable."""
        self.close()


def _earlier_parts(folder: Path) -> list[Part]:
    """The parts of a bag whose writer was killed, mended. None, if it was killed before it began one."""
    if (folder / FILE_NAME).exists():
        raise BagError(f"bag {folder} was closed: it has a {FILE_NAME}; expected one whose writer was killed")
    if not part_paths(folder) and any(folder.iterdir()):
        raise BagError(f"folder {folder} holds files, but no MCAP file; expected a bag to go on with")
    parts, _ = mend_parts(folder)
    return parts


def _definition(topic: str, type: str) -> bytes:
    try:
        return definitions.definition(type)
    except BagError as error:
        raise BagError(f"topic {topic} is of type {error}") from None
