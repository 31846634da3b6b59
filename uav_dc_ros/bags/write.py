"""Write a rosbag2 folder: MCAP files with zstd chunks, and metadata.yaml.

Messages are stored as they came, serialised; nothing is decoded. An MCAP file tells the whole story
by itself, so a folder whose metadata.yaml was never written loses nothing but convenience.

A bag has one part, `<folder>_0.mcap`, unless its writer was killed: who goes on writes the next part.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Self

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

from uav_dc_ros.bags.definitions import ENCODING, TYPESTORE, definition
from uav_dc_ros.bags.mend import mend_parts
from uav_dc_ros.bags.metadata import FILE_NAME, METADATA_NAME, Part, to_yaml, total, write_metadata
from uav_dc_ros.bags.part import FolderLock, PartWriter, number, part_paths
from uav_dc_ros.errors import BagError


class BagWriter:
    """A bag that is being written; a context manager that closes it.

    Args:
        folder: the bag's folder; must not exist, unless its writing is resumed.
        about: what the bag is about, stored inside as text by key. What earlier parts say of a key stays.
        resume: go on with a bag whose writer was killed: its parts are mended, and a new one is begun.

    Raises:
        BagError: the folder exists, or cannot be made. When resuming: there is no such folder, the bag was
            closed (so it is finished, and no bag is ever overwritten), it is still being written, or it
            cannot be mended.
    """

    def __init__(self, folder: Path, about: Mapping[str, str], *, resume: bool = False) -> None:
        self.folder = folder
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._earlier: list[Part] = []
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
                self._earlier = _earlier_parts(folder)
            self._whole = total(self._earlier)  # of the earlier parts
            self._begin(about)
        except BaseException:
            self._lock.release()
            raise

    def _begin(self, about: Mapping[str, str]) -> None:
        n = max((number(self.folder / part.name) for part in self._earlier), default=-1) + 1
        try:
            self._writer = PartWriter(self.folder / f"{self.folder.name}_{n}.mcap")
            self._writer.add_metadata(METADATA_NAME, about)
        except OSError as error:
            raise BagError(f"bag {self.folder} cannot be written: {error.strerror}") from None

    @property
    def message_count(self) -> int:
        """Messages in the bag so far, those of earlier parts included."""
        return self._whole.message_count + self._writer.part.message_count

    @property
    def already_written(self) -> Mapping[str, int]:
        """Latest publish time of each topic that earlier parts hold, nanoseconds since the epoch.

        Latched topics come again to who subscribes again: what is not newer than this is in the bag.
        """
        return MappingProxyType(self._whole.published_ns)

    def add_topic(self, name: str, type: str, offered_qos: Iterable[Qos] = ()) -> None:
        """Announce a topic, once, before its first message.

        A topic of which earlier parts hold messages keeps the QoS that they tell: metadata.yaml has one
        QoS for a topic, and rosbags reads no message whose channel tells another.

        Args:
            name: full name, with its namespace.
            type: ROS 2 message type, such as `std_msgs/msg/String`.
            offered_qos: QoS that the topic's publishers offer.

        Raises:
            BagError: ROS 2 has no such type, the topic has another one in earlier parts, or the disk is full.
        """
        qos = dump_qos_v9(list(offered_qos))
        if name in self._whole.topics:
            row = self._whole.topics[name]
            if row["type"] != type:
                raise BagError(f"topic {name} is of type {type}; expected {row['type']}, as in earlier parts")
            if self._whole.counts[name]:
                qos = row["offered_qos_profiles"]
        try:
            if type not in self._schemas:
                self._schemas[type] = self._writer.add_schema(type, ENCODING, _definition(name, type))
            told = {"offered_qos_profiles": to_yaml(qos), "topic_type_hash": TYPESTORE.hash_rihs01(type)}
            self._channels[name] = self._writer.add_channel(name, "cdr", self._schemas[type], told)
        except OSError as error:  # a definition may be what fills the chunk
            raise self._failure(error) from None

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
        sequence = self._whole.counts.get(topic, 0) + self._writer.part.counts[topic] + 1
        try:
            self._writer.add_message(
                self._channels[topic],
                data,
                log_time_ns=log_time_ns,
                publish_time_ns=publish_time_ns,
                sequence=sequence,
            )
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
            self._writer.finish()
            write_metadata(self.folder, [*self._earlier, self._writer.part])
        except OSError as error:
            raise self._failure(error) from None
        finally:
            self._lock.release()

    def _failure(self, error: OSError) -> BagError:
        """Give the file up as it is: what was written until now stays."""
        self._writer.abandon()
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
        return definition(type)
    except BagError as error:
        raise BagError(f"topic {topic} is of type {error}") from None
