"""Frames of an MCAP file: is a record what its first bytes say, what is in a chunk, where is the next one.

Outside of chunks MCAP has no checksums, so a frame is believed by its shape: lengths inside of it must agree
with its own. A chunk tells its length twice, and its content has a CRC.
"""

import os
import re
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

MAGIC = b"\x89MCAP0\r\n"
FRAME = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
COMPRESSIONS = ("", "zstd", "lz4")
CDR = "cdr"  # how ROS 2 serialises messages
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
PAYLOAD_MAX_BYTES = 2**30  # of a message that is compressed by itself
TIME_MAX_NS = 2**63 - 1  # MCAP has unsigned times, ROS 2 and tables have not
PRIVATE = 0x80  # opcodes from here on belong to applications
FOOTER_BYTES = 20
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size and CRC, length of the compression's name
_NAME_MAX = 32  # of a compression's name
_BLOCK = 2**20  # bytes looked through at a time
_SMALL = 2**20  # a record that is larger is read only where another one follows it
_FIXED = {Opcode.DATA_END: 4, Opcode.SUMMARY_OFFSET: 17}  # content of one length
_READERS = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.STATISTICS: Statistics.read,
}
# Starts of chunks below 2^40 bytes; the lookahead finds those that begin inside of others, too.
_CHUNK_START = re.compile(rb"\x06(?=.{5}\x00{3}.{28}(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4}))", re.DOTALL)
_MESSAGE_START = re.compile(rb"\x05(?=.{4}\x00{4}.{22})", re.DOTALL)


class _Strict(ReadDataStream):
    """A stream that does not hand out less than was asked for."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile()
        return data


def parse(opcode: int, content: bytes, *, exact: bool = False) -> McapRecord | None:
    """A record with content of its own; None for others, and for one that is not what it says.

    Args:
        opcode: its kind.
        content: what follows its frame.
        exact: refuse bytes after its last field. MCAP allows them, for fields to come.
    """
    read = _READERS.get(Opcode(opcode)) if opcode in Opcode._value2member_map_ else None
    if read is None:
        return None
    stream = _Strict(BytesIO(content))
    try:
        record = read(stream)
    except Exception:  # of mcap, struct, UTF-8: damaged bytes
        return None
    if exact and stream.count != len(content):
        return None
    if isinstance(record, Attachment):
        told = int.from_bytes(content[stream.count - 4 : stream.count], "little")
        if told not in (0, zlib.crc32(content[: stream.count - 4])):
            return None
    return record


def frames(stream: IO[bytes], size: int) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record that is there in full, within `size` bytes from here."""
    while size >= FRAME.size:
        opcode, length = FRAME.unpack(stream.read(FRAME.size))
        size -= FRAME.size + length
        if opcode == 0 or size < 0:  # 0 is no opcode: zeros that a power cut left
            return
        yield opcode, stream.read(length)


@dataclass(frozen=True, kw_only=True)
class ChunkHead:
    """What a chunk says before its data.

    Attributes:
        size, crc: of the data, decompressed; a CRC of 0 is none.
        compression: its name.
        data_at: where the data begins in the chunk's content, bytes.
        data_bytes: length of the data.
    """

    size: int
    crc: int
    compression: str
    data_at: int
    data_bytes: int

    @property
    def length(self) -> int:
        """Of the whole content, bytes; the frame must say the same."""
        return self.data_at + self.data_bytes


def inflate(compression: str, data: bytes) -> bytes:
    """The data of a whole chunk, decompressed; ValueError if it is damaged, or not of this length."""
    if not compression:
        return data
    try:
        stream = _decompressor(compression)
        plain: bytes = stream.decompress(data)
    except Exception as error:  # of zstandard, lz4; out of memory by a size that is none
        raise ValueError(str(error)) from None
    if not stream.eof or stream.unused_data:
        raise ValueError(f"{compression} of another length")
    return plain


def _decompressor(compression: str) -> Any:
    return (
        zstandard.ZstdDecompressor().decompressobj()
        if compression == "zstd"
        else lz4.frame.LZ4FrameDecompressor()
    )


def unpack(head: ChunkHead, data: bytes) -> bytes | None:
    """The data of a whole chunk, decompressed and checked; None if it is damaged.

    Raises:
        UnsupportedCompressionError: it is compressed in another way.
    """
    known = head.compression in COMPRESSIONS
    for compression in (head.compression,) if known else COMPRESSIONS:
        try:
            plain = inflate(compression, data)
        except ValueError:
            continue
        # Without a CRC, its size must do.
        if zlib.crc32(plain) == head.crc if head.crc else known and len(plain) == head.size:
            return plain  # the CRC also tells when it is but the name that is damaged
    if not known:
        raise UnsupportedCompressionError(head.compression)
    return None


def inflate_torn(compression: str, data: bytes) -> bytes:
    """The beginning of a chunk of which only a beginning is there, block by block until the cut."""
    try:
        plain: bytes = (
            _decompressor(compression).decompress(data) if compression in COMPRESSIONS[1:] else data
        )
    except Exception:  # of zstandard, lz4
        return b""
    return plain


def plain(payload: bytes) -> bytes:
    """The CDR payload of a message, decompressed where rosbag2 compressed each message by itself.

    CDR begins with a zero byte, a zstd frame does not. A frame that is damaged stays as it is.
    """
    if not payload.startswith(ZSTD_MAGIC):
        return payload
    try:
        if 0 <= zstandard.get_frame_parameters(payload).content_size <= PAYLOAD_MAX_BYTES:
            return zstandard.ZstdDecompressor().decompress(payload)
    except (zstandard.ZstdError, MemoryError):
        pass
    return payload


class Frames:
    """Looks at the records that lie open in a file, wherever they may begin."""

    def __init__(self, file: IO[bytes]) -> None:
        self.size = os.fstat(file.fileno()).st_size
        self._file = file

    def read(self, at: int, n_bytes: int) -> bytes:
        """Bytes from `at` on, as many as there are."""
        self._file.seek(at)
        return self._file.read(n_bytes)

    def chunk_head(self, at: int) -> ChunkHead | None:
        """What the chunk whose frame begins at `at` says; None if its first bytes make no sense."""
        head = self.read(at + FRAME.size, _CHUNK.size + _NAME_MAX + 8)
        if len(head) < _CHUNK.size:
            return None
        _, _, size, crc, name_bytes = _CHUNK.unpack_from(head)
        data_at = _CHUNK.size + name_bytes + 8
        name = head[_CHUNK.size : _CHUNK.size + name_bytes]
        if name_bytes > _NAME_MAX or len(head) < data_at or not name.isascii():
            return None
        data_bytes = int.from_bytes(head[data_at - 8 : data_at], "little")
        return ChunkHead(
            size=size, crc=crc, compression=name.decode(), data_at=data_at, data_bytes=data_bytes
        )

    def torn_chunk(self, at: int) -> ChunkHead | None:
        """The chunk at `at` if both its lengths agree that it reaches beyond the end of the file."""
        frame = self.read(at, FRAME.size)
        head = self.chunk_head(at)
        if head is None or FRAME.unpack(frame) != (Opcode.CHUNK, head.length):
            return None
        return head if at + FRAME.size + head.length > self.size else None

    def chunk(self, at: int) -> tuple[ChunkHead, int] | None:
        """The chunk at `at` and where it ends, if its lengths agree, or its CRC tells which is right."""
        frame = self.read(at, FRAME.size)
        head = self.chunk_head(at)
        if head is None:
            return None
        opcode, length = FRAME.unpack(frame)
        end = at + FRAME.size + length
        if opcode == Opcode.CHUNK and length == head.length:
            return (head, end) if end <= self.size else None
        # One is wrong: the opcode, the frame's length, or the data's length. None of them is in the CRC.
        for content_bytes in (head.length, length):
            data_bytes = content_bytes - head.data_at
            if head.crc == 0 or not 0 <= data_bytes <= head.size + head.size // 64 + 1024:
                continue
            if at + FRAME.size + content_bytes > self.size:
                continue
            data = self.read(at + FRAME.size + head.data_at, data_bytes)
            try:
                told = zlib.crc32(inflate(head.compression, data)) == head.crc
            except ValueError:
                told = False
            if told:
                found = ChunkHead(
                    size=head.size, crc=head.crc, compression=head.compression, data_at=head.data_at,
                    data_bytes=data_bytes,
                )  # fmt: skip
                return found, at + FRAME.size + content_bytes
        return None

    def record(self, at: int) -> tuple[int, bytes, int] | None:
        """Opcode, content and end of the record at `at`; None if it is torn, or its shape is not believed.

        Chunks are none of them.
        """
        frame = self.read(at, FRAME.size)
        if len(frame) < FRAME.size:
            return None
        opcode, length = FRAME.unpack(frame)
        end = at + FRAME.size + length
        if opcode in (0, Opcode.CHUNK) or end > self.size:
            return None
        # Of a message, or an application's record, nothing but its length can be looked at.
        if (length > _SMALL or opcode == Opcode.MESSAGE or opcode >= PRIVATE) and not self._begins(end):
            return None
        content = self.read(at + FRAME.size, length)
        if opcode == Opcode.FOOTER:
            believed = length == FOOTER_BYTES and MAGIC.startswith(self.read(end, len(MAGIC)))
        elif opcode == Opcode.MESSAGE:
            believed = length >= MESSAGE.size
        elif opcode == Opcode.MESSAGE_INDEX:
            believed = length >= 6 and int.from_bytes(content[2:6], "little") == length - 6
        elif opcode in _FIXED:
            believed = length == _FIXED[Opcode(opcode)]
        else:
            # A chunk whose opcode is damaged looks like an application's record.
            private = opcode >= PRIVATE and self.chunk(at) is None
            believed = private or parse(opcode, content, exact=True) is not None
        return (opcode, content, end) if believed else None

    def _begins(self, at: int) -> bool:
        """Whether the file ends at `at`, a record may begin there, or a power cut left zeros."""
        frame = self.read(at, FRAME.size)
        if len(frame) < FRAME.size or frame == bytes(FRAME.size):
            return True
        opcode, length = FRAME.unpack(frame)
        return (0 < opcode <= Opcode.DATA_END or opcode >= PRIVATE) and length < 2**40

    def next_chunk(self, at: int) -> int | None:
        """Where the next chunk begins whose lengths agree, torn or whole, from `at` on."""
        for found in self._matches(_CHUNK_START, at):
            head = self.chunk_head(found)
            if head is not None and FRAME.unpack(self.read(found, FRAME.size))[1] == head.length:
                return found
        return None

    def next_message(self, at: int, channels: Collection[int]) -> int | None:
        """Where the next message begins outside of chunks: of a known channel, two more records after it."""
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
        overlap = FRAME.size + _CHUNK.size + _NAME_MAX
        while at < self.size:
            block = self.read(at, _BLOCK + overlap)
            for match in pattern.finditer(block):
                if match.start() < _BLOCK:
                    yield at + match.start()
            at += _BLOCK
