"""What the storage files of a bag have in common, where they are, and their errors."""

import heapq
import re
import sqlite3
import stat
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Metadata

from uav_dc_ros.bags.part_writer import part_paths
from uav_dc_ros.bags.salvage.scan import Damage
from uav_dc_ros.errors import BagDamagedError, BagError

SQLITE_MAGIC = b"SQLite format 3\0"
RECOVER = "python -m uav_dc_ros.bag recover"
MESSAGE_BYTES = 400  # memory of a message beside its data
# First bytes of files that are not MCAP files, and a description.
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
# Errors of mcap, struct, zstandard, lz4 (RuntimeError) and sqlite3 for damaged bytes. Any other, such as a
# TypeError, is a bug.
_DAMAGE_ERRORS = (
    McapError, struct.error, zstandard.ZstdError, sqlite3.Error, RuntimeError, ValueError, EOFError,
    LookupError, OverflowError, MemoryError,
)  # fmt: skip
_COMPRESSED_FILE = re.compile(r"\.(mcap|db3)\.\w+$")
_Key = TypeVar("_Key", int, tuple[int, int])


class BagMessage(NamedTuple):
    """A message of a bag, its data serialised (CDR)."""

    topic: str
    type: str
    data: bytes
    log_time_ns: int  # receive time, nanoseconds since the epoch
    publish_time_ns: int  # publish time; the log time, if the bag has none


@dataclass(kw_only=True)
class RecordedTopic:
    """A topic of a bag."""

    name: str
    type: str
    definition: bytes = b""  # the type with all types inside it, as text in `encoding`; empty without one
    encoding: str = "ros2msg"  # of the definition: `ros2msg`, or `ros2idl`
    serialization: str = "cdr"  # of the messages, `cdr` in ROS 2
    is_json: bool = False  # whether it is recorded as JSON, and read as std_msgs/String: see `json_channels`
    type_hash: str = ""  # of the type (REP-2011); empty if the bag has none
    offered_qos: str = ""  # the publishers' QoS, rosbag2's YAML; empty if the bag has none
    count: int = 0  # messages
    other_types: tuple[str, ...] = ()  # further types of the topic's messages; ROS 2 allows only one


def merge_topic(topics: dict[str, RecordedTopic], topic: RecordedTopic) -> None:
    """Add a topic to those by name, also one of another channel or file with the same name."""
    known = topics.setdefault(topic.name, topic)
    if known is topic:
        return
    if not known.count and topic.count:
        known.offered_qos = topic.offered_qos
    known.count += topic.count
    new = {topic.type, *topic.other_types} - {known.type, *known.other_types}
    known.other_types += tuple(sorted(new))


@dataclass(kw_only=True)
class Storage:
    """The contents of a storage file; `about`, `dropped` and `repeated` are as in `metadata.Part`."""

    path: Path
    topics: list[RecordedTopic]
    first_ns: int
    last_ns: int
    # Those of some topics (None: all) from a log time on and before another, sorted by log time.
    messages: Callable[[Collection[str] | None, int | None, int | None], Iterator[BagMessage]]
    # The same in the order of recording.
    recorded: Callable[[Collection[str] | None, int | None, int | None], Iterator[BagMessage]]
    # The last messages of a topic, at most a number of them, before a log time, in order.
    latest: Callable[[str, int, int], list[BagMessage]]
    goes_back_ns: Callable[[], int]  # the longest step back in log time within a topic; reads the file
    about: dict[str, str] = field(default_factory=dict)
    dropped: dict[str, int] | None = None
    repeated: dict[str, int] = field(default_factory=dict)  # those left out
    head: Callable[[], list[BagMessage]] = list  # the messages that are left out
    metadata: Sequence[Metadata] = ()  # records of other software
    attachments: Callable[[], Iterator[Attachment]] = lambda: iter(())
    library: str = ""  # name of the software that wrote the file
    damages: Sequence[Damage] = ()  # unusable places; only known of a file that was scanned
    has_end: bool = True  # whether the file is finished
    has_index: bool = True  # whether messages are found without reading the whole file
    # Topics whose messages rosbag2 compressed individually, among those read so far.
    compressed: set[str] = field(default_factory=set)


def storage_files(path: Path) -> list[Path]:
    """The MCAP files of a bag, or the files of its SQLite storage, in their order; may raise BagError."""
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
    found = part_paths(path) or part_paths(path, ".db3")
    if found:
        return found
    compressed = sorted(file.name for file in path.iterdir() if _COMPRESSED_FILE.search(file.name))
    if compressed:
        raise BagError(
            f"bag {path} holds {compressed[0]}, which is compressed as a whole; expected its files unpacked, "
            "as `zstd -d` does"
        )
    expected = "expected at least one (*.mcap), or SQLite storage (*.db3)"
    raise BagError(f"bag {path} holds no MCAP file; {expected}")


def describe_foreign(beginning: bytes) -> str:
    """What a file is that is not an MCAP file, by its first bytes, and what was expected."""
    for magic, description in FOREIGN.items():
        if beginning.startswith(magic):
            return description
    return f"starts with {beginning!r}; expected an MCAP file, or SQLite storage"


def goes_back_ns(times: Iterable[tuple[object, int]]) -> int:
    """The longest step back between consecutive log times of a topic (or channel), given both by message."""
    max_ns, last_ns = 0, dict[object, int]()
    for topic, time_ns in times:
        max_ns = max(max_ns, last_ns.get(topic, 0) - time_ns)
        last_ns[topic] = time_ns
    return max_ns


def sorted_within(
    keyed: Iterable[tuple[_Key, BagMessage]],
    max_bytes: int,
    is_due: Callable[[_Key], bool] = lambda key: False,
) -> Iterator[tuple[_Key, BagMessage]]:
    """Messages sorted by their keys within a buffer of `max_bytes`; those of equal keys keep their order.

    `is_due` is true of a key that no smaller one follows.
    """
    waiting: list[tuple[_Key, int, BagMessage]] = []  # key, number
    waiting_bytes = 0
    for n, (key, message) in enumerate(keyed):
        heapq.heappush(waiting, (key, n, message))
        waiting_bytes += len(message.data) + MESSAGE_BYTES
        while waiting and (waiting_bytes > max_bytes or is_due(waiting[0][0])):
            first_key, _, first = heapq.heappop(waiting)
            waiting_bytes -= len(first.data) + MESSAGE_BYTES
            yield first_key, first
    while waiting:
        first_key, _, first = heapq.heappop(waiting)
        yield first_key, first


@contextmanager
def read_errors(path: Path) -> Iterator[None]:
    """Raises BagError for an OSError in the block."""
    try:
        yield
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror or error}") from None


@contextmanager
def damage_errors(path: Path, help: str = f"; {RECOVER} recovers the intact rest") -> Iterator[None]:
    """Raises BagDamagedError for errors of libraries; the block may not call code of this package."""
    try:
        with read_errors(path):
            yield
    except _DAMAGE_ERRORS as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BagDamagedError(f"{path} is damaged: {reason}{help}") from None
