"""Write a rosbag2 folder: MCAP files, and metadata.yaml.

Messages are stored serialised, as received. The MCAP files are complete without metadata.yaml.

A bag has one part, `<folder>_0.mcap`, unless it is split or a killed writer is resumed, which starts the next
part. Each later part begins with the last messages of each latched topic, one for each of its publishers, so
that it can be read alone. They keep their publish time, have the log time of the part's first new message and
the sequence 0, and are counted in a metadata record.
"""

import os
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from rosbags.rosbag2.metadata import dump_qos_v9

from uav_dc_ros.bags import message_definitions, metadata
from uav_dc_ros.bags.metadata import Part, is_latched, merged
from uav_dc_ros.bags.part_writer import CHUNK_BYTES, PartWriter, folder_lock, part_number, part_paths
from uav_dc_ros.bags.salvage.repair import repair_parts
from uav_dc_ros.errors import BagError

if TYPE_CHECKING:
    from mcap.records import Attachment
    from rosbags.interfaces import Qos

MIN_CHUNKS_PER_PART = 8  # keeps the size of a part close to the limit
MIN_CHUNK_BYTES = 1024


@dataclass(kw_only=True)
class _WrittenTopic:
    type: str
    definition: bytes
    encoding: str  # of the definition
    serialization: str  # of the messages
    metadata: Mapping[str, str]  # rosbag2's, of the topic's channels
    latest: deque[tuple[bytes, int]] | None  # last messages with publish times; None unless it is latched
    sequence: int  # of the last message, counted from 1 over all parts
    channel: int = 0  # id in the current part


class BagWriter:
    """Writes a bag into a new folder; a context manager that closes it.

    `resume` continues a bag whose writer was killed: its parts are repaired, and a new one begins. Of
    `about`, the bag's description by key, values of earlier parts stay. The next part begins at `split_bytes`
    (a part exceeds them by at most a chunk, a message and the index) or after `split_s` of log time (0: off).
    With a `name`, `folder` is an empty temporary one of the bag with that name.

    Raises BagError if the folder exists or cannot be made; when resuming, if there is none, or the bag was
    closed, is still being written, or cannot be repaired; in all methods, if the disk is full or gone.
    """

    def __init__(
        self,
        folder: Path,
        about: Mapping[str, str],
        *,
        name: str = "",
        resume: bool = False,
        compression: str = "zstd",
        split_bytes: int = 0,
        split_s: float = 0.0,
    ) -> None:
        self.folder = folder
        self._name = name or folder.name
        self._about = dict(about)
        self._compression = compression
        self._split_bytes, self._split_ns = split_bytes, round(split_s * 1e9)
        chunk_bytes = max(split_bytes // MIN_CHUNKS_PER_PART, MIN_CHUNK_BYTES)
        self._chunk_bytes = min(CHUNK_BYTES, chunk_bytes) if split_bytes else CHUNK_BYTES
        self._splits = bool(split_bytes or self._split_ns)
        self._writer: PartWriter
        self._begun_ns: int | None  # log time of the part's first message
        self._topics: dict[str, _WrittenTopic] = {}
        self._dropped_before: Counter[str] = Counter()  # in parts that this writer finished
        self._sync_thread = ThreadPoolExecutor(1, thread_name_prefix="fsync")
        self._last_sync: Future[None] | None = None
        if not (resume or name):
            if folder.exists():
                raise BagError(f"bag folder {folder} exists already; expected a new one")
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise BagError(f"bag folder {folder} cannot be made: {error.strerror}") from None
        with ExitStack() as closing:
            closing.enter_context(folder_lock(folder))
            closing.callback(self._sync_thread.shutdown)
            try:
                self._finished = _earlier_parts(folder) if resume else []
                self._resumed = merged(self._finished)
                self._begin_part()
            except OSError as error:
                raise BagError(f"bag {folder} cannot be written: {error.strerror}") from None
            self._closing = closing.pop_all()

    @property
    def message_count(self) -> int:
        """Messages in the bag so far, with those of earlier parts and repeated ones."""
        return sum(part.message_count for part in self._parts)

    @property
    def closed(self) -> bool:
        """Whether the bag was closed, or abandoned after an error."""
        return self._writer.closed

    @property
    def topics(self) -> list[str]:
        """Full names of the topics that were added."""
        return list(self._topics)

    @property
    def part_count(self) -> int:
        """Parts of the bag so far."""
        return len(self._parts)

    @property
    def already_written(self) -> Mapping[str, int]:
        """Latest publish time by topic in the parts of a killed writer.

        A new subscription receives latched messages again; those that are not newer are in the bag.
        """
        return self._resumed.published_ns

    @property
    def _parts(self) -> list[Part]:
        return [*self._finished, self._writer.part]

    def add_topic(
        self,
        name: str,
        type: str,
        offered_qos: "Iterable[Qos]" = (),
        *,
        definition: bytes = b"",
        encoding: str = message_definitions.ENCODING,
        type_hash: str = "",
        serialization: str = "cdr",
    ) -> None:
        """Add a topic, once, before its first message.

        A topic with messages in earlier parts keeps their QoS: metadata.yaml has one QoS for a topic, and
        rosbags skips channels with another one. A type that ROS 2 does not have needs its `definition` in
        `encoding`, with all types inside it, and its hash (REP-2011); without an encoding, none is written.
        Raises BagError without that, or if earlier parts have another type.
        """
        qos = dump_qos_v9(list(offered_qos))
        earlier = self._resumed.topics.get(name)
        if earlier is not None:
            if earlier["type"] != type:
                expected = f"expected {earlier['type']}, as in earlier parts"
                raise BagError(f"topic {name} is of type {type}; {expected}")
            if self._resumed.counts[name]:
                qos = earlier["offered_qos_profiles"]
        if encoding and not definition:
            try:
                definition = message_definitions.definition(type)
            except BagError as error:
                raise BagError(f"topic {name} is of type {error}") from None
            type_hash = message_definitions.typestore().hash_rihs01(type)
        topic = _WrittenTopic(
            type=type,
            definition=definition,
            encoding=encoding,
            serialization=serialization,
            metadata={"offered_qos_profiles": metadata.to_yaml(qos), "topic_type_hash": type_hash},
            latest=deque(maxlen=len(qos)) if is_latched({"offered_qos_profiles": qos}) else None,
            sequence=self._resumed.counts.get(name, 0) - self._resumed.repeated.get(name, 0),
        )
        if topic.latest is not None and name in self._resumed.latest:
            topic.latest.append(self._resumed.latest[name])
        with self._disk_errors():  # a definition can fill the chunk
            self._add_channel(name, topic)
        self._topics[name] = topic

    def keep_latched(self, topic: str, n: int) -> None:
        """Repeat at least the last `n` messages of a latched topic (one of each publisher) in each part."""
        written = self._topics[topic]
        if written.latest is not None and n > (written.latest.maxlen or 0):
            written.latest = deque(written.latest, maxlen=n)

    def hold(self, topic: str, data: bytes, publish_time_ns: int) -> None:
        """Repeat a message of a latched topic that is older than the bag in each of its parts, the first too.

        Before the first call of `write`; of a topic the older message first.
        """
        latest = self._topics[topic].latest
        if latest is not None:
            latest.append((data, publish_time_ns))
            if topic not in self._to_repeat:
                self._to_repeat.append(topic)

    def holds(self, topic: str, data: bytes, publish_time_ns: int) -> bool:
        """Whether a message is among the last ones of a latched topic."""
        return (data, publish_time_ns) in (self._topics[topic].latest or ())

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Append a metadata record of other software."""
        with self._disk_errors():
            self._writer.add_metadata(name, content)

    def add_attachment(self, attachment: "Attachment") -> None:
        """Append a copy of an attachment."""
        with self._disk_errors():
            self._writer.add_attachment(attachment)

    def latched_depth(self, topic: str) -> int:
        """How many messages of a topic each part repeats; 0: it is not latched."""
        latest = self._topics[topic].latest
        return 0 if latest is None else latest.maxlen or 0

    def write(self, topic: str, data: bytes, *, log_time_ns: int, publish_time_ns: int) -> None:
        """Append a message of an added topic, serialised (CDR); times are nanoseconds since the epoch."""
        written = self._topics[topic]
        try:  # a context manager for each message takes half as long as the message
            if self._begun_ns is None:
                self._begun_ns = log_time_ns
            elif self._splits and self._is_full(self._begun_ns, log_time_ns, len(data)):
                self._split()
                self._begun_ns = log_time_ns
            if self._to_repeat:
                self._repeat_latched(log_time_ns)
            written.sequence += 1
            self._writer.add_message(written.channel, data, log_time_ns, publish_time_ns, written.sequence)
        except OSError as error:
            raise self._abandoned(error) from None
        if written.latest is not None:
            written.latest.append((data, publish_time_ns))

    def split(self) -> bool:
        """Begin the next part, unless this one has no message yet; returns whether it did."""
        if self._begun_ns is None:
            return False
        with self._disk_errors():
            self._split()
        return True

    def add_about(self, about: Mapping[str, str]) -> None:
        """Add to the description of the bag."""
        self._about |= about
        with self._disk_errors():
            self._writer.add_metadata(metadata.ABOUT_RECORD, about)

    def set_dropped(self, dropped: Mapping[str, int]) -> None:
        """Record how many messages of each topic were lost since this writer began."""
        recorded = self._writer.part.dropped
        in_part = {topic: n - self._dropped_before[topic] for topic, n in dropped.items()}
        changes = {topic: str(n) for topic, n in in_part.items() if n != (recorded or {}).get(topic, 0)}
        if changes or recorded is None:
            with self._disk_errors():
                self._writer.add_metadata(metadata.DROPPED_RECORD, changes)

    def sync(self) -> None:
        """Write everything to the operating system, and start a sync to disk in a thread.

        A kill then loses only what follows this call; a power cut, what follows the call before it, if the
        disk keeps up: no sync starts while another one runs.
        """
        with self._disk_errors():
            self._writer.flush()
            if self._last_sync is None or self._last_sync.done():
                self._finish_sync()
                folder = os.open(self.folder, os.O_RDONLY)  # for the names of new parts
                descriptors = (self._writer.descriptor(), folder)
                self._last_sync = self._sync_thread.submit(_fsync_and_close, descriptors)

    def close(self) -> None:
        """Finish the part and write metadata.yaml over all parts; a second call does nothing."""
        if self.closed:
            return
        with self._closing, self._disk_errors():
            self._finish_sync()
            self._writer.finish()
            metadata.write_metadata(self.folder, self._parts)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()  # also after an error: the messages stay readable

    def _finish_sync(self) -> None:
        """Wait for the last sync; OSError if it failed."""
        if self._last_sync is not None:
            self._last_sync.result()

    def _begin_part(self) -> None:
        number = max((part_number(part.name) for part in self._finished), default=-1) + 1
        self._begun_ns = None
        self._unchecked_bytes = 0  # written since the file's size was checked
        # Ids by type, encoding and definition; 0: a channel without a schema.
        self._schemas: dict[tuple[str, str, bytes], int] = {("", "", b""): 0}
        self._to_repeat: list[str] = []  # topics whose last messages are not repeated yet
        self._writer = PartWriter(
            self.folder / f"{self._name}_{number}.mcap",
            compression=self._compression,
            chunk_bytes=self._chunk_bytes,
        )
        self._writer.add_metadata(metadata.ABOUT_RECORD, self._about)

    def _add_channel(self, name: str, topic: _WrittenTopic) -> None:
        schema = topic.type, topic.encoding, topic.definition
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.add_schema(*schema)
        given = self._schemas[schema], topic.metadata
        topic.channel = self._writer.add_channel(name, topic.serialization, *given)
        if topic.latest:
            self._to_repeat.append(name)

    def _is_full(self, begun_ns: int, log_time_ns: int, n_bytes: int) -> bool:
        """Whether the part is at a limit before a message of `n_bytes`."""
        if self._split_ns and log_time_ns - begun_ns >= self._split_ns:
            return True
        if not self._split_bytes:
            return False
        self._unchecked_bytes += n_bytes
        if self._unchecked_bytes < self._chunk_bytes:  # the file has not grown by more than that
            return False
        self._unchecked_bytes = 0
        return self._writer.size >= self._split_bytes

    def _split(self) -> None:
        """Finish the part, and begin the next one with the same topics."""
        dropped = self._writer.part.dropped
        self._writer.finish()
        self._finished.append(self._writer.part)
        self._dropped_before.update(dropped or {})
        self._begin_part()
        if dropped is not None:
            self._writer.add_metadata(metadata.DROPPED_RECORD, {})
        for name, topic in self._topics.items():
            self._add_channel(name, topic)

    def _repeat_latched(self, log_time_ns: int) -> None:
        """Write the last messages of latched topics at the head of the part."""
        repeated = {name: self._topics[name] for name in self._to_repeat}
        self._to_repeat.clear()
        counts = {name: str(len(topic.latest or ())) for name, topic in repeated.items()}
        self._writer.add_metadata(metadata.REPEATED_RECORD, counts)
        for topic in repeated.values():
            for data, publish_time_ns in topic.latest or ():
                self._writer.add_message(topic.channel, data, log_time_ns, publish_time_ns, sequence=0)

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        """Raises BagError for an OSError in the block, and abandons the bag."""
        try:
            yield
        except OSError as error:
            raise self._abandoned(error) from None

    def _abandoned(self, error: OSError) -> BagError:
        """Abandon the bag: what was written stays."""
        self._writer.abandon()
        self._closing.close()
        if self._name != self.folder.name:
            return BagError(f"bag {self._name} cannot be written: {error.strerror}; nothing is left of it")
        return BagError(
            f"bag {self.folder} cannot be written any further: {error.strerror}; its MCAP file has no "
            "index, and holds what was written so far"
        )


def _earlier_parts(folder: Path) -> list[Part]:
    """The repaired parts of a bag whose writer was killed; none if it was killed before the first one."""
    if (folder / metadata.METADATA_FILE).exists():
        expected = "expected one whose writer was killed"
        raise BagError(f"bag {folder} was closed: it has a metadata.yaml; {expected}")
    if not part_paths(folder) and any(folder.iterdir()):
        raise BagError(f"folder {folder} holds files, but no MCAP file; expected a bag to resume")
    return repair_parts(folder).parts


def _fsync_and_close(descriptors: Sequence[int]) -> None:
    try:
        for descriptor in descriptors:
            os.fsync(descriptor)
    finally:
        for descriptor in descriptors:
            os.close(descriptor)
