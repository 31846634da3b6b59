"""Repair the rosbag2 folder of a killed writer, in place.

Each part without its end is copied, as far as it can be read, into a new file that replaces it: the disk
needs room for one more part. A killed repair can be repeated. A part without contents becomes an empty part.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema

from uav_dc_ros import files
from uav_dc_ros.bags import metadata
from uav_dc_ros.bags.metadata import Part, matches_metadata, merged, write_metadata
from uav_dc_ros.bags.part_writer import PartWriter, folder_lock, part_paths
from uav_dc_ros.bags.salvage.scan import Scan, has_end
from uav_dc_ros.errors import BagError


@dataclass(frozen=True)
class Repaired:
    """A repaired bag."""

    parts: list[Part]  # contents of all parts, in their order
    rewritten: list[str]  # file names of those that lacked their end
    lost_bytes: int  # at the torn ends, which could not be used

    @property
    def whole(self) -> Part:
        """All parts as one."""
        return merged(self.parts)

    def __str__(self) -> str:
        names = ", ".join(self.rewritten) or "no part"
        return f"repaired {names}: {self.whole.message_count:,} messages, {self.lost_bytes:,} bytes lost"


def repair(folder: Path) -> Repaired:
    """Make the bag of a killed writer whole; a whole one stays as it is, byte for byte.

    Raises BagError for no such folder, no MCAP file in it, a file that is not one, damage that is not a torn
    end, a full disk, or another process that writes or repairs it. Each part is then whole or unchanged.
    """
    with folder_lock(folder):
        if not part_paths(folder):
            raise BagError(f"bag {folder} holds no MCAP file; expected at least one (*.mcap)")
        repaired = repair_parts(folder)
        if not matches_metadata(folder, repaired.parts):
            write_metadata(folder, repaired.parts)
    return repaired


def repair_parts(folder: Path) -> Repaired:
    """Repair the parts of a bag, as `repair`, but not metadata.yaml; the caller holds the folder's lock."""
    parts: list[Part] = []
    rewritten: list[str] = []
    lost_bytes = 0
    try:
        for left in folder.glob(".*.partial"):  # of a killed repair or writer of metadata.yaml
            if not left.is_dir():  # a folder is of an export
                left.unlink()
        for path in part_paths(folder):
            with path.open("rb") as file:
                scan = Scan(path, file)
                if has_end(file):
                    parts.append(_read(scan))
                else:
                    parts.append(_rewrite(scan, path))
                    rewritten.append(path.name)
            lost_bytes += scan.lost_bytes
    except OSError as error:
        raise BagError(f"bag {folder} cannot be repaired: {error.strerror}; its contents are kept") from None
    return Repaired(parts, rewritten, lost_bytes)


def _read(scan: Scan) -> Part:
    """The contents of a part with its end."""
    for _ in scan:
        pass
    if scan.lost_bytes:
        # A kill does not cause this. A rewrite would discard what a better tool can still read.
        raise BagError(
            f"{scan.path} has its end, but {scan.lost_bytes} bytes before it are damaged; expected a file "
            "that lacks only its end"
        )
    return scan.part


def _rewrite(scan: Scan, path: Path) -> Part:
    with files.replacing(path) as partial:
        writer = PartWriter(partial, name=path.name)
        try:
            copy(scan, writer)
            writer.finish()
        finally:
            writer.abandon()
    return writer.part


def copy(scan: Scan, writer: PartWriter) -> None:
    """Copy the readable records of a part; the writer makes new indexes."""
    schemas = {0: 0}  # ids in the copy; 0: a channel without a schema
    channels: dict[int, int] = {}
    repeated: Counter[str] = Counter()
    for record in scan:
        match record:
            case Message():
                topic, _ = scan.channels[record.channel_id]
                if record.sequence == 0 and topic in scan.part.repeated:
                    repeated[topic] += 1
                channel, times_ns = channels[record.channel_id], (record.log_time, record.publish_time)
                writer.add_message(channel, record.data, *times_ns, record.sequence)
            case Schema():
                schemas[record.id] = writer.add_schema(record.name, record.encoding, record.data)
            case Channel():
                schema = schemas[record.schema_id]
                channel = writer.add_channel(record.topic, record.message_encoding, schema, record.metadata)
                channels[record.id] = channel
            case Metadata(name=metadata.ROSBAG2_RECORD) | Metadata(name=metadata.REPEATED_RECORD):
                pass  # counts of the unfinished part: the copy has its own
            case Metadata():
                writer.add_metadata(record.name, record.metadata)
            case Attachment():
                writer.add_attachment(record)
    if repeated:
        writer.add_metadata(metadata.REPEATED_RECORD, {topic: str(n) for topic, n in repeated.items()})
