"""Read an MCAP file as far as possible: whole, cut at any byte, or damaged anywhere.

mcap's StreamReader ends a torn file with EndOfFile, struct.error, ZstdError, UnicodeDecodeError or
CRCValidationError, and returns a message that is cut short as a whole one. So the record headers are read
here, and mcap parses only complete records.
"""

import os
import struct
import zlib
from bisect import bisect_left
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO

from mcap.exceptions import UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Header, McapRecord, Message, Metadata, Schema
from mcap.summary import Summary

from uav_dc_ros import cdr
from uav_dc_ros.bags.metadata import Part, is_latched
from uav_dc_ros.bags.records import (
    CDR,
    CHUNK_COMPRESSIONS,
    FOOTER_BYTES,
    HEADER,
    MAGIC,
    MESSAGE,
    TIME_MAX_NS,
    ChunkHeader,
    RecordReader,
    decompress_chunk,
    decompress_payload,
    decompress_torn,
    parse,
)
from uav_dc_ros.bags.unreadable import Unreadable
from uav_dc_ros.errors import BagDamagedError, BagError, MessageError
from uav_dc_ros.topics import JSON

_END_BYTES = HEADER.size + FOOTER_BYTES + len(MAGIC)
_FOOTER = struct.Struct("<QQI")  # start of the summary, of its offsets, and CRC
DAMAGES_MAX = 10_000  # listed places; the last one includes those after it
_COPIED = (Schema, Channel, Metadata, Attachment)  # indexes are written anew


def has_end(file: IO[bytes]) -> bool:
    """Whether an MCAP file has a footer, the closing magic, and an undamaged summary or none."""
    size = os.fstat(file.fileno()).st_size
    if size < len(MAGIC) + _END_BYTES:
        return False
    file.seek(size - _END_BYTES)
    end = file.read(_END_BYTES)
    if end[-len(MAGIC) :] != MAGIC or HEADER.unpack_from(end) != (Opcode.FOOTER, FOOTER_BYTES):
        return False
    start, offsets_start, crc = _FOOTER.unpack_from(end, HEADER.size)
    if start == 0:  # no summary
        return offsets_start == 0 and crc in (0, zlib.crc32(end[: HEADER.size + 16]))
    if not len(MAGIC) <= start < size - _END_BYTES:
        return False
    if crc == 0:  # no CRC
        return True
    file.seek(start)
    # The summary is small, some ten bytes for each chunk and topic. The CRC includes the footer before it.
    return zlib.crc32(file.read(size - start - len(MAGIC) - 4)) == crc


def metadata_records(path: Path, file: IO[bytes]) -> Iterator[Metadata]:
    """The metadata records of a finished MCAP file without an index; chunks, which have none, are skipped.

    Raises BagDamagedError for an invalid record.
    """
    reader, at, opcode = RecordReader(file), len(MAGIC), 0
    while opcode not in (Opcode.DATA_END, Opcode.FOOTER):
        opcode, length = reader.header(at)
        if opcode == Opcode.METADATA:
            record = parse(opcode, reader.read(at + HEADER.size, length))
            if isinstance(record, Metadata):
                yield record
            else:
                opcode = 0
        if opcode == 0:
            raise BagDamagedError(f"{path} is damaged: the record at byte {at} is invalid")
        at += HEADER.size + length


@dataclass
class Damage:
    """An unusable place in a file."""

    at: int  # its offset, bytes
    n_bytes: int  # its length in the file
    reason: str  # what is damaged
    after_ns: int | None = None  # log time of the message before it; None without one
    before_ns: int | None = None  # and of the message after it


class Scan:
    """Iterates once over the readable records of an MCAP file, with one chunk at a time in memory.

    Yields schemas, channels, messages, metadata records and attachments. Schemas and channels come
    once; a message comes after its channel.

    Skipped are a chunk with a wrong CRC, and everything between a record of invalid length and the next
    valid chunk. A chunk torn at the end of the file yields its first records, as far as it can be
    decompressed. The attributes are of what was read so far. Raises BagError if the file is not MCAP, or a
    compression is unsupported, and OSError if the disk is gone.
    """

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.path = path
        self.part = Part(path.name)
        self.channels: dict[int, tuple[str, str]] = {}  # topic and type by channel id
        self.damages: list[Damage] = []  # unusable places
        self.unreadable = Unreadable()  # intact messages whose payload is not CDR
        self.compressed: set[str] = set()  # topics of individually compressed messages; yields them unpacked
        self.library = ""  # name of the software that wrote the file
        self.lag_ns = 0  # the longest step back in log time from any earlier message
        self.goes_back_ns = 0  # the longest step back from the message before on the same topic
        self._file = file
        self._reader = RecordReader(file)
        self.size = self._reader.size  # when the file was opened, bytes; bytes appended later are not read
        self.magic = self._reader.read(0, len(MAGIC))  # the file's first bytes
        self._schemas: dict[int, str] = {0: ""}
        self._cdr_channels: set[int] = set()
        self._latched: set[str] = set()
        self._times_ns: dict[str, int] = {}  # log time of the last message by topic
        self._last_ns: int | None = None
        self._chunked = False
        self._at = 0  # of the current record or chunk

    @property
    def lost_bytes(self) -> int:
        """Unusable bytes of the file so far."""
        return sum(damage.n_bytes for damage in self.damages)

    @cached_property
    def summary(self) -> Summary | None:
        """The file's summary; None without an end."""
        try:
            if not has_end(self._file):
                return None
            # mcap checks for a magic here; that at the start may be damaged.
            self._file.seek(-len(MAGIC), os.SEEK_END)
            return SeekingReader(self._file).get_summary()
        except Exception:  # of mcap, struct: a damaged summary without a CRC
            return None

    def __iter__(self) -> Iterator[McapRecord]:
        """Scan the file from its beginning; once."""
        if not self._check_magic():
            return
        size, at = self.size, len(MAGIC)
        while at < size:
            self._at = at
            record = self._reader.record(at)
            # No writer mixes chunks with messages outside of them: it is an index with a damaged opcode.
            if record is not None and not (self._chunked and record[0] == Opcode.MESSAGE):
                opcode, content, at = record
                if opcode == Opcode.FOOTER:
                    self._add_damage(at + len(MAGIC), size - at - len(MAGIC), "bytes after the file's end")
                    return
                yield from self._record(opcode, content)
                continue
            chunk = self._reader.chunk(at)
            if chunk is None:
                following = self._next(at + 1)
                torn_end = following == size and self.summary is None
                self._add_damage(at, following - at, "torn at the end" if torn_end else "damaged")
                at = following
                continue
            header, at = chunk
            if at > size:
                yield from self._torn_chunk(header)
                return
            self._chunked = True
            yield from self._chunk(header, at)

    def is_mcap(self) -> bool:
        """Whether it is an MCAP file: by its magic, torn or not, or by the header after a damaged one."""
        if MAGIC.startswith(self.magic):
            return True
        record = self._reader.record(len(MAGIC))
        return record is not None and record[0] == Opcode.HEADER

    def _check_magic(self) -> bool:
        """Whether records can follow the magic."""
        if self.magic == MAGIC:
            return True
        if not self.is_mcap():
            raise BagError(f"{self.path} starts with {self.magic!r}; expected {MAGIC!r} of an MCAP file")
        torn = MAGIC.startswith(self.magic)
        self._add_damage(0, len(self.magic), "torn at the end" if torn else "damaged")
        return not torn

    @cached_property
    def _indexed_offsets(self) -> list[int]:
        """Offsets of records by the summary."""
        if self.summary is None:
            return []
        offsets = [index.chunk_start_offset for index in self.summary.chunk_indexes]
        offsets += [index.offset for index in self.summary.metadata_indexes]
        offsets += [index.offset for index in self.summary.attachment_indexes]
        return sorted(offsets)

    def _next(self, at: int) -> int:
        """Offset of the next valid record after damage; the end of the file without one."""
        number = bisect_left(self._indexed_offsets, at)
        if number < len(self._indexed_offsets):
            return self._indexed_offsets[number]
        found = None
        if self.channels and not self._chunked:  # bytes of a damaged chunk can look like messages
            found = self._reader.next_message(at, self.channels)
        if found is None:
            found = self._reader.next_chunk(at)
        return self.size if found is None else found

    def _chunk(self, header: ChunkHeader, end: int) -> Iterator[McapRecord]:
        try:
            data = decompress_chunk(header, self._reader.read(end - header.data_bytes, header.data_bytes))
        except UnsupportedCompressionError as error:
            # A copy of the file without this chunk would lose its messages.
            raise BagError(f"{self.path}: {error}; expected one of {CHUNK_COMPRESSIONS}") from None
        if data is None:
            self._add_damage(self._at, end - self._at, "a chunk whose content is damaged")
            return
        rest = yield from self._content(data)
        self._add_damage(self._at, rest, "invalid records in a chunk")

    def _torn_chunk(self, header: ChunkHeader) -> Iterator[McapRecord]:
        """The first records of the chunk at the end of the file, which no CRC can check."""
        at, end = self._at, self.size
        data_at = at + HEADER.size + header.data_at
        data = decompress_torn(header.compression, self._reader.read(data_at, end - data_at))[: header.size]
        before = self.part.message_count
        rest = yield from self._content(data)
        kept = self.part.message_count - before
        # The compressed bytes of the lost records are unknown.
        n_bytes = end - at if header.compression else rest
        reason = "a chunk torn at the end" + (f"; messages of it that are whole: {kept}" if kept else "")
        self._add_damage(end - n_bytes, n_bytes, reason)

    def _content(self, data: bytes) -> Generator[McapRecord, None, int]:
        """Records of a chunk. Returns the number of bytes after the last complete one."""
        at = 0
        while len(data) - at >= HEADER.size:
            opcode, length = HEADER.unpack_from(data, at)
            end = at + HEADER.size + length
            if opcode == 0 or end > len(data):  # 0 is no opcode: a power cut left zeros
                break
            yield from self._record(opcode, data[at + HEADER.size : end])
            at = end
        return len(data) - at

    def _record(self, opcode: int, content: bytes) -> Iterator[McapRecord]:
        """A record inside or outside of chunks, if a copy needs it."""
        if opcode == Opcode.MESSAGE and len(content) >= MESSAGE.size:
            yield from self._message(content)
            return
        if opcode in (Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX):
            return
        record = parse(opcode, content)
        if isinstance(record, Header):
            self.library = record.library
        if isinstance(record, _COPIED) and self._is_new(record):
            yield record
        elif record is None and opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.MESSAGE):
            self._add_damage(self._at, HEADER.size + len(content), "an invalid record")

    def _message(self, content: bytes) -> Iterator[McapRecord]:
        """A message, after its schema and channel if only the summary still has them."""
        channel, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(content)
        if channel not in self.channels:
            yield from self._from_summary(channel)
        if channel not in self.channels:
            self._add_damage(self._at, HEADER.size + len(content), "messages of a topic that is lost")
            return
        topic, _ = self.channels[channel]
        log_time_ns, publish_time_ns = min(log_time_ns, TIME_MAX_NS), min(publish_time_ns, TIME_MAX_NS)
        self.part.add_message(topic, log_time_ns, publish_time_ns)
        self.lag_ns = max(self.lag_ns, self.part.last_ns - log_time_ns)
        self.goes_back_ns = max(self.goes_back_ns, self._times_ns.get(topic, 0) - log_time_ns)
        self._last_ns = self._times_ns[topic] = log_time_ns
        for damage in reversed(self.damages):
            if damage.before_ns is not None:
                break
            damage.before_ns = log_time_ns
        data = content[MESSAGE.size :]
        if channel in self._cdr_channels:
            payload, data = data, decompress_payload(data)
            if data is not payload:
                self.compressed.add(topic)
            self._check_payload(topic, data)
        if topic in self._latched:
            self.part.latest[topic] = data, publish_time_ns
        yield Message(channel, log_time_ns, data, publish_time_ns, sequence)

    def _check_payload(self, topic: str, data: bytes) -> None:
        """Count a payload that is not CDR, by its encapsulation; a string is checked completely."""
        check = cdr.decode_string if self.part.topics[topic]["type"] == JSON else cdr.byte_order
        try:
            check(data)
        except MessageError as error:
            self.unreadable.add(topic, error)

    def _from_summary(self, channel_id: int) -> Iterator[McapRecord]:
        """A channel and its schema whose chunk is damaged, repeated in the summary."""
        channel = self.summary.channels.get(channel_id) if self.summary is not None else None
        if channel is None or self.summary is None:
            return
        for record in (self.summary.schemas.get(channel.schema_id), channel):
            if record is not None and self._is_new(record):
                yield record

    def _is_new(self, record: McapRecord) -> bool:
        """Add a record; False for a repeated schema or channel."""
        if isinstance(record, Schema):
            if record.id in self._schemas:
                return False
            self._schemas[record.id] = record.name
        elif isinstance(record, Channel):
            if record.id in self.channels or record.schema_id not in self._schemas:
                return False
            type = self._schemas[record.schema_id]
            self.channels[record.id] = record.topic, type
            if record.message_encoding == CDR:
                self._cdr_channels.add(record.id)
            self.part.add_topic(record.topic, type, record.message_encoding, record.metadata)
            if is_latched(self.part.topics[record.topic]):
                self._latched.add(record.topic)
        elif isinstance(record, Metadata):
            self.part.add_metadata(record.name, record.metadata)
        return True

    def _add_damage(self, at: int, n_bytes: int, reason: str) -> None:
        """Add unusable bytes; consecutive ones are one place."""
        if n_bytes <= 0:
            return
        last = self.damages[-1] if self.damages else None
        if last is not None and (
            len(self.damages) >= DAMAGES_MAX
            or (last.before_ns is None and (last.at + last.n_bytes == at or last.reason == reason))
        ):
            last.n_bytes += n_bytes
            return
        self.damages.append(Damage(at, n_bytes, reason, after_ns=self._last_ns))
