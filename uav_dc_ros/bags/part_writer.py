"""One MCAP file of a bag while it is written, and the lock and the files of a bag's folder."""

import contextlib
import fcntl
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from mcap.records import Attachment
from mcap.writer import CompressionType, Writer

from uav_dc_ros import __version__
from uav_dc_ros.bags.metadata import ROSBAG2_RECORD, Part, information, to_yaml
from uav_dc_ros.errors import BagError

CHUNK_BYTES = 128 * 1024  # a killed writer loses its unfinished chunk
_NUMBER = re.compile(r"_(\d+)\.\w+$")


def part_number(name: str) -> int:
    """The number in a file name `<bag>_<number>.mcap`; -1 without one."""
    found = _NUMBER.search(name)
    return int(found[1]) if found else -1


def part_paths(folder: Path, suffix: str = ".mcap") -> list[Path]:
    """The storage files of a bag, without hidden ones, by number; BagError if the folder is unreadable."""
    try:
        paths = [path for path in folder.iterdir() if path.suffix == suffix and not path.name.startswith(".")]
    except OSError as error:
        raise BagError(f"bag {folder} cannot be read: {error.strerror}") from None
    return sorted(paths, key=lambda path: (part_number(path.name), path.name))


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Lock a bag's folder, so that no repair replaces a file that is still written.

    The kernel releases the lock of a process that ends. Raises BagError if the bag is being written or
    repaired, or there is no such folder.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise BagError(f"bag {folder}: {error.strerror}; expected the folder of a bag") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise BagError(f"bag {folder} is being written or repaired; expected one at rest") from None
    except OSError:
        pass  # some network file systems have no locks
    try:
        yield
    finally:
        os.close(descriptor)


class PartWriter:
    """Writes one new MCAP file in chunks, and records its contents in `part`.

    `name` is the part's name, if `path` is temporary; `chunk_bytes` the size of a chunk before compression.
    All methods may raise OSError, which the owner of the bag translates.
    """

    def __init__(
        self, path: Path, *, name: str = "", compression: str = "zstd", chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        self.part = Part(name or path.name)
        self._topics: dict[int, str] = {}  # by channel
        self._types: dict[int, str] = {0: ""}  # by schema; 0: without one
        self._file = path.open("xb")
        try:
            compressed = CompressionType[compression.upper()]
            self._mcap = Writer(self._file, chunk_size=chunk_bytes, compression=compressed)
            self._mcap.start(profile="ros2", library=f"uav_dc_ros {__version__}")
            self._file.flush()
        except OSError:
            self.abandon()
            raise

    @property
    def closed(self) -> bool:
        """Whether the file was finished or abandoned."""
        return self._file.closed

    @property
    def size(self) -> int:
        """Bytes of the file so far, without the current chunk."""
        return self._file.tell()

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self.part.add_metadata(name, content)
        self._mcap.add_metadata(name, dict(content))
        self._file.flush()

    def add_attachment(self, record: Attachment) -> None:
        """Append a copy of an attachment."""
        times = record.create_time, record.log_time
        self._mcap.add_attachment(*times, record.name, record.media_type, record.data)

    def add_schema(self, type: str, encoding: str, definition: bytes) -> int:
        """Append a message type; returns its schema id."""
        schema = self._mcap.register_schema(type, encoding, definition)
        self._types[schema] = type
        return schema

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Append a topic with rosbag2's channel metadata; returns its channel id."""
        self.part.add_topic(topic, self._types[schema], encoding, metadata)
        channel = self._mcap.register_channel(topic, encoding, schema, dict(metadata))
        self._topics[channel] = topic
        return channel

    def add_message(
        self, channel: int, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int
    ) -> None:
        """Append a message."""
        self._mcap.add_message(channel, log_time_ns, data, publish_time_ns, sequence)
        self._file.flush()  # a finished chunk survives a kill
        self.part.add_message(self._topics[channel], log_time_ns, publish_time_ns)

    def flush(self) -> None:
        """Finish the current chunk, and write it to the operating system."""
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def descriptor(self) -> int:
        """A duplicate file descriptor for `os.fsync`; the caller closes it."""
        return os.dup(self._file.fileno())

    def finish(self) -> None:
        """Write the end of the file, with rosbag2's metadata record of this part, and sync it to disk."""
        self._mcap.add_metadata(ROSBAG2_RECORD, {"serialized_metadata": to_yaml(information([self.part]))})
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Close the file without its end; its finished chunks stay."""
        with contextlib.suppress(OSError):
            self._file.close()
