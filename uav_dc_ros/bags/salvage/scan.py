"""Read an MCAP file as far as it goes: whole, cut at any byte, or damaged anywhere.

mcap's StreamReader stops a torn file with EndOfFile, struct.error, ZstdError, UnicodeDecodeError or
CRCValidationError, as the cut falls, and hands out a message that is cut short as if it were whole. So the
frames of the records are read here, and only what lies inside a whole frame goes to mcap.
"""

import os
import struct
import zlib
from bisect import bisect_left
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
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
    COMPRESSIONS,
    FOOTER_BYTES,
    FRAME,
    MAGIC,
    MESSAGE,
    TIME_MAX_NS,
    ChunkHead,
    Frames,
    frames,
    inflate_torn,
    parse,
    plain,
    unpack,
)
from uav_dc_ros.bags.unreadable import Unreadable
from uav_dc_ros.errors import BagDamagedError, BagError, MessageError
from uav_dc_ros.topics import JSON

_END_BYTES = FRAME.size + FOOTER_BYTES + len(MAGIC)
_FOOTER = struct.Struct("<QQI")  # start of the summary, of its offsets, and CRC
DAMAGES_MAX = 10_000  # places that are told apart; the last one takes in what follows
_KEPT = (Schema, Channel, Metadata, Attachment)  # the rest is an index: it is made anew


def has_end(file: IO[bytes]) -> bool:
    """Whether an MCAP file has a footer and the closing magic; and its summary, if any, is unharmed.

    Raises:
        OSError: the disk is gone.
    """
    size = os.fstat(file.fileno()).st_size
    if size < len(MAGIC) + _END_BYTES:
        return False
    file.seek(size - _END_BYTES)
    end = file.read(_END_BYTES)
    opcode, length = FRAME.unpack_from(end)
    if end[-len(MAGIC) :] != MAGIC or (opcode, length) != (Opcode.FOOTER, FOOTER_BYTES):
        return False
    start, offsets_start, crc = _FOOTER.unpack_from(end, FRAME.size)
    if start == 0:  # without a summary, which is optional
        return offsets_start == 0 and crc in (0, zlib.crc32(end[: FRAME.size + 16]))
    if not len(MAGIC) <= start < size - _END_BYTES:
        return False
    if crc == 0:  # MCAP's way to say that there is none
        return True
    file.seek(start)
    # The summary is small, some ten bytes for each chunk and topic. Its CRC takes in the footer up to itself.
    return zlib.crc32(file.read(size - start - len(MAGIC) - 4)) == crc


def metadata_records(path: Path, file: IO[bytes]) -> Iterator[Metadata]:
    """The metadata records of a finished MCAP file, without an index; chunks, which hold none, are skipped.

    Raises:
        BagDamagedError: what lies between them is damaged.
        OSError: the disk is gone.
    """
    looked, at, opcode = Frames(file), len(MAGIC), 0
    while opcode not in (Opcode.DATA_END, Opcode.FOOTER):
        frame = looked.read(at, FRAME.size)
        opcode, length = FRAME.unpack(frame) if len(frame) == FRAME.size else (0, 0)
        if opcode == Opcode.METADATA:
            record = parse(opcode, looked.read(at + FRAME.size, length))
            if isinstance(record, Metadata):
                yield record
            else:
                opcode = 0
        if opcode == 0:
            raise BagDamagedError(f"{path} is damaged: what lies at byte {at} is no record")
        at += FRAME.size + length


@dataclass
class Damage:
    """A place in a file that could not be used.

    Attributes:
        at: where it begins, bytes.
        n_bytes: its length as it lies in the file.
        why: what it is.
        after_ns: log time of the message read last before it, nanoseconds since the epoch; None for none.
        before_ns: log time of the next message after it.
    """

    at: int
    n_bytes: int
    why: str
    after_ns: int | None = None
    before_ns: int | None = None


class Scan:
    """Iterates over what can be read of an MCAP file, in one pass, a chunk at a time in memory.

    Yields schemas, channels, messages, metadata records and attachments. Schemas and channels come
    once; a message comes after its channel.

    What cannot be believed is left out: a chunk whose CRC does not hold, with all it has; a record whose
    length is wrong, up to the next chunk that is whole. Of a chunk that is torn at the end of the file come
    the first records, as far as its compression gives them.

    Attributes:
        path: the file's.
        part: what was read until now.
        library: what wrote the file, in its own words.
        lag_ns: how much earlier than one before it a message was until now, nanoseconds.
        goes_back_ns: how much earlier than the one before it on its topic.
        damages: what could not be used until now, as it lies in the file.
        unreadable: messages that are whole, and whose payload is no CDR.
        compressed: topics of whose messages rosbag2 compressed each by itself; they come decompressed.
        size: of the file when it was opened, bytes; what is appended later is not read.
        magic: its first bytes.

    Raises:
        BagError: the file is no MCAP file, or is compressed in a way that cannot be read here.
        OSError: the disk is gone.
    """

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.part = Part(path.name)
        self.damages: list[Damage] = []
        self.unreadable = Unreadable()
        self.compressed: set[str] = set()
        self.path = path
        self.library = ""
        self.lag_ns = self.goes_back_ns = 0
        self._file = file
        self._frames = Frames(file)
        self.size = self._frames.size
        self.magic = self._frames.read(0, len(MAGIC))
        self._schemas: dict[int, str] = {0: ""}
        self._channels: dict[int, str] = {}
        self._cdr: set[int] = set()  # channels
        self._times_ns: dict[str, int] = {}  # log time of the last message by topic
        self._latched: set[str] = set()
        self._last_ns: int | None = None
        self._chunked = False
        self._at = 0  # of the record, or chunk, that is being read

    @property
    def lost_bytes(self) -> int:
        """Bytes that could not be used until now, as they lie in the file."""
        return sum(damage.n_bytes for damage in self.damages)

    @cached_property
    def summary(self) -> Summary | None:
        """What the end of the file tells; None without an end."""
        try:
            if not has_end(self._file):
                return None
            self._file.seek(-len(MAGIC), os.SEEK_END)  # mcap wants one; that at the start may be damaged
            return SeekingReader(self._file).get_summary()
        except Exception:  # of mcap, struct: one without a CRC, and damaged
            return None

    def __iter__(self) -> Iterator[McapRecord]:
        """Start at the beginning of the file; once."""
        size = self.size
        if not self._starts():
            return
        at = len(MAGIC)
        while at < size:
            self._at = at
            record = self._frames.record(at)
            # No writer puts messages beside chunks: it would be an index whose opcode is damaged.
            if record is not None and not (self._chunked and record[0] == Opcode.MESSAGE):
                opcode, content, at = record
                if opcode == Opcode.FOOTER:
                    self._lose(at + len(MAGIC), size - at - len(MAGIC), "bytes after the file's end")
                    return
                yield from self._record(opcode, content)
                continue
            chunk = self._frames.chunk(at)
            if chunk is not None:
                self._chunked = True
                head, at = chunk
                yield from self._chunk(head, at)
                continue
            torn = self._frames.torn_chunk(at)
            if torn is not None:
                yield from self._torn(torn)
                return
            following = self._resume(at + 1)
            torn_end = following == size and self.summary is None
            self._lose(at, following - at, "torn at the end" if torn_end else "damaged")
            at = following

    def is_mcap(self) -> bool:
        """Whether it is an MCAP file: by its magic, torn or not, or by the header behind a damaged one."""
        if MAGIC.startswith(self.magic):
            return True
        record = self._frames.record(len(MAGIC))
        return record is not None and record[0] == Opcode.HEADER

    def _starts(self) -> bool:
        """Whether the file goes on after its magic."""
        if self.magic == MAGIC:
            return True
        if not self.is_mcap():
            raise BagError(
                f"{self.path} starts with {self.magic!r}; expected {MAGIC!r}, as an MCAP file does"
            )
        torn = MAGIC.startswith(self.magic)
        self._lose(0, len(self.magic), "torn at the end" if torn else "damaged")
        return not torn

    @cached_property
    def _known(self) -> list[int]:
        """Where records begin that the end of the file tells of."""
        if self.summary is None:
            return []
        known = [index.chunk_start_offset for index in self.summary.chunk_indexes]
        known += [index.offset for index in self.summary.metadata_indexes]
        known += [index.offset for index in self.summary.attachment_indexes]
        return sorted(known)

    def _resume(self, at: int) -> int:
        """Where reading goes on after damage; the end of the file, if nowhere."""
        number = bisect_left(self._known, at)
        if number < len(self._known):
            return self._known[number]
        found = None
        if self._channels and not self._chunked:  # messages inside of a damaged chunk are not to be believed
            found = self._frames.next_message(at, self._channels)
        if found is None:
            found = self._frames.next_chunk(at)
        return self.size if found is None else found

    def _chunk(self, head: ChunkHead, end: int) -> Iterator[McapRecord]:
        try:
            data = unpack(head, self._frames.read(end - head.data_bytes, head.data_bytes))
        except UnsupportedCompressionError as error:
            # Left out, its messages would be gone once the file is written anew.
            raise BagError(f"{self.path}: {error}; expected one of {COMPRESSIONS} at hand") from None
        if data is None:
            self._lose(self._at, end - self._at, "a chunk whose content is damaged")
            return
        rest = yield from self._inside(data)
        if rest:
            self._lose(self._at, rest, "records that are none in a chunk")

    def _torn(self, head: ChunkHead) -> Iterator[McapRecord]:
        """The first records of the chunk at the end of the file; no CRC can tell of them."""
        at, end = self._at, self.size
        data_at = at + FRAME.size + head.data_at
        data = inflate_torn(head.compression, self._frames.read(data_at, end - data_at))[: head.size]
        before = self.part.message_count
        rest = yield from self._inside(data)
        kept = self.part.message_count - before
        # Which compressed bytes the lost records were in, nobody can tell.
        n_bytes = end - at if head.compression else rest
        told = f"; messages of it that are whole: {kept}" if kept else ""
        if n_bytes:
            self._lose(end - n_bytes, n_bytes, f"a chunk torn at the end{told}")

    def _inside(self, data: bytes) -> Generator[McapRecord, None, int]:
        """Records of a chunk. Returns how many bytes at its end are none."""
        rest = len(data)
        for opcode, content in frames(BytesIO(data), rest):
            rest -= FRAME.size + len(content)
            yield from self._record(opcode, content)
        return rest

    def _record(self, opcode: int, content: bytes) -> Iterator[McapRecord]:
        """A record outside of chunks, or inside of one; none if it is of no use for a copy."""
        if opcode == Opcode.MESSAGE and len(content) >= MESSAGE.size:
            channel, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(content)
            if channel not in self._channels:
                yield from self._announced(channel)
            if channel not in self._channels:
                self._lose(self._at, FRAME.size + len(content), "messages of a topic that is lost")
                return
            topic = self._channels[channel]
            log_time_ns, publish_time_ns = min(log_time_ns, TIME_MAX_NS), min(publish_time_ns, TIME_MAX_NS)
            self.part.count(topic, log_time_ns=log_time_ns, publish_time_ns=publish_time_ns)
            self.lag_ns = max(self.lag_ns, self.part.last_ns - log_time_ns)
            self.goes_back_ns = max(self.goes_back_ns, self._times_ns.get(topic, 0) - log_time_ns)
            self._last_ns = self._times_ns[topic] = log_time_ns
            for damage in reversed(self.damages):
                if damage.before_ns is not None:
                    break
                damage.before_ns = log_time_ns
            data = content[MESSAGE.size :]
            if channel in self._cdr:
                payload, data = data, plain(data)
                if data is not payload:
                    self.compressed.add(topic)
                self._check(topic, data)
            if topic in self._latched:
                self.part.latest[topic] = data, publish_time_ns
            yield Message(channel, log_time_ns, data, publish_time_ns, sequence)
            return
        if opcode in (Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX):
            return
        record = parse(opcode, content)
        if isinstance(record, Header):
            self.library = record.library
        if isinstance(record, _KEPT) and self._is_new(record):
            yield record
        elif record is None and opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.MESSAGE):
            self._lose(self._at, FRAME.size + len(content), "a record that is none")

    def _check(self, topic: str, data: bytes) -> None:
        """Look whether a payload is CDR, as far as that can be told without its type; of a text, whole."""
        try:
            if self.part.topics[topic]["type"] == JSON:
                cdr.decode_string(data)
            else:
                cdr.byte_order(data)
        except MessageError as error:
            self.unreadable.enter(topic, error)

    def _announced(self, channel_id: int) -> Iterator[McapRecord]:
        """A channel, with its schema, as the summary repeats them: the chunk that had them is damaged."""
        channel = self.summary.channels.get(channel_id) if self.summary is not None else None
        if channel is None or self.summary is None:
            return
        schema = self.summary.schemas.get(channel.schema_id)
        for record in (schema, channel):
            if record is not None and self._is_new(record):
                yield record

    def _is_new(self, record: McapRecord) -> bool:
        """Enter a record; False for a schema or channel that the summary repeats."""
        if isinstance(record, Schema):
            if record.id in self._schemas:
                return False
            self._schemas[record.id] = record.name
        elif isinstance(record, Channel):
            if record.id in self._channels or record.schema_id not in self._schemas:
                return False
            self._channels[record.id] = record.topic
            if record.message_encoding == CDR:
                self._cdr.add(record.id)
            type = self._schemas[record.schema_id]
            self.part.announce(record.topic, type, record.message_encoding, record.metadata)
            if is_latched(self.part.topics[record.topic]):
                self._latched.add(record.topic)
        elif isinstance(record, Metadata):
            self.part.learn(record.name, record.metadata)
        return True

    def _lose(self, at: int, n_bytes: int, why: str) -> None:
        """Enter bytes that could not be used; those that follow each other are one place."""
        if n_bytes <= 0:
            return
        last = self.damages[-1] if self.damages else None
        if last is not None and (
            len(self.damages) >= DAMAGES_MAX
            or (last.before_ns is None and (last.at + last.n_bytes == at or last.why == why))
        ):
            last.n_bytes += n_bytes
            return
        self.damages.append(Damage(at, n_bytes, why, after_ns=self._last_ns))
