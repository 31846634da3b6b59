"""Recovering: every message that is there in full, of a bag torn or damaged anywhere, and none else."""

import io
import os
import random
import subprocess
import sys
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

from tests.support.bags import (
    HASH,
    QOS,
    ROOT,
    STRING,
    content,
    in_bag,
    in_mcap,
    information,
    killed_writer,
    mcap_file,
    text,
)
from uav_dc_ros import bag as command
from uav_dc_ros.bags import part_writer
from uav_dc_ros.bags.salvage.recover import Recovered, recover, report
from uav_dc_ros.errors import BagError

Message = tuple[str, int, int, int, bytes]
COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """For hundreds of files at once: no disk that keeps them."""
    monkeypatch.setattr(os, "fsync", lambda _: None)
    monkeypatch.setattr(part_writer, "to_yaml", lambda _: "")


@pytest.fixture
def in_memory() -> Iterator[Path]:
    """A folder for hundreds of files, in memory where the system has such a place."""
    place = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=place if place.is_dir() else None) as folder:
        yield Path(folder)


def large(compression: str, *, n: int = 500) -> bytes:
    """A file of two and a half chunks, each of several blocks of its compression; texts half random."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=150_000, compression=COMPRESSIONS[compression])
    writer.start("ros2", "test")
    writer.add_metadata("uav_dc_ros", {"seed": "3"})
    schema = writer.register_schema(STRING, "ros2msg", b"string data")
    about = {"offered_qos_profiles": QOS, "topic_type_hash": HASH}
    channels = [writer.register_channel(topic, "cdr", schema, about) for topic in ("/a", "/b")]
    chance = random.Random(0)
    for i in range(n):
        data = text(f"{i:06d}" + chance.randbytes(chance.randrange(700)).hex())
        writer.add_message(channels[i % 2], 1000 + i, data, 900 + i, sequence=i)
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


@pytest.mark.parametrize(
    ("compression", "n_cuts"),
    [("zstd", 30), ("lz4", 10), ("none", 10)]
    + [pytest.param(compression, 1000, marks=pytest.mark.long) for compression in COMPRESSIONS],
)
def test_cut_anywhere_all_that_is_there_comes_back(
    in_memory: Path, quick: None, compression: str, n_cuts: int
) -> None:
    """At random bytes, around every end of a chunk, and at the very ends."""
    file = large(compression)
    messages, ends = whole(in_memory, file), ends_of_messages(file)
    assert len(messages) == len(ends) == 500
    assert len(chunks(file)) == 3
    assert len(set(ends)) > 3  # more than whole chunks: their compression gives blocks
    chance = random.Random(1)
    cuts = {chance.randrange(len(file)) for _ in range(n_cuts)} | {8, 9, len(file) - 1, len(file)}
    for start, end, _ in chunks(file):
        cuts |= {start - 1, start, start + 1, start + 60, end - 1, end, end + 1}
    ordered = sorted(cuts)
    bag = folder_of(in_memory / "bag", [file[:cut] for cut in ordered])
    before = content(bag)
    recovered = recover(bag, in_memory / "out")
    for cut, found in zip(ordered, by_source(recovered), strict=True):
        assert found == messages[: sum(end <= cut for end in ends)], f"cut at {cut} of {len(file)}"
    assert content(bag) == before


@pytest.mark.parametrize(
    ("compression", "finished", "n_flips"),
    [
        ("zstd", True, 20),
        ("none", False, 20),
        *(
            pytest.param(compression, finished, 1500, marks=pytest.mark.long)
            for compression in COMPRESSIONS
            for finished in (True, False)
        ),
    ],
)
def test_a_flipped_bit_costs_at_most_its_chunk_and_changes_no_message(
    in_memory: Path, quick: None, compression: str, finished: bool, n_flips: int
) -> None:
    """Each file has one bit flipped; only one chunk is lost, and the report lists it."""
    file = mcap_file(compression=COMPRESSIONS[compression], chunked=True, n=30)
    starts_ends = chunks(file)
    if not finished:
        file = file[: starts_ends[-1][1]]
    messages = whole(in_memory, mcap_file(compression=COMPRESSIONS[compression], chunked=True, n=30))
    of_chunk = [len(messages_in(chunk)) for *_, chunk in starts_ends]
    chance = random.Random(2)
    flips = [(at, chance.randrange(8)) for at in chance.sample(range(8, len(file)), n_flips)]
    for start, *_ in starts_ends[1:2]:  # the header of a chunk
        flips += [(at, bit) for at in range(start, start + 53) for bit in (0, 7)]
    flips.append((starts_ends[1][1], 1))  # a message index becomes a message
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
            # Without an end, only the first chunk names its topics.
            assert missing == sorted(messages[first : first + of_chunk[number]]) or (
                number == 0 and not finished
            )
            assert one.damages or one.reason, f"bit {bit} of byte {at}"
            if finished and one.expected is not None:
                assert one.lost_messages == len(missing)
            for damage in one.damages:
                assert damage.after_ns is None or damage.after_ns <= missing[0][2] - 1 or number == 0
    assert n_lost > n_flips // 5


def flipped(file: bytes, at: int, bit: int) -> bytes:
    """A file with one bit flipped."""
    return file[:at] + bytes([file[at] ^ (1 << bit)]) + file[at + 1 :]


def test_damage_across_chunks_is_passed_over(tmp_path: Path) -> None:
    """With an end, which lists the chunks, and without one; and messages outside of chunks."""
    for name, compression, chunked, finished in (
        ("indexed", CompressionType.ZSTD, True, True),
        ("torn", CompressionType.ZSTD, True, False),
        ("open", CompressionType.NONE, False, False),
    ):
        file = mcap_file(compression=compression, chunked=chunked, n=200, finished=finished)
        (tmp_path / name).mkdir()
        (tmp_path / name / "whole.mcap").write_bytes(file)
        n_whole = recover(tmp_path / name, tmp_path / f"{name}_whole").whole.message_count
        at = len(file) // 3
        (tmp_path / name / "whole.mcap").write_bytes(
            file[:at] + random.Random(3).randbytes(1000) + file[at + 1000 :]
        )
        recovered = recover(tmp_path / name, tmp_path / f"{name}_out")
        assert 0.7 * n_whole < recovered.whole.message_count < n_whole
        assert 1000 <= recovered.lost_bytes < 3000
        [damage] = recovered.parts[0].damages
        assert damage.after_ns is not None
        assert damage.before_ns is not None
        found = in_mcap(tmp_path / f"{name}_out" / f"{name}_out_0.mcap")
        times = {log_time for _, _, log_time, *_ in found}
        assert all(data == text(f"message {log_time - 1000}") for _, _, log_time, _, data in found)
        assert not times & set(range(damage.after_ns + 1, damage.before_ns))
        assert n_whole - len(times) == damage.before_ns - damage.after_ns - 1


def test_topics_of_a_lost_first_chunk_come_from_the_end(tmp_path: Path) -> None:
    file = bytearray(mcap_file(compression=CompressionType.NONE, chunked=True, n=30))
    (start, end, chunk), *_ = chunks(bytes(file))
    file[end - 5] ^= 1
    (tmp_path / "one.mcap").write_bytes(file)
    recovered = recover(tmp_path / "one.mcap", tmp_path / "out")
    assert recovered.parts[0].lost_messages == len(messages_in(chunk))
    assert recovered.whole.message_count == 30 - len(messages_in(chunk))
    assert recovered.whole.topics["/a"]["type"] == STRING
    assert f"{end - start:,} bytes at byte {start}, before" in "\n".join(report(recovered))


def test_a_killed_recorder(tmp_path: Path) -> None:
    """A real kill: a whole bag beside what it left, which stays as it is."""
    written = killed_writer(tmp_path / "bag", n=1500)
    before = content(tmp_path / "bag")
    recovered = recover(tmp_path / "bag", tmp_path / "out")
    assert content(tmp_path / "bag") == before
    n = recovered.whole.message_count
    assert (written - n) * 500 <= part_writer.CHUNK_BYTES
    assert [int(data[:9]) for *_, data in in_bag(tmp_path / "out")] == list(range(n))
    assert information(tmp_path / "out")["message_count"] == n
    assert information(tmp_path / "out")["custom_data"]["seed"] == "3"
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "out"}


def test_parts_qos_and_records_are_kept(tmp_path: Path) -> None:
    """A folder of a whole part, an empty one, one that is none, and a torn one."""
    kinds = {"compression": CompressionType.LZ4, "chunked": True}
    files = [mcap_file(n=5, **kinds), b"", b"SQLite format 3", mcap_file(n=30, finished=False, **kinds)[:-7]]
    recovered = recover(folder_of(tmp_path / "bag", files), tmp_path / "out")
    lines = report(recovered)
    assert lines[2] == "bag_1.mcap: nothing was recovered: an empty file"
    assert lines[3].startswith("bag_2.mcap: nothing was recovered: no MCAP file: it is SQLite storage")
    info = information(tmp_path / "out")
    assert info["relative_file_paths"] == ["out_0.mcap", "out_1.mcap"]
    assert info["custom_data"] == {"seed": "3", "lost_bytes": str(recovered.lost_bytes)}
    rows = {row["topic_metadata"]["name"]: row for row in info["topics_with_message_count"]}
    assert set(rows) == {"/a", "/b", "/silent"}
    assert rows["/a"]["topic_metadata"]["offered_qos_profiles"][0]["depth"] == 7
    assert rows["/a"]["topic_metadata"]["type_description_hash"] == HASH
    assert len(in_bag(tmp_path / "out")) == recovered.whole.message_count > 25
    with (tmp_path / "out" / "out_0.mcap").open("rb") as file:
        assert [r.metadata for r in make_reader(file).iter_metadata() if r.name == "other"] == [{"k": "v"}]


@pytest.mark.parametrize(
    ("left", "expected"),
    [
        (b"", "an empty file"),
        (b"\x89MCAP0\r\n", "8 bytes without a topic"),
        (b"SQLite format 3\0", "no MCAP file: it is SQLite storage"),
        (bytes(5000), "no MCAP file"),
        (b"\x89MCAP0\r\n" + random.Random(0).randbytes(100_000), "100008 bytes without a topic"),
    ],
)
def test_where_nothing_can_be_recovered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], left: bytes, expected: str
) -> None:
    (tmp_path / "one.mcap").write_bytes(left)
    with pytest.raises(SystemExit) as stopped:
        command.main(["recover", str(tmp_path / "one.mcap"), "--out", str(tmp_path / "out")])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert f"nothing can be recovered from {tmp_path / 'one.mcap'}: one.mcap: {expected}" in error
    assert error.count("\n") == 1
    assert content(tmp_path) == {"one.mcap": left}


def test_nothing_is_overwritten_and_mistakes_are_one_line(tmp_path: Path) -> None:
    bag = folder_of(tmp_path / "bag", [mcap_file(compression=CompressionType.ZSTD, chunked=True, n=5)])
    before = content(bag)
    with pytest.raises(BagError, match="exists already; expected a new one"):
        recover(bag, bag)
    with pytest.raises(BagError, match="no such folder or file"):
        recover(tmp_path / "none", tmp_path / "out")
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot be written: Not a directory"):
        recover(bag, tmp_path / "file" / "out")
    assert content(bag) == before
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "file"}


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path) -> None:
    killed_writer(tmp_path / "bag", n=3000)
    limited = subprocess.run(
        [sys.executable, "-c", "import resource, sys\n"
         "resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))\n"
         "from uav_dc_ros.bag import main; main(sys.argv[1:])",
         "recover", str(tmp_path / "bag"), "--out", str(tmp_path / "out")],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert limited.returncode == 2
    assert limited.stderr == (
        f"python -m uav_dc_ros.bag recover: bag folder {tmp_path / 'out'} cannot be written: File too large\n"
    )
    assert {path.name for path in tmp_path.iterdir()} == {"bag"}


@pytest.mark.long
def test_memory_stays_flat_and_garbage_does_not_hang(tmp_path: Path) -> None:
    """300 MB of messages, with 20 MB of garbage among them, under a limit of the memory."""
    path = tmp_path / "big.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2**20, compression=CompressionType.NONE)
        writer.start("ros2", "test")
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        channel = writer.register_channel("/big", "cdr", schema, {})
        data = text(random.Random(0).randbytes(50_000).hex())
        for i in range(3000):
            writer.add_message(channel, i, data, i, i)
        writer.finish()
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 1_000_000)
        file.seek(100_000_000)
        file.write(random.Random(1).randbytes(20_000_000))
    code = (
        "import resource, sys; from pathlib import Path\n"
        "from uav_dc_ros.bags.salvage.recover import recover\nfrom uav_dc_ros.bags.read import BagReader\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "n = recover(Path(sys.argv[1]), Path(sys.argv[2])).whole.message_count\n"
        "with BagReader(Path(sys.argv[2])) as reader: assert sum(1 for _ in reader.messages()) == n\n"
        "print(n, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path), str(tmp_path / "out")],
        cwd=ROOT, capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    n, grown_mib = map(int, done.stdout.split())
    assert 2750 < n < 2800
    assert grown_mib < 60
