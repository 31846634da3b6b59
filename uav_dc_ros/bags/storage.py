"""The storage files of a bag: MCAP through mcap, rosbag2's SQLite through rosbags."""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.metadata import dump_qos_v9

from uav_dc_ros.bags.metadata import Part, to_yaml
from uav_dc_ros.bags.part import part_paths
from uav_dc_ros.bags.scan import MAGIC, Scan, has_end
from uav_dc_ros.errors import BagError, UavDcError

SQLITE = "*.db3"


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

    `about` and `dropped` are those of `metadata.Part`.
    """

    path: Path
    topics: list[RecordedTopic]
    first_ns: int
    last_ns: int
    messages: Callable[[Collection[str] | None, int | None, int | None], Iterator[BagMessage]]
    about: dict[str, str] = field(default_factory=dict)
    dropped: dict[str, int] | None = None


def storage_files(path: Path) -> list[Path]:
    """The storage files of a bag, in their order; for SQLite storage the folder itself.

    Raises:
        BagError: there is no bag.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagError(f"bag {path}: no such folder or file")
    found = part_paths(path)
    if found:
        return found
    if any(path.glob(SQLITE)):
        return [path]
    raise BagError(f"bag {path} holds no MCAP file; expected at least one (*.mcap)")


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """What goes wrong inside the libraries, in words; nothing of ours is to be called in it."""
    try:
        yield
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror or error}") from None
    except UavDcError:
        raise
    except Exception as error:  # of mcap, struct, zstandard, lz4, sqlite3: damaged bytes
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BagError(
            f"{path} is damaged: {told}; python -m uav_dc_ros.bag recover brings back what is whole"
        ) from None


def open_mcap(path: Path, file: IO[bytes], *, repeats: bool = True) -> Storage:
    """An MCAP file that has its end.

    Args:
        path: the file's.
        file: open for reading.
        repeats: give the latched messages at its head that an earlier file of the bag holds already?

    Raises:
        BagError: no MCAP file, one without its end, or a damaged one.
    """
    with _damage(path):
        whole, start = has_end(file), _start(file)
    if not MAGIC.startswith(start) and not start.startswith(MAGIC):
        raise BagError(f"{path} starts with {start!r}; expected {MAGIC!r}, as an MCAP file does")
    if not whole:
        raise BagError(
            f"{path} has no end: its recorder was killed, or still writes it; expected a whole bag, as "
            "python -m uav_dc_ros.bag recover makes of it"
        )
    with _damage(path):
        file.seek(0)
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise McapError("its summary has no statistics")
        told = Part(path.name)
        for metadata in reader.iter_metadata():
            told.learn(metadata.name, metadata.metadata)
        left_out = {} if repeats else told.repeated
        statistics = summary.statistics
        topics = [
            _topic(channel, summary.schemas.get(channel.schema_id), statistics.channel_message_counts)
            for channel in summary.channels.values()
        ]
        for topic in topics:
            topic.count -= left_out.get(topic.name, 0)

    def messages(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        if not summary.chunk_indexes:  # nothing to seek by: in the order of the file
            with _damage(path):
                yield from _scanned(path, file, topics, start_ns, end_ns)
            return
        stream = reader.iter_messages(topics, starting_at=start_ns, ending_before=end_ns)
        while True:
            with _damage(path):
                found = next(stream, None)
            if found is None:
                return
            schema, channel, message = found
            if message.sequence == 0 and channel.topic in left_out:
                continue
            yield _message(channel.topic, schema.name if schema else "", message)

    return Storage(
        path=path,
        topics=topics,
        first_ns=statistics.message_start_time,
        last_ns=statistics.message_end_time,
        messages=messages,
        about=told.about,
        dropped=told.dropped,
    )


def _start(file: IO[bytes]) -> bytes:
    file.seek(0)
    return file.read(len(MAGIC))


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
    path: Path, file: IO[bytes], topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
) -> Iterator[BagMessage]:
    """Messages of a file without chunks, as they lie in it."""
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    for record in Scan(path, file):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = record.topic, schemas.get(record.schema_id, "")
        elif isinstance(record, Message):
            topic, type = channels[record.channel_id]
            early = start_ns is not None and record.log_time < start_ns
            late = end_ns is not None and record.log_time >= end_ns
            if not early and not late and (topics is None or topic in topics):
                yield _message(topic, type, record)


def open_sqlite(folder: Path, closing: ExitStack) -> Storage:
    """A folder in rosbag2's SQLite storage.

    Raises:
        BagError: it cannot be read.
    """
    try:
        reader = Reader(folder)
        reader.open()
    except (ReaderError, OSError) as error:
        raise BagError(f"bag {folder} cannot be read: {error}") from None
    closing.callback(reader.close)
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
            with _damage(folder):
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
