"""The parts of a bag that is being written, one after the other: when one ends, and how the next begins."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from uav_dc_ros.bags import message_definitions
from uav_dc_ros.bags.metadata import DROPPED_NAME, METADATA_NAME, REPEATED_NAME, Part
from uav_dc_ros.bags.part_writer import CHUNK_BYTES, PartWriter, number

CHUNKS_OF_A_PART = 8  # at least, so that its size comes near to what was asked for
CHUNK_LEAST_BYTES = 1024


@dataclass(kw_only=True)
class Row:
    """A topic.

    Attributes:
        type: ROS 2 message type.
        definition: of the type, as `ros2msg`.
        channel: rosbag2's metadata of the topic.
        latest: last messages with their publish times, if the topic is latched.
        sequence: of the last message, counted from 1 over all parts.
        channel_id: in the part that is being written.
    """

    type: str
    definition: bytes
    channel: Mapping[str, str]
    latest: deque[tuple[bytes, int]] | None
    sequence: int
    channel_id: int = 0


class PartSeries:
    """Writes a bag's parts.

    Args:
        folder: the bag's.
        about: what the bag is about; each part tells it.
        earlier: parts that are there already.
        compression: see PartWriter.
        split_bytes, split_ns: size, and log time, at which a part ends; 0: never.

    Attributes:
        rows: topics by full name.
        current: the part that is being written.

    Raises (all methods): OSError, which whoever owns the bag puts into words.
    """

    def __init__(
        self,
        folder: Path,
        about: Mapping[str, str],
        earlier: Sequence[Part],
        *,
        compression: str,
        split_bytes: int,
        split_ns: int,
    ) -> None:
        self.rows: dict[str, Row] = {}
        self._folder = folder
        self._about = dict(about)
        self._closed = list(earlier)
        self._compression = compression
        self._split_bytes = split_bytes
        self._split_ns = split_ns
        self._splits = bool(split_bytes or split_ns)
        self._dropped_before: Counter[str] = Counter()  # in parts that were closed here
        self._begin()

    def _begin(self) -> None:
        """Begin the next part."""
        n = max((number(self._folder / part.name) for part in self._closed), default=-1) + 1
        small = self._split_bytes // CHUNKS_OF_A_PART if self._split_bytes else CHUNK_BYTES
        self._chunk_bytes = min(CHUNK_BYTES, max(small, CHUNK_LEAST_BYTES))
        self._begun_ns: int | None = None  # log time of its first message
        self._unlooked_bytes = 0  # written since the size of its file was looked at
        self._schemas: dict[str, int] = {}
        self._head: list[str] = []  # topics of which it has yet to repeat the last messages
        self.current = PartWriter(
            self._folder / f"{self._folder.name}_{n}.mcap",
            compression=self._compression,
            chunk_bytes=self._chunk_bytes,
        )
        self.current.add_metadata(METADATA_NAME, self._about)

    @property
    def all(self) -> list[Part]:
        """What each part holds by now, in their order."""
        return [*self._closed, self.current.part]

    def add(self, name: str, row: Row) -> None:
        """Announce a topic, once, before its first message."""
        self._announce(name, row)
        self.rows[name] = row

    def _announce(self, name: str, row: Row) -> None:
        """Enter a topic into the part."""
        if row.type not in self._schemas:
            self._schemas[row.type] = self.current.add_schema(
                row.type, message_definitions.ENCODING, row.definition
            )
        row.channel_id = self.current.add_channel(name, "cdr", self._schemas[row.type], row.channel)
        if row.latest:
            self._head.append(name)

    def write(self, topic: str, data: bytes, *, log_time_ns: int, publish_time_ns: int) -> None:
        """Append a message, at the head of a new part if this one is full."""
        row = self.rows[topic]
        if self._begun_ns is None:
            self._begun_ns = log_time_ns
        elif self._splits and self._is_full(self._begun_ns, log_time_ns, len(data)):
            self._split()
            self._begun_ns = log_time_ns
        if self._head:
            self._repeat(log_time_ns)
        row.sequence += 1
        self.current.add_message(
            row.channel_id,
            data,
            log_time_ns=log_time_ns,
            publish_time_ns=publish_time_ns,
            sequence=row.sequence,
        )
        if row.latest is not None:
            row.latest.append((data, publish_time_ns))

    def _is_full(self, begun_ns: int, log_time_ns: int, size: int) -> bool:
        """Whether the part has reached one of its limits; `size` of the next message, bytes."""
        if self._split_ns and log_time_ns - begun_ns >= self._split_ns:
            return True
        if not self._split_bytes:
            return False
        self._unlooked_bytes += size
        if self._unlooked_bytes < self._chunk_bytes:  # no more than that was finished meanwhile
            return False
        self._unlooked_bytes = 0
        return self.current.size >= self._split_bytes

    def _split(self) -> None:
        """End the part, and begin the next one with the same topics."""
        counted = self.current.part.dropped
        self.current.finish()
        self._closed.append(self.current.part)
        self._dropped_before.update(counted or {})
        self._begin()
        if counted is not None:
            self.current.add_metadata(DROPPED_NAME, {})
        for name, row in self.rows.items():
            self._announce(name, row)

    def _repeat(self, log_time_ns: int) -> None:
        """Write the last messages of latched topics at the head of a part."""
        rows = {name: self.rows[name] for name in self._head}
        self._head.clear()
        counts = {name: str(len(row.latest or ())) for name, row in rows.items()}
        self.current.add_metadata(REPEATED_NAME, counts)
        for row in rows.values():
            for data, publish_time_ns in row.latest or ():
                self.current.add_message(
                    row.channel_id,
                    data,
                    log_time_ns=log_time_ns,
                    publish_time_ns=publish_time_ns,
                    sequence=0,
                )

    def tell(self, about: Mapping[str, str]) -> None:
        """Add to what the bag is about."""
        self._about |= about
        self.current.add_metadata(METADATA_NAME, about)

    def tell_dropped(self, dropped: Mapping[str, int]) -> None:
        """Note, in each part its own, how many messages of each topic were lost by now."""
        here = {topic: n - self._dropped_before[topic] for topic, n in dropped.items()}
        told = self.current.part.dropped
        news = {topic: str(n) for topic, n in here.items() if n != (told or {}).get(topic, 0)}
        if news or told is None:
            self.current.add_metadata(DROPPED_NAME, news)
