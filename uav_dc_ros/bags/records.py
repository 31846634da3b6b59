"""Records of an MCAP file, found and checked without an index.

Outside of chunks MCAP has no checksums, so a record is accepted by its shape: the lengths inside of it must
agree with its header. A chunk has its length twice, and its content has a CRC.
"""

import os
import re
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, UnsupportedCompressionError
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
HEADER = struct.Struct("<BQ")  # of a record: opcode, length of the content
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK_COMPRESSIONS = ("", "zstd", "lz4")
CDR = "cdr"  # ROS 2's serialisation
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
PAYLOAD_MAX_BYTES = 2**30  # of a message that is compressed individually
TIME_MAX_NS = 2**63 - 1  # times are unsigned in MCAP, and signed in ROS 2
PRIVATE = 0x80  # first opcode of application records
FOOTER_BYTES = 20
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size and CRC, length of the compression's name
_NAME_MAX = 32  # of a compression's name
_BLOCK = 2**20  # bytes searched at a time
_SMALL = 2**20  # a larger record is read only if another record follows it
_FIXED_BYTES = {Opcode.DATA_END: 4, Opcode.SUMMARY_OFFSET: 17}
_READERS = {
    Opcode.HEADER: records.Header.read,
    Opcode.SCHEMA: records.Schema.read,
    Opcode.CHANNEL: records.Channel.read,
    Opcode.METADATA: records.Metadata.read,
    Opcode.ATTACHMENT: records.Attachment.read,
    Opcode.CHUNK_INDEX: records.ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex.read,
    Opcode.METADATA_INDEX: records.MetadataIndex.read,
    Opcode.STATISTICS: records.Statistics.read,
}
# Starts of chunks below 2^40 bytes; the lookahead also finds one that begins inside of another match.
_CHUNK_START = re.compile(rb"\x06(?=.{5}\x00{3}.{28}(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4}))", re.DOTALL)
_MESSAGE_START = re.compile(rb"\x05(?=.{4}\x00{4}.{22})", re.DOTALL)


class _StrictStream(ReadDataStream):
    """Raises EndOfFile instead of returning fewer bytes than requested."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile()
        return data


def parse(opcode: int, content: bytes, *, exact: bool = False) -> records.McapRecord | None:
    """A record of a kind in `_READERS`; None for other kinds and for an invalid record.

    With `exact`, bytes after the last field are invalid; MCAP allows them for future fields.
    """
    read = _READERS.get(Opcode(opcode)) if opcode in Opcode._value2member_map_ else None
    if read is None:
        return None
    stream = _StrictStream(BytesIO(content))
    try:
        record = read(stream)
    except Exception:  # of mcap, struct, UTF-8: damaged bytes
        return None
    if exact and stream.count != len(content):
        return None
    if isinstance(record, records.Attachment):
        crc = int.from_bytes(content[stream.count - 4 : stream.count], "little")
        if crc not in (0, zlib.crc32(content[: stream.count - 4])):
            return None
    return record


@dataclass(frozen=True)
class ChunkHeader:
    """The fields of a chunk before its data."""

    size: int  # of the decompressed data, bytes
    crc: int  # of the decompressed data; 0: none
    compression: str
    data_at: int  # offset of the data in the chunk's content
    data_bytes: int  # length of the compressed data

    @property
    def length(self) -> int:
        """Length of the whole content, bytes; equal to that in the record's header."""
        return self.data_at + self.data_bytes


def _decompressor(compression: str) -> Any:
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj()
    return lz4.frame.LZ4FrameDecompressor()


def _decompressed(compression: str, data: bytes) -> bytes | None:
    """The data of a whole chunk; None if it is damaged or has another length."""
    if not compression:
        return data
    try:
        stream = _decompressor(compression)
        content: bytes = stream.decompress(data)
    except Exception:  # of zstandard, lz4; out of memory by a wrong size
        return None
    return content if stream.eof and not stream.unused_data else None


def decompress_chunk(header: ChunkHeader, data: bytes) -> bytes | None:
    """The data of a whole chunk, checked; None if it is damaged; may raise UnsupportedCompressionError."""
    known = header.compression in CHUNK_COMPRESSIONS
    for compression in (header.compression,) if known else CHUNK_COMPRESSIONS:  # the name may be damaged
        content = _decompressed(compression, data)
        if content is None:
            continue
        has_size = known and len(content) == header.size  # the only check without a CRC
        if zlib.crc32(content) == header.crc if header.crc else has_size:
            return content
    if not known:
        raise UnsupportedCompressionError(header.compression)
    return None


def decompress_torn(compression: str, data: bytes) -> bytes:
    """The beginning of a chunk whose end is missing, up to the last complete block."""
    if compression not in CHUNK_COMPRESSIONS[1:]:
        return data
    try:
        return bytes(_decompressor(compression).decompress(data))
    except Exception:  # of zstandard, lz4
        return b""


def decompress_payload(payload: bytes) -> bytes:
    """The CDR payload of a message, decompressed if rosbag2 compressed each message individually.

    CDR begins with a zero byte, a zstd frame does not. A damaged frame is returned unchanged.
    """
    if not payload.startswith(ZSTD_MAGIC):
        return payload
    try:
        if 0 <= zstandard.get_frame_parameters(payload).content_size <= PAYLOAD_MAX_BYTES:
            return zstandard.ZstdDecompressor().decompress(payload)
    except (zstandard.ZstdError, MemoryError):
        pass
    return payload


class RecordReader:
    """Reads and searches records outside of chunks at any offset of a file."""

    def __init__(self, file: IO[bytes]) -> None:
        self.size = os.fstat(file.fileno()).st_size
        self._file = file

    def read(self, at: int, n_bytes: int) -> bytes:
        """Bytes from `at` on; fewer at the end of the file."""
        self._file.seek(at)
        return self._file.read(n_bytes)

    def header(self, at: int) -> tuple[int, int]:
        """Opcode and length of the record at `at`; zeros at the end of the file."""
        header = self.read(at, HEADER.size)
        return HEADER.unpack(header) if len(header) == HEADER.size else (0, 0)

    def _chunk_header(self, at: int) -> ChunkHeader | None:
        """The header of the chunk at `at`; None if it is invalid."""
        fields = self.read(at + HEADER.size, _CHUNK.size + _NAME_MAX + 8)
        if len(fields) < _CHUNK.size:
            return None
        _, _, size, crc, name_bytes = _CHUNK.unpack_from(fields)
        data_at = _CHUNK.size + name_bytes + 8
        name = fields[_CHUNK.size : _CHUNK.size + name_bytes]
        if name_bytes > _NAME_MAX or len(fields) < data_at or not name.isascii():
            return None
        data_bytes = int.from_bytes(fields[data_at - 8 : data_at], "little")
        return ChunkHeader(size, crc, name.decode(), data_at, data_bytes)

    def chunk(self, at: int) -> tuple[ChunkHeader, int] | None:
        """The chunk at `at` and its end; None if its lengths differ and no CRC shows which is right.

        A torn chunk ends beyond the file.
        """
        header = self._chunk_header(at)
        if header is None:
            return None
        opcode, length = self.header(at)
        content_at = at + HEADER.size
        if opcode == Opcode.CHUNK and length == header.length:
            return header, content_at + length
        # The opcode or one of the lengths is damaged. None of them is in the CRC.
        for content_bytes in (header.length, length):
            data_bytes = content_bytes - header.data_at
            if header.crc == 0 or not 0 <= data_bytes <= header.size + header.size // 64 + 1024:
                continue
            if content_at + content_bytes > self.size:
                continue
            content = _decompressed(header.compression, self.read(content_at + header.data_at, data_bytes))
            if content is not None and zlib.crc32(content) == header.crc:
                return replace(header, data_bytes=data_bytes), content_at + content_bytes
        return None

    def record(self, at: int) -> tuple[int, bytes, int] | None:
        """Opcode, content and end of the record at `at`; None if it is torn, invalid, or a chunk."""
        opcode, length = self.header(at)
        end = at + HEADER.size + length
        if opcode in (0, Opcode.CHUNK) or end > self.size:
            return None
        # A message and an application record have no shape beyond their length.
        if (length > _SMALL or opcode == Opcode.MESSAGE or opcode >= PRIVATE) and not self._begins(end):
            return None
        content = self.read(at + HEADER.size, length)
        if opcode == Opcode.FOOTER:
            valid = length == FOOTER_BYTES and MAGIC.startswith(self.read(end, len(MAGIC)))
        elif opcode == Opcode.MESSAGE:
            valid = length >= MESSAGE.size
        elif opcode == Opcode.MESSAGE_INDEX:
            valid = length >= 6 and int.from_bytes(content[2:6], "little") == length - 6
        elif opcode in _FIXED_BYTES:
            valid = length == _FIXED_BYTES[Opcode(opcode)]
        elif opcode >= PRIVATE:
            valid = self.chunk(at) is None  # a chunk with a damaged opcode looks like an application record
        else:
            valid = parse(opcode, content, exact=True) is not None
        return (opcode, content, end) if valid else None

    def _begins(self, at: int) -> bool:
        """Whether `at` can be the start of a record, the end of the file, or zeros of a power cut."""
        header = self.read(at, HEADER.size)
        if len(header) < HEADER.size or header == bytes(HEADER.size):
            return True
        opcode, length = HEADER.unpack(header)
        return (0 < opcode <= Opcode.DATA_END or opcode >= PRIVATE) and length < 2**40

    def next_chunk(self, at: int) -> int | None:
        """Offset of the next chunk, torn or whole, whose lengths agree."""
        for found in self._matches(_CHUNK_START, at):
            header = self._chunk_header(found)
            if header is not None and self.header(found)[1] == header.length:
                return found
        return None

    def next_message(self, at: int, channels: Collection[int]) -> int | None:
        """Offset of the next message outside of chunks, of a known channel and before two valid records."""
        for found in self._matches(_MESSAGE_START, at):
            following = found
            for _ in range(3):
                record = self.record(following) if following < self.size else None
                if record is None:
                    break
                if record[0] == Opcode.MESSAGE and MESSAGE.unpack_from(record[1])[0] not in channels:
                    break
                following = record[2]
            else:
                return found
        return None

    def _matches(self, pattern: re.Pattern[bytes], at: int) -> Iterator[int]:
        overlap = HEADER.size + _CHUNK.size + _NAME_MAX
        while at < self.size:
            block = self.read(at, _BLOCK + overlap)
            for match in pattern.finditer(block):
                if match.start() < _BLOCK:
                    yield at + match.start()
            at += _BLOCK
