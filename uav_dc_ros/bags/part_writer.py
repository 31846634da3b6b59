"""One MCAP file of a bag while it is written, and where the files of a bag lie."""

import contextlib
import fcntl
import os
import re
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.writer import CompressionType, Writer

from uav_dc_ros import __version__
from uav_dc_ros.bags.metadata import Part, information, to_yaml
from uav_dc_ros.errors import BagError

CHUNK_BYTES = 128 * 1024  # small: a chunk that was not finished is what a killed writer loses
MCAP = ".mcap"
_NUMBER = re.compile(r"_(\d+)\.\w+$")


def number(path: Path) -> int:
    """The number of a part by its name, `<bag>_<number>.mcap`; -1 without one."""
    found = _NUMBER.search(path.name)
    return int(found[1]) if found else -1


def part_paths(folder: Path, suffix: str = MCAP) -> list[Path]:
    """The storage files of a bag in the order of their numbers; hidden files are none of them.

    Args:
        folder: the bag's.
        suffix: of the files.

    Raises:
        BagError: the folder cannot be read.
    """
    try:
        paths = [path for path in folder.iterdir() if path.suffix == suffix and not path.name.startswith(".")]
    except OSError as error:
        raise BagError(f"bag {folder} cannot be read: {error.strerror}") from None
    return sorted(paths, key=lambda path: (number(path), path.name))


class FolderLock:
    """Held while a bag is written or mended; the kernel opens it when the process ends, however it ends.

    Without it, mending would move a file away from under a recorder that still writes it.

    Raises:
        BagError: somebody else holds it, or there is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        try:
            self._descriptor: int | None = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise BagError(f"bag {folder}: {error.strerror}; expected the folder of a bag") from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise BagError(f"bag {folder} is being written or mended; expected one at rest") from None
        except OSError:
            pass  # a file system without locks (some network ones): there the user has to take care

    def release(self) -> None:
        """Let the folder go. Twice does nothing more than once."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def __enter__(self) -> Self:
        """Hold the lock in a `with` statement."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Release the lock."""
        self.release()


class PartWriter:
    """Writes one MCAP file in chunks, and keeps count of what it holds.

    Args:
        path: the file; must not exist.
        name: the part's name, where the file has a temporary one.
        compression: of its chunks, one of `compression.COMPRESSIONS`.
        chunk_bytes: size at which a chunk is finished, before compression.

    Raises (all methods): OSError, which whoever owns the bag puts into words.
    """

    def __init__(
        self,
        path: Path,
        *,
        name: str | None = None,
        compression: str = "zstd",
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        self.part = Part(name or path.name)
        self._topics: dict[int, str] = {}  # by channel
        self._types: dict[int, str] = {0: ""}  # by schema; channel without schema: 0, as MCAP has it
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
        """Whether it was finished or abandoned."""
        return self._file.closed

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Append a metadata record; ours are those that `Part.learn` knows."""
        self.part.learn(name, content)
        self._mcap.add_metadata(name, dict(content))
        self._file.flush()

    def add_attachment(
        self, *, name: str, media_type: str, data: bytes, log_time_ns: int, create_time_ns: int
    ) -> None:
        """Append an attachment; times in nanoseconds since the epoch."""
        self._mcap.add_attachment(create_time_ns, log_time_ns, name, media_type, data)

    def add_schema(self, type: str, encoding: str, definition: bytes) -> int:
        """Append a message type; returns its number."""
        schema = self._mcap.register_schema(type, encoding, definition)
        self._types[schema] = type
        return schema

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Append a topic with rosbag2's metadata of it; returns the channel's number."""
        self.part.announce(topic, self._types[schema], encoding, metadata)
        channel = self._mcap.register_channel(topic, encoding, schema, dict(metadata))
        self._topics[channel] = topic
        return channel

    def add_message(
        self, channel: int, data: bytes, *, log_time_ns: int, publish_time_ns: int, sequence: int
    ) -> None:
        """Append a message; times in nanoseconds since the epoch."""
        self._mcap.add_message(channel, log_time_ns, data, publish_time_ns, sequence)
        self._file.flush()  # a chunk that is finished is out of this process, whatever happens to it
        self.part.count(self._topics[channel], log_time_ns=log_time_ns, publish_time_ns=publish_time_ns)

    @property
    def size(self) -> int:
        """Bytes of the file by now, without the chunk that is being filled."""
        return self._file.tell()

    def flush(self) -> None:
        """Finish the chunk that is being filled, and hand it to the operating system."""
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def descriptor(self) -> int:
        """A file descriptor for `os.fsync`, for the caller to close: it outlives the file object."""
        return os.dup(self._file.fileno())

    def finish(self) -> None:
        """End the file, on the disk, with rosbag2's record of what this part holds."""
        self._mcap.add_metadata("rosbag2", {"serialized_metadata": to_yaml(information([self.part]))})
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is: what was written until now stays."""
        with contextlib.suppress(OSError):
            self._file.close()
