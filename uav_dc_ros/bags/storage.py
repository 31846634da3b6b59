"""The storage files of a bag: MCAP through mcap, rosbag2's SQLite through rosbags."""

import heapq
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import dump_qos_v9

from uav_dc_ros.bags.frames import COMPRESSIONS, MAGIC
from uav_dc_ros.bags.metadata import METADATA_NAME, read_metadata, to_yaml
from uav_dc_ros.bags.part import part_paths
from uav_dc_ros.bags.scan import Damage, Scan, has_end
from uav_dc_ros.errors import BagError, UavDcError

SQLITE = "*.db3"
COMPRESSED = "*.mcap.zstd"  # files that rosbag2 compressed as a whole
WAITING_BYTES = 64 * 2**20  # of messages that wait for earlier ones; a clock that jumped is not waited for
MESSAGE_BYTES = 400  # that a message takes beside its data
RECOVER = "python -m uav_dc_ros.bag recover"


class BagMessage(NamedTuple):
    """A message as it lies in a bag.

    Attributes:
        topic: full name.
        type: ROS 2 message type.
        data: serialised (CDR).
        log_time_ns: when it was received, nanoseconds since the epoch.
        publish_time_ns: when it was published; the log time, where the bag does not tell.
    """

    topic: str
    type: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


@dataclass(kw_only=True)
class RecordedTopic:
    """A topic of a bag.

    Attributes:
        name: full name.
        type: ROS 2 message type.
        definition: the type with all types inside it, as text in `encoding`; empty where the bag has none.
        encoding: of the definition: `ros2msg`, or `ros2idl`.
        serialization: of the messages, `cdr` in ROS 2.
        offered_qos: the publishers' QoS, rosbag2's YAML; empty where the bag does not tell.
        count: messages.
    """

    name: str
    type: str
    definition: bytes = b""
    encoding: str = "ros2msg"
    serialization: str = "cdr"
    offered_qos: str = ""
    count: int = 0


@dataclass(kw_only=True)
class Storage:
    """A storage file: what it holds, and its messages between two log times (the second one excluded).

    Attributes:
        library: what wrote it, in its own words.
        damages: what of it cannot be used; told only where it was read as far as it goes.
        has_end: whether it is finished.
    """

    path: Path
    topics: list[RecordedTopic]
    first_ns: int
    last_ns: int
    messages: Callable[[Collection[str] | None, int | None, int | None], Iterator[BagMessage]]
    about: dict[str, str] = field(default_factory=dict)
    library: str = ""
    damages: Sequence[Damage] = ()
    has_end: bool = True


def storage_files(path: Path) -> list[Path]:
    """The storage files of a bag, in their order; for SQLite storage the folder itself.

    Raises:
        BagError: there is no bag, or one that is compressed as a whole.
    """
    if path.is_dir() and not part_paths(path) and any(path.glob(SQLITE)):
        return [path]
    return mcap_files(path)


def mcap_files(path: Path) -> list[Path]:
    """The MCAP files of a bag, in their order.

    Raises:
        BagError: there are none.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagError(f"bag {path}: no such folder or file")
    found = part_paths(path)
    if not found and any(path.glob(COMPRESSED)):
        raise BagError(f"bag {path} holds {COMPRESSED}; expected *.mcap, as `zstd -d` makes of them")
    if not found:
        raise BagError(f"bag {path} holds no MCAP file; expected at least one (*.mcap)")
    mode = str((read_metadata(path) or {}).get("compression_mode", "")).lower()
    if mode == "message":  # the chunks' own compression is another thing
        raise BagError(f"bag {path} holds messages that rosbag2 compressed one by one; expected plain ones")
    return found


@contextmanager
def _damage(path: Path, help: str = f"; {RECOVER} brings back what is whole") -> Iterator[None]:
    """What goes wrong inside the libraries, in words; nothing of ours is to be called in it."""
    try:
        yield
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror or error}") from None
    except UavDcError:
        raise
    except Exception as error:  # of mcap, struct, zstandard, lz4, sqlite3, rosbags: damaged bytes
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BagError(f"{path} is damaged: {told}{help}") from None


def open_mcap(path: Path, closing: ExitStack, *, torn: bool = False) -> Storage:
    """An MCAP file.

    Args:
        path: the file.
        closing: closes it.
        torn: read it as far as it goes, if it has no end or is damaged: once more for what it holds.

    Raises:
        BagError: no MCAP file; without `torn`, one without its end, or a damaged one.
    """
    with _damage(path):
        file = closing.enter_context(path.open("rb"))
    if torn:
        return _open_torn(path, file)
    with _damage(path):
        scan = Scan(path, file)
        whole = has_end(file)
    if not scan.size:
        raise BagError(f"{path} is empty; expected an MCAP file")
    if not MAGIC.startswith(scan.magic):
        raise BagError(f"{path} starts with {scan.magic!r}; expected {MAGIC!r}, as an MCAP file does")
    if not whole:
        raise BagError(
            f"{path} has no end: its recorder was killed, or still writes it; expected a whole bag, as "
            f"{RECOVER} makes of it"
        )
    with _damage(path):
        file.seek(0)
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise McapError("its summary has no statistics")
        about: dict[str, str] = {}
        for metadata in reader.iter_metadata():
            if metadata.name == METADATA_NAME:
                about |= metadata.metadata
        library = reader.get_header().library
        statistics = summary.statistics
        topics = [
            _topic(channel, summary.schemas.get(channel.schema_id), statistics.channel_message_counts)
            for channel in summary.channels.values()
        ]
    for index in summary.chunk_indexes:
        if index.compression not in COMPRESSIONS:
            raise BagError(
                f"{path}: unsupported compression type {index.compression!r}; expected one of {COMPRESSIONS}"
            )

    def messages(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        if not summary.chunk_indexes:  # nothing to seek by: in the order of the file
            scan = Scan(path, file)
            with _damage(path):
                yield from _scanned(scan, topics, start_ns, end_ns)
            if scan.lost_bytes:
                raise BagError(
                    f"{path} is damaged: {scan.lost_bytes} bytes; {RECOVER} brings back the others"
                )
            return
        stream = reader.iter_messages(topics, starting_at=start_ns, ending_before=end_ns)
        while True:
            with _damage(path):
                found = next(stream, None)
            if found is None:
                return
            schema, channel, message = found
            yield _message(channel.topic, schema.name if schema else "", message)

    return Storage(
        path=path,
        topics=topics,
        first_ns=statistics.message_start_time,
        last_ns=statistics.message_end_time,
        messages=messages,
        about=about,
        library=library,
    )


def _open_torn(path: Path, file: IO[bytes]) -> Storage:
    """An MCAP file as far as it goes: read once for what it holds, and again for its messages."""

    def messages(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        with _damage(path):
            yield from _scanned(Scan(path, file), scan.lag_ns, topics, start_ns, end_ns)

    schemas: dict[int, Schema] = {}
    topics: dict[str, RecordedTopic] = {}
    with _damage(path):
        scan = Scan(path, file)
        for record in scan:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                topics.setdefault(record.topic, _topic(record, schemas.get(record.schema_id), {}))
        ended = has_end(file)
    for name, count in scan.part.counts.items():
        topics[name].count = count
    return Storage(
        path=path,
        topics=list(topics.values()),
        first_ns=scan.part.first_ns or 0,
        last_ns=scan.part.last_ns,
        messages=messages,
        about=scan.part.about,
        library=scan.library,
        damages=scan.damages,
        has_end=ended,
    )


def _topic(channel: Channel, schema: Schema | None, counts: Mapping[int, int]) -> RecordedTopic:
    return RecordedTopic(
        name=channel.topic,
        type=schema.name if schema else "",
        definition=schema.data if schema else b"",
        encoding=schema.encoding if schema else "",
        serialization=channel.message_encoding,
        offered_qos=channel.metadata.get("offered_qos_profiles", ""),
        count=counts.get(channel.id, 0),
    )


def _message(topic: str, type: str, message: Message) -> BagMessage:
    return BagMessage(topic, type, message.data, message.log_time, message.publish_time)


def _scanned(
    scan: Scan, lag_ns: int, topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
) -> Iterator[BagMessage]:
    """Messages of a file that has no index to read it by, in the order of their log times.

    Args:
        scan: of the file, new.
        lag_ns: how much earlier than one before it a message may be, nanoseconds.
        topics, start_ns, end_ns: which messages.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    waiting: list[tuple[int, int, BagMessage]] = []  # log time, number in the file
    waiting_bytes = newest_ns = 0
    for n, record in enumerate(scan):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = record.topic, schemas.get(record.schema_id, "")
        elif isinstance(record, Message):
            topic, type = channels[record.channel_id]
            early = start_ns is not None and record.log_time < start_ns
            late = end_ns is not None and record.log_time >= end_ns
            newest_ns = max(newest_ns, record.log_time)
            if not early and not late and (topics is None or topic in topics):
                heapq.heappush(waiting, (record.log_time, n, _message(topic, type, record)))
                waiting_bytes += len(record.data) + MESSAGE_BYTES
            while waiting and (waiting[0][0] <= newest_ns - lag_ns or waiting_bytes > WAITING_BYTES):
                *_, message = heapq.heappop(waiting)
                waiting_bytes -= len(message.data) + MESSAGE_BYTES
                yield message
    while waiting:
        yield heapq.heappop(waiting)[2]


def open_sqlite(folder: Path, closing: ExitStack) -> Storage:
    """A folder in rosbag2's SQLite storage.

    Raises:
        BagError: it cannot be read.
    """
    try:
        reader = Reader(folder)
        reader.open()
        closing.callback(reader.close)
    except Exception as error:  # of rosbags, sqlite3, YAML: damaged, or no bag
        raise BagError(f"bag {folder} cannot be read: {error}") from None
    topics = []
    for connection in reader.connections:
        assert isinstance(connection.ext, ConnectionExtRosbag2), "a bag of ROS 2"
        topics.append(
            RecordedTopic(
                name=connection.topic,
                type=connection.msgtype,
                definition=connection.msgdef.data.encode(),
                encoding=connection.msgdef.format.name.lower(),
                serialization=connection.ext.serialization_format,
                offered_qos=to_yaml(dump_qos_v9(connection.ext.offered_qos_profiles)),
                count=connection.msgcount,
            )
        )

    def messages(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        wanted = [one for one in reader.connections if topics is None or one.topic in topics]
        if not wanted:
            return
        stream = reader.messages(wanted, start=start_ns, stop=end_ns)
        while True:
            with _damage(folder, ""):
                found = next(stream, None)
            if found is None:
                return
            connection, time_ns, data = found
            yield BagMessage(connection.topic, connection.msgtype, bytes(data), time_ns, time_ns)

    return Storage(
        path=folder,
        topics=topics,
        first_ns=reader.start_time,
        last_ns=reader.end_time - 1,  # rosbags ends after the last message
        messages=messages,
    )
