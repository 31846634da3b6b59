"""Write a rosbag2 folder: MCAP files, and metadata.yaml.

Messages are stored as they came, serialised; nothing is decoded. An MCAP file tells the whole story
by itself, so a folder whose metadata.yaml was never written loses nothing but convenience.

A bag has one part, `<folder>_0.mcap`, unless it is split, or its writer was killed: who goes on writes the
next part. Each part after the first begins with the last messages of each latched topic, one for each of its
publishers, so that it can be understood alone. They have their own publish time, the log time of the part's
first new message, and the sequence 0; a metadata record counts them.
"""

import os
from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Self

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

from uav_dc_ros.bags import message_definitions
from uav_dc_ros.bags.metadata import FILE_NAME, Part, is_latched, to_yaml, total, write_metadata
from uav_dc_ros.bags.part_writer import FolderLock, part_paths
from uav_dc_ros.bags.salvage.repair import mend_parts
from uav_dc_ros.bags.split_writer import PartSeries, Row
from uav_dc_ros.bags.sync import DiskSync
from uav_dc_ros.errors import BagError


class BagWriter:
    """A bag that is being written; a context manager that closes it.

    Args:
        folder: the bag's folder; must not exist, unless its writing is resumed.
        about: what the bag is about, stored inside as text by key. What earlier parts say of a key stays.
        resume: go on with a bag whose writer was killed: its parts are mended, and a new one is begun.
        compression: of its chunks: one of `compression.COMPRESSIONS`.
        split_bytes: size of a part's file after which the next one is begun; 0: never. A part is larger by
            no more than a chunk, one message and its index.
        split_s: log time after which the next part is begun, seconds; 0: never.

    Raises:
        BagError: the folder exists, or cannot be made. When resuming: there is no such folder, the bag was
            closed (so it is finished, and no bag is ever overwritten), it is still being written, or it
            cannot be mended.
    """

    def __init__(
        self,
        folder: Path,
        about: Mapping[str, str],
        *,
        resume: bool = False,
        compression: str = "zstd",
        split_bytes: int = 0,
        split_s: float = 0.0,
    ) -> None:
        self.folder = folder
        self._disk = DiskSync()
        if not resume:
            if folder.exists():
                raise BagError(f"bag folder {folder} exists already; expected a new one")
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise BagError(f"bag folder {folder} cannot be made: {error.strerror}") from None
        self._lock = FolderLock(folder)
        try:
            earlier = _earlier_parts(folder) if resume else []
            self._resumed = total(earlier)
            try:
                self._parts = PartSeries(
                    folder,
                    about,
                    earlier,
                    compression=compression,
                    split_bytes=split_bytes,
                    split_ns=round(split_s * 1e9),
                )
            except OSError as error:
                raise BagError(f"bag {folder} cannot be written: {error.strerror}") from None
        except BaseException:
            self._lock.release()
            raise

    @property
    def message_count(self) -> int:
        """Messages in the bag so far, those of earlier parts and repeated ones included."""
        return sum(part.message_count for part in self._parts.all)

    @property
    def closed(self) -> bool:
        """Whether it was closed, or given up."""
        return self._parts.current.closed

    @property
    def topics(self) -> list[str]:
        """Topics that were added, by full name."""
        return list(self._parts.rows)

    @property
    def part_count(self) -> int:
        """Parts of the bag so far."""
        return len(self._parts.all)

    @property
    def already_written(self) -> Mapping[str, int]:
        """Latest publish time of each topic that a killed writer's parts hold, nanoseconds since the epoch.

        Latched topics come again to who subscribes again: what is not newer than this is in the bag.
        """
        return MappingProxyType(self._resumed.published_ns)

    def add_topic(
        self,
        name: str,
        type: str,
        offered_qos: Iterable[Qos] = (),
        *,
        definition: bytes = b"",
        type_hash: str = "",
    ) -> None:
        """Announce a topic, once, before its first message.

        A topic of which earlier parts hold messages keeps the QoS that they tell: metadata.yaml has one
        QoS for a topic, and rosbags reads no message whose channel tells another.

        Args:
            name: full name, with its namespace.
            type: ROS 2 message type, such as `std_msgs/msg/String`.
            offered_qos: QoS that the topic's publishers offer.
            definition: of a type that ROS 2 itself does not have, with all types inside it, as `ros2msg`.
            type_hash: of such a type (REP-2011).

        Raises:
            BagError: ROS 2 has no such type, the topic has another one in earlier parts, or the disk is full.
        """
        qos = dump_qos_v9(list(offered_qos))
        if name in self._resumed.topics:
            earlier = self._resumed.topics[name]
            if earlier["type"] != type:
                raise BagError(
                    f"topic {name} is of type {type}; expected {earlier['type']}, as in earlier parts"
                )
            if self._resumed.counts[name]:
                qos = earlier["offered_qos_profiles"]
        if not definition:
            definition = _definition(name, type)
            type_hash = message_definitions.TYPESTORE.hash_rihs01(type)
        row = Row(
            type=type,
            definition=definition,
            channel={"offered_qos_profiles": to_yaml(qos), "topic_type_hash": type_hash},
            latest=deque(maxlen=len(qos)) if is_latched({"offered_qos_profiles": qos}) else None,
            sequence=self._resumed.counts.get(name, 0) - self._resumed.repeated.get(name, 0),
        )
        if row.latest is not None and name in self._resumed.latest:
            row.latest.append(self._resumed.latest[name])
        try:
            self._parts.add(name, row)
        except OSError as error:  # a definition may be what fills the chunk
            raise self._failure(error) from None

    def keep_latched(self, topic: str, n: int) -> None:
        """Repeat at least the last `n` messages of a latched topic in the next part: one a publisher."""
        row = self._parts.rows[topic]
        if row.latest is not None and n > (row.latest.maxlen or 0):
            row.latest = deque(row.latest, maxlen=n)

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
        try:
            self._parts.write(topic, data, log_time_ns=log_time_ns, publish_time_ns=publish_time_ns)
        except OSError as error:
            raise self._failure(error) from None

    def tell(self, about: Mapping[str, str]) -> None:
        """Add to what the bag is about.

        Raises:
            BagError: the disk is full, or gone.
        """
        try:
            self._parts.tell(about)
        except OSError as error:
            raise self._failure(error) from None

    def tell_dropped(self, dropped: Mapping[str, int]) -> None:
        """Note how many messages of each topic were lost by now, since this writer began.

        Raises:
            BagError: the disk is full, or gone.
        """
        try:
            self._parts.tell_dropped(dropped)
        except OSError as error:
            raise self._failure(error) from None

    def sync(self) -> None:
        """Hand over all that was written: to the operating system now, and to the disk soon, by a thread.

        What a kill can take is then what came since the last call; what a power cut can take, what came since
        the last one but one, if the disk keeps up.

        Raises:
            BagError: the disk is full, or gone.
        """
        try:
            self._parts.current.flush()
            if self._disk.is_free:
                folder = os.open(self.folder, os.O_RDONLY)  # the names of new parts, too
                self._disk.begin([self._parts.current.descriptor(), folder])
        except OSError as error:
            raise self._failure(error) from None

    def close(self) -> None:
        """Finish the part and write metadata.yaml over all parts. Closing twice does nothing.

        Raises:
            BagError: the disk is full, or gone.
        """
        if self.closed:
            return
        try:
            self._disk.wait()
            self._parts.current.finish()
            write_metadata(self.folder, self._parts.all)
        except OSError as error:
            raise self._failure(error) from None
        finally:
            self._disk.close()
            self._lock.release()

    def _failure(self, error: OSError) -> BagError:
        """Give the file up as it is: what was written until now stays."""
        self._parts.current.abandon()
        self._disk.close()
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
        return message_definitions.definition(type)
    except BagError as error:
        raise BagError(f"topic {topic} is of type {error}") from None
