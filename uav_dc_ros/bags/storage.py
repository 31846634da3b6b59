"""The storage files of a bag: MCAP through mcap, rosbag2's SQLite through rosbags."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import dump_qos_v9

from uav_dc_ros.bags.metadata import read_metadata, to_yaml
from uav_dc_ros.bags.part import part_paths
from uav_dc_ros.bags.scan import Damage
from uav_dc_ros.errors import BagError, UavDcError

SQLITE = "*.db3"
COMPRESSED = "*.mcap.zstd"  # files that rosbag2 compressed as a whole
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
        about, dropped: as those of `metadata.Part`.
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
    dropped: dict[str, int] | None = None
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
def damage(path: Path, help: str = f"; {RECOVER} brings back what is whole") -> Iterator[None]:
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
            with damage(folder, ""):
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
