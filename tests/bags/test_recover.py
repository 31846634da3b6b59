"""Recovering: every message that is there in full, of a bag torn or damaged anywhere, and none else."""

import io
import os
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from tests.bags.made import (
    HASH,
    QOS,
    STRING,
    content,
    in_mcap,
    mcap_file,
    text,
)
from uav_dc_ros.bags import part
from uav_dc_ros.bags.recover import Recovered, recover

Message = tuple[str, int, int, int, bytes]
COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """For hundreds of files at once: no disk that keeps them."""
    monkeypatch.setattr(os, "fsync", lambda _: None)
    monkeypatch.setattr(part, "to_yaml", lambda _: "")


@pytest.fixture
def in_memory() -> Iterator[Path]:
    """A folder for hundreds of files, in memory where the system has such a place."""
    place = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=place if place.is_dir() else None) as folder:
        yield Path(folder)


def large(compression: str, *, n: int = 1000, finished: bool = True) -> bytes:
    """A file of two and a half chunks, each of several blocks of its compression; texts half random."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=300_000, compression=COMPRESSIONS[compression])
    writer.start("ros2", "test")
    writer.add_metadata("uav_dc_ros", {"seed": "3"})
    schema = writer.register_schema(STRING, "ros2msg", b"string data")
    about = {"offered_qos_profiles": QOS, "topic_type_hash": HASH}
    channels = [writer.register_channel(topic, "cdr", schema, about) for topic in ("/a", "/b")]
    chance = random.Random(0)
    for i in range(n):
        data = text(f"{i:06d}" + chance.randbytes(chance.randrange(700)).hex())
        writer.add_message(channels[i % 2], 1000 + i, data, 900 + i, sequence=i)
    if finished:
        writer.finish()
    return file.getvalue()


def chunks(file: bytes) -> list[tuple[int, int, Chunk]]:
    """Start and end of each chunk in a whole file, and the chunk; by mcap."""
    summary = make_reader(io.BytesIO(file)).get_summary()
    assert summary is not None
    found = [
        record
        for record in StreamReader(io.BytesIO(file), emit_chunks=True).records
        if isinstance(record, Chunk)
    ]
    return [
        (index.chunk_start_offset, index.chunk_start_offset + index.chunk_length, chunk)
        for index, chunk in zip(summary.chunk_indexes, found, strict=True)
    ]


def ends_of_messages(file: bytes) -> list[int]:
    """Bytes of a whole file that each message needs: fed byte by byte, its chunk then gives the message."""
    ends = []
    for _, end, chunk in chunks(file):
        data_at = end - len(chunk.data)
        plain_ends = messages_in(chunk)
        if not chunk.compression:
            ends += [data_at + plain_end for plain_end in plain_ends]
            continue
        given = 0
        stream = (
            zstandard.ZstdDecompressor().decompressobj()
            if chunk.compression == "zstd"
            else lz4.frame.LZ4FrameDecompressor()
        )
        for i in range(len(chunk.data)):
            given += len(stream.decompress(chunk.data[i : i + 1]))
            while plain_ends and plain_ends[0] <= given:
                ends.append(data_at + i + 1)
                plain_ends.pop(0)
        assert not plain_ends
    return ends


def messages_in(chunk: Chunk) -> list[int]:
    """Where the messages of a whole chunk end in its data, decompressed."""
    plain = {"zstd": zstandard.decompress, "lz4": lz4.frame.decompress, "": bytes}[chunk.compression](
        chunk.data
    )
    at, ends = 0, []
    while at < len(plain):
        opcode = plain[at]
        at += 9 + int.from_bytes(plain[at + 1 : at + 9], "little")
        ends += [at] if opcode == 5 else []
    return ends


def folder_of(folder: Path, files: list[bytes]) -> Path:
    """A bag folder without metadata.yaml."""
    folder.mkdir()
    for i, file in enumerate(files):
        (folder / f"{folder.name}_{i}.mcap").write_bytes(file)
    return folder


def by_source(recovered: Recovered) -> list[list[Message]]:
    """Messages that were recovered of each source, in order, by mcap's reader, which checks CRCs."""
    return [
        in_mcap(recovered.folder / part.part.name) if part.part is not None else []
        for part in recovered.parts
    ]


def whole(tmp_path: Path, file: bytes) -> list[Message]:
    """All messages of a whole file."""
    path = tmp_path / "whole.mcap"
    path.write_bytes(file)
    return in_mcap(path)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_cut_anywhere_all_that_is_there_comes_back(in_memory: Path, quick: None, compression: str) -> None:
    """At 200 random bytes, around every end of a chunk, and at the very ends."""
    file = large(compression)
    messages, ends = whole(in_memory, file), ends_of_messages(file)
    assert len(messages) == len(ends) == 1000
    assert len(chunks(file)) == 3
    assert len(set(ends)) > 3  # more than whole chunks: their compression gives blocks
    chance = random.Random(1)
    cuts = {chance.randrange(len(file)) for _ in range(200)} | {8, 9, len(file) - 1, len(file)}
    for start, end, _ in chunks(file):
        cuts |= {start - 1, start, start + 1, start + 60, end - 1, end, end + 1}
    ordered = sorted(cuts)
    bag = folder_of(in_memory / "bag", [file[:cut] for cut in ordered])
    before = content(bag)
    recovered = recover(bag, in_memory / "out")
    for cut, found in zip(ordered, by_source(recovered), strict=True):
        assert found == messages[: sum(end <= cut for end in ends)], f"cut at {cut} of {len(file)}"
    assert content(bag) == before


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_flipped_bit_costs_its_chunk_at_most_and_never_lies(
    in_memory: Path, quick: None, compression: str, finished: bool
) -> None:
    """Each file has one bit flipped; what is missing is one chunk's, and is told."""
    file = mcap_file(compression=COMPRESSIONS[compression], chunked=True, n=30)
    starts_ends = chunks(file)
    if not finished:
        file = file[: starts_ends[-1][1]]
    messages = whole(in_memory, mcap_file(compression=COMPRESSIONS[compression], chunked=True, n=30))
    of_chunk = [len(messages_in(chunk)) for *_, chunk in starts_ends]
    chance = random.Random(2)
    flips = [(at, chance.randrange(8)) for at in chance.sample(range(8, len(file)), 300)]
    for start, *_ in starts_ends[1:3]:  # all that a chunk says of itself
        flips += [(at, bit) for at in range(start, start + 53) for bit in (0, 3, 7)]
    bag = folder_of(in_memory / "bag", [flipped(file, *flip) for flip in flips])
    recovered = recover(bag, in_memory / "out")
    n_lost = 0
    for (at, bit), found, one in zip(flips, by_source(recovered), recovered.parts, strict=True):
        missing = sorted(set(messages) - set(found))
        assert found == [m for m in messages if m not in missing], f"bit {bit} of byte {at}"
        if missing:
            n_lost += 1
            [number] = [i for i, (start, end, _) in enumerate(starts_ends) if start <= at < end]
            first = sum(of_chunk[:number])
            # Without an end, nobody else tells of the topics that the first chunk names.
            assert missing == sorted(messages[first : first + of_chunk[number]]) or (
                number == 0 and not finished
            )
            assert one.damages or one.why, f"bit {bit} of byte {at}"
            if finished and one.expected is not None:
                assert one.lost_messages == len(missing)
            for damage in one.damages:
                assert damage.after_ns is None or damage.after_ns <= missing[0][2] - 1 or number == 0
    assert n_lost > 50


def flipped(file: bytes, at: int, bit: int) -> bytes:
    """A file with one bit flipped."""
    return file[:at] + bytes([file[at] ^ (1 << bit)]) + file[at + 1 :]
