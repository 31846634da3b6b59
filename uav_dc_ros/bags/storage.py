"""What the storage files of a bag have in common, where they lie, and what goes wrong while they are read."""

import re
import sqlite3
import stat
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.exceptions import McapError

from uav_dc_ros.bags.part_writer import part_paths
from uav_dc_ros.bags.salvage.scan import Damage
from uav_dc_ros.errors import BagDamagedError, BagError

SQLITE = ".db3"
SQLITE_MAGIC = b"SQLite format 3\0"
RECOVER = "python -m uav_dc_ros.bag recover"
# What files that are no storage files begin with, and what they are.
FOREIGN = {
    b"\x28\xb5\x2f\xfd": "is compressed as a whole (zstd); expected it unpacked, as `zstd -d` does",
    b"\x04\x22\x4d\x18": "is compressed as a whole (lz4); expected it unpacked, as `lz4 -d` does",
    b"\x1f\x8b": "is compressed as a whole (gzip); expected it unpacked, as `gunzip` does",
    b"\xfd7zXZ\0": "is compressed as a whole (xz); expected it unpacked, as `xz -d` does",
    b"BZh": "is compressed as a whole (bzip2); expected it unpacked, as `bunzip2` does",
    b"PK\x03\x04": "is a ZIP archive; expected it unpacked",
    SQLITE_MAGIC[:8]: "is SQLite storage, which needs no recovery; expected an MCAP file",
    b"#ROSBAG": "is a bag of ROS 1; expected one of ROS 2, as `rosbags-convert` makes of it",
}
# What mcap, struct, zstandard, lz4 (RuntimeError) and sqlite3 raise for damaged bytes. Anything else, such as
# a TypeError, is a mistake of ours.
_DAMAGE = (
    McapError, struct.error, zstandard.ZstdError, sqlite3.Error, RuntimeError, ValueError, EOFError,
    LookupError, OverflowError, MemoryError,
)  # fmt: skip
_PACKED = re.compile(r"\.(mcap|db3)\.\w+$")


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
        other_types: further types that messages of this topic have; ROS 2 allows one only.
    """

    name: str
    type: str
    definition: bytes = b""
    encoding: str = "ros2msg"
    serialization: str = "cdr"
    offered_qos: str = ""
    count: int = 0
    other_types: tuple[str, ...] = ()

    def join(self, other: "RecordedTopic") -> None:
        """Enter what another channel, or another file, has of this topic."""
        if not self.count and other.count:
            self.offered_qos = other.offered_qos
        self.count += other.count
        new = {other.type, *other.other_types} - {self.type, *self.other_types}
        self.other_types += tuple(sorted(new))


Messages = Callable[[Collection[str] | None, int | None, int | None], Iterator[BagMessage]]


@dataclass(kw_only=True)
class Storage:
    """A storage file: what it holds, and its messages.

    Attributes:
        messages: those between two log times (the second one excluded), in the order of their log times.
        recorded: those of some topics, or all, in the order in which they were recorded.
        goes_back_ns: by how much the log time went back, at most, from one message of a topic to the next,
            nanoseconds; looks through the file.
        about, dropped, repeated: as those of `metadata.Part`; repeated messages are those left out.
        library: what wrote it, in its own words.
        damages: what of it cannot be used; told only where it was read as far as it goes.
        has_end: whether it is finished.
        has_index: whether its messages can be found without reading all of it.
        compressed: topics of whose messages rosbag2 compressed each by itself, among those read until now.
    """

    path: Path
    topics: list[RecordedTopic]
    first_ns: int
    last_ns: int
    messages: Messages
    recorded: Callable[[Collection[str] | None], Iterator[BagMessage]]
    goes_back_ns: Callable[[], int]
    about: dict[str, str] = field(default_factory=dict)
    dropped: dict[str, int] | None = None
    repeated: dict[str, int] = field(default_factory=dict)
    library: str = ""
    damages: Sequence[Damage] = ()
    has_end: bool = True
    has_index: bool = True
    compressed: set[str] = field(default_factory=set)


def storage_files(path: Path) -> list[Path]:
    """The storage files of a bag, in their order: MCAP files, or those of SQLite storage.

    Raises:
        BagError: there is no bag, or one that cannot be read.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise BagError(f"bag {path}: no such folder or file") from None
    except (OSError, ValueError) as error:
        raise BagError(f"bag {path} cannot be read: {getattr(error, 'strerror', error)}") from None
    if stat.S_ISREG(mode):
        return [path]
    if not stat.S_ISDIR(mode):
        raise BagError(f"bag {path}: expected a folder or a file")
    found = part_paths(path) or part_paths(path, SQLITE)
    if found:
        return found
    packed = sorted(file.name for file in path.iterdir() if _PACKED.search(file.name))
    if packed:
        raise BagError(
            f"bag {path} holds {packed[0]}, which is compressed as a whole; expected its files unpacked, as "
            "`zstd -d` does"
        )
    raise BagError(
        f"bag {path} holds no MCAP file; expected at least one (*.mcap), or SQLite storage (*.db3)"
    )


def foreign(beginning: bytes) -> str:
    """What a file is that is no MCAP file, by its first bytes, and what was expected."""
    for magic, told in FOREIGN.items():
        if beginning.startswith(magic):
            return told
    return f"starts with {beginning!r}; expected an MCAP file, or SQLite storage"


def goes_back_ns(times: Iterable[tuple[object, int]]) -> int:
    """The most by which a message's log time is earlier than that of the one before it on its topic, ns.

    Args:
        times: topic (or channel) and log time of each message, those of a topic in their order.
    """
    most_ns, last_ns = 0, dict[object, int]()
    for topic, time_ns in times:
        most_ns = max(most_ns, last_ns.get(topic, 0) - time_ns)
        last_ns[topic] = time_ns
    return most_ns


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """What goes wrong with a file, in words."""
    try:
        yield
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror or error}") from None


@contextmanager
def damage(path: Path, help: str = f"; {RECOVER} brings back what is whole") -> Iterator[None]:
    """What goes wrong inside the libraries, in words; nothing of ours is to be called in it."""
    try:
        with reading(path):
            yield
    except _DAMAGE as error:
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BagDamagedError(f"{path} is damaged: {told}{help}") from None
