"""Make a whole rosbag2 folder of one whose writer was killed.

Each part that lacks its end is copied, as far as it can be read, into a new file beside it, which then takes
its place; so the disk must have room for one part more. The bag can be mended again whenever mending is
killed. No part is ever dropped: one that holds nothing becomes an empty part.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema

from uav_dc_ros import files
from uav_dc_ros.bags import metadata
from uav_dc_ros.bags.metadata import Part, is_told, total, write_metadata
from uav_dc_ros.bags.part_writer import FolderLock, PartWriter, part_paths
from uav_dc_ros.bags.salvage.scan import Scan, has_end
from uav_dc_ros.errors import BagError


@dataclass(frozen=True, kw_only=True)
class Mended:
    """What a bag holds after mending, and what was done for it.

    Attributes:
        parts: all MCAP files of the bag, by name, in their order.
        mended: those that were written anew.
        message_counts: messages by topic, over all parts.
        last_publish_ns: latest publish time by topic, of topics with messages, nanoseconds since the epoch.
        lost_bytes: bytes at the torn ends that could not be used.
    """

    parts: tuple[str, ...]
    mended: tuple[str, ...]
    message_counts: Mapping[str, int]
    last_publish_ns: Mapping[str, int]
    lost_bytes: int


def mend(folder: Path) -> Mended:
    """Make a bag whole; one that is whole stays as it is, byte for byte.

    Args:
        folder: the bag's folder; nobody may be writing it.

    Raises:
        BagError: no such folder, no MCAP file in it, a file that is none, damage that is not a torn end, a
            full disk, or somebody who is writing or mending the bag. Each part is then whole or as it was.
    """
    with FolderLock(folder):
        if not part_paths(folder):
            raise BagError(f"bag {folder} holds no MCAP file; expected at least one (*.mcap)")
        parts, mended = mend_parts(folder)
        if not is_told(folder, parts):
            write_metadata(folder, parts)
    return mended


def mend_parts(folder: Path) -> tuple[list[Part], Mended]:
    """Mend the parts of a bag, but leave metadata.yaml alone; the caller holds the folder's lock.

    Raises:
        BagError: as for `mend`.
    """
    parts: list[Part] = []
    mended: list[str] = []
    lost_bytes = 0
    try:
        for left in folder.glob(".*.partial"):  # by a mending, or a metadata.yaml, that was killed
            if not left.is_dir():  # by an export into this folder
                left.unlink()
        for path in part_paths(folder):
            with path.open("rb") as file:
                scan = Scan(path, file)
                if has_end(file):
                    _read(scan)
                    parts.append(scan.part)
                else:
                    parts.append(_rewrite(scan, path))
                    mended.append(path.name)
            lost_bytes += scan.lost_bytes
    except OSError as error:
        raise BagError(
            f"bag {folder} cannot be mended: {error.strerror}; what it held is still there"
        ) from None
    whole = total(parts)
    return parts, Mended(
        parts=tuple(part.name for part in parts),
        mended=tuple(mended),
        message_counts=whole.counts,
        last_publish_ns=whole.published_ns,
        lost_bytes=lost_bytes,
    )


def _read(scan: Scan) -> None:
    """Read a part that has its end, for what it holds."""
    for _ in scan:
        pass
    if scan.lost_bytes:
        # No kill did this. A copy would throw away what a better tool may still read.
        raise BagError(
            f"{scan.path} has its end, but {scan.lost_bytes} bytes before it are damaged; expected a file "
            "that lacks nothing but its end"
        )


def _rewrite(scan: Scan, path: Path) -> Part:
    """Put what can be read of a part into its place."""
    with files.replacing(path) as partial:
        writer = PartWriter(partial, name=path.name)
        try:
            copy(scan, writer)
            writer.finish()
        finally:
            writer.abandon()
    return writer.part


def copy(scan: Scan, writer: PartWriter) -> None:
    """Write what can be read of a part into another one; its indexes are made anew."""
    schemas = {0: 0}  # a channel without a schema stays one
    channels: dict[int, int] = {}
    topics: dict[int, str] = {}
    repeated: Counter[str] = Counter()
    for record in scan:
        match record:
            case Message():
                if record.sequence == 0 and topics[record.channel_id] in scan.part.repeated:
                    repeated[topics[record.channel_id]] += 1
                writer.add_message(
                    channels[record.channel_id],
                    record.data,
                    log_time_ns=record.log_time,
                    publish_time_ns=record.publish_time,
                    sequence=record.sequence,
                )
            case Schema():
                schemas[record.id] = writer.add_schema(record.name, record.encoding, record.data)
            case Channel():
                channels[record.id] = writer.add_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                )
                topics[record.id] = record.topic
            case Metadata(name="rosbag2") | Metadata(name=metadata.REPEATED_NAME):
                pass  # counts of a part that was not finished: the copy gets its own
            case Metadata():
                writer.add_metadata(record.name, record.metadata)
            case Attachment():
                writer.add_attachment(
                    name=record.name,
                    media_type=record.media_type,
                    data=record.data,
                    log_time_ns=record.log_time,
                    create_time_ns=record.create_time,
                )
    if repeated:
        writer.add_metadata(metadata.REPEATED_NAME, {topic: str(n) for topic, n in repeated.items()})
