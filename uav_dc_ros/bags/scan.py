"""Read an MCAP file as far as it goes: whole, or cut at any byte.

mcap's StreamReader stops a torn file with EndOfFile, struct.error, ZstdError, UnicodeDecodeError or
CRCValidationError, as the cut falls, and hands out a message that is cut short as if it were whole. So the
frames of the records are read here, and only what lies inside a whole frame goes to mcap.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from uav_dc_ros.bags.metadata import Part, is_latched
from uav_dc_ros.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
_FRAME = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size and CRC, length of the compression's name
_FOOTER = struct.Struct("<QQI")  # start of the summary, of its offsets, its CRC
_END_BYTES = _FRAME.size + _FOOTER.size + len(MAGIC)
_COMPRESSIONS = ("", "zstd", "lz4")
_READERS = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
    Opcode.ATTACHMENT: Attachment.read,
}


def has_end(file: IO[bytes]) -> bool:
    """Whether an MCAP file has a summary, unharmed, a footer and the closing magic.

    Raises:
        OSError: the disk is gone.
    """
    size = os.fstat(file.fileno()).st_size
    if size < len(MAGIC) + _END_BYTES:
        return False
    file.seek(size - _END_BYTES)
    end = file.read(_END_BYTES)
    opcode, length = _FRAME.unpack_from(end)
    if end[-len(MAGIC) :] != MAGIC or (opcode, length) != (Opcode.FOOTER, _FOOTER.size):
        return False
    start, _, crc = _FOOTER.unpack_from(end, _FRAME.size)
    if not len(MAGIC) <= start < size - _END_BYTES:
        return False
    if crc == 0:  # MCAP's way to say that there is none
        return True
    file.seek(start)
    # The summary is small, some ten bytes for each chunk and topic. Its CRC takes in the footer up to itself.
    return zlib.crc32(file.read(size - start - len(MAGIC) - 4)) == crc


class Scan:
    """Iterates over what can be read of an MCAP file, in one pass, a chunk at a time in memory.

    Yields schemas, channels, messages, metadata records and attachments. Schemas and channels come
    once; a message comes after its channel. What follows a torn record is no record.

    Attributes:
        path: the file's.
        part: what was read until now.
        lost_bytes: bytes that could not be used until now, as they lie in the file.

    Raises:
        BagError: the file is no MCAP file, or is compressed in a way that cannot be read here.
        OSError: the disk is gone.
    """

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.part = Part(path.name)
        self.lost_bytes = 0
        self.path = path
        self._file = file
        self._schemas: dict[int, str] = {0: ""}
        self._channels: dict[int, str] = {}
        self._latched: set[str] = set()

    def __iter__(self) -> Iterator[McapRecord]:
        """Start at the beginning of the file; once."""
        size = os.fstat(self._file.fileno()).st_size
        self._file.seek(0)
        magic = self._file.read(len(MAGIC))
        if magic != MAGIC[: len(magic)]:
            raise BagError(f"{self.path} starts with {magic!r}; expected {MAGIC!r}, as an MCAP file does")
        used = len(magic)
        if len(magic) < len(MAGIC):
            self.lost_bytes += used
            return
        for opcode, content in _frames(self._file, size - used):
            used += _FRAME.size + len(content)
            if opcode == Opcode.FOOTER:
                return
            yield from self._chunk(content) if opcode == Opcode.CHUNK else self._record(opcode, content)
        rest = size - used
        self._file.seek(used)
        start = self._file.read(_FRAME.size + _CHUNK.size + 8)  # 8: length of the data
        if len(start) == _FRAME.size + _CHUNK.size + 8 and start[0] == Opcode.CHUNK:
            *_, name_length = _CHUNK.unpack_from(start, _FRAME.size)
            if name_length == 0:  # not compressed, so its first records are there
                rest -= len(start)
                for opcode, content in _frames(self._file, rest):
                    rest -= _FRAME.size + len(content)
                    yield from self._record(opcode, content)
        self.lost_bytes += rest

    def _chunk(self, content: bytes) -> Iterator[McapRecord]:
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(content)))
            if chunk.compression not in _COMPRESSIONS:
                raise UnsupportedCompressionError(chunk.compression)
            stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        except UnsupportedCompressionError as error:
            # Left out, its messages would be gone once the file is written anew.
            raise BagError(f"{self.path}: {error}; expected one of {_COMPRESSIONS} at hand") from None
        except Exception:  # of struct, zlib, zstandard, lz4, mcap: a chunk that a disk has damaged
            self.lost_bytes += _FRAME.size + len(content)
            return
        inside = BytesIO(stream.read(size))
        rest = size
        for opcode, record in _frames(inside, size):
            rest -= _FRAME.size + len(record)
            yield from self._record(opcode, record)
        self.lost_bytes += rest

    def _record(self, opcode: int, content: bytes) -> Iterator[McapRecord]:
        """A record outside of chunks, or inside of one; none if it is of no use for a copy."""
        if opcode == Opcode.MESSAGE and len(content) >= _MESSAGE.size:
            channel, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(content)
            if channel not in self._channels:
                self.lost_bytes += _FRAME.size + len(content)
                return
            topic = self._channels[channel]
            self.part.count(topic, log_time_ns=log_time_ns, publish_time_ns=publish_time_ns)
            data = content[_MESSAGE.size :]
            if topic in self._latched:
                self.part.latest[topic] = data, publish_time_ns
            yield Message(channel, log_time_ns, data, publish_time_ns, sequence)
            return
        read = _READERS.get(Opcode(opcode)) if opcode in Opcode._value2member_map_ else None
        if read is None:  # an index: it is made anew
            return
        try:
            record = read(ReadDataStream(BytesIO(content)))
        except (McapError, struct.error, UnicodeDecodeError):
            self.lost_bytes += _FRAME.size + len(content)
            return
        if self._is_new(record):
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
            type = self._schemas[record.schema_id]
            self.part.announce(record.topic, type, record.message_encoding, record.metadata)
            if is_latched(self.part.topics[record.topic]):
                self._latched.add(record.topic)
        elif isinstance(record, Metadata):
            self.part.learn(record.name, record.metadata)
        return True


def _frames(stream: IO[bytes], size: int) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record that is there in full, within `size` bytes from here."""
    while size >= _FRAME.size:
        opcode, length = _FRAME.unpack(stream.read(_FRAME.size))
        size -= _FRAME.size + length
        if opcode == 0 or size < 0:  # 0 is no opcode: zeros that a power cut left
            return
        yield opcode, stream.read(length)
