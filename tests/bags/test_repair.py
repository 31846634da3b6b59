"""Repair: the files of a killed writer become a whole bag, at whatever byte its file ends."""

import contextlib
import io
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from ruamel.yaml import YAML

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
from uav_dc_ros.bags import part_writer
from uav_dc_ros.bags.part_writer import CHUNK_BYTES
from uav_dc_ros.bags.salvage import repair as salvage_repair
from uav_dc_ros.bags.salvage.repair import repair
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.errors import BagError

KINDS = {
    "zstd": (CompressionType.ZSTD, True),
    "lz4": (CompressionType.LZ4, True),
    "uncompressed": (CompressionType.NONE, True),
    "without chunks": (CompressionType.NONE, False),
}


def made(kind: str, *, n: int = 30, finished: bool = True, qos: str = QOS) -> bytes:
    """An MCAP file of one of the kinds."""
    compression, chunked = KINDS[kind]
    return mcap_file(compression=compression, chunked=chunked, n=n, finished=finished, qos=qos)


def folder_of(folder: Path, *files: bytes) -> Path:
    """A bag folder without metadata.yaml."""
    folder.mkdir()
    for i, file in enumerate(files):
        (folder / f"{folder.name}_{i}.mcap").write_bytes(file)
    return folder


def ends_of_messages(file: bytes) -> list[int]:
    """Where the last byte lies that each message of a whole file needs.

    By mcap's summary: the end of its chunk, or of its own record where that lies open to see.
    """
    reader = make_reader(io.BytesIO(file))
    summary = reader.get_summary()
    assert summary is not None
    ends = []
    for _, _, message in reader.iter_messages(log_time_order=False):
        compressed = [
            index.chunk_start_offset + index.chunk_length
            for index in summary.chunk_indexes
            if index.compression and index.message_start_time <= message.log_time <= index.message_end_time
        ]
        ends.append(compressed[0] if compressed else file.index(message.data) + len(message.data))
    return ends


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """For thousands of files at once: no disk that keeps them; JSON, which is YAML too, inside of them."""
    monkeypatch.setattr(os, "fsync", lambda _: None)
    monkeypatch.setattr(part_writer, "to_yaml", json.dumps)


@pytest.fixture
def in_memory() -> Iterator[Path]:
    """A folder for thousands of files, in memory where the system has such a place."""
    place = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=place if place.is_dir() else None) as folder:
        yield Path(folder)


@pytest.mark.parametrize("each", [11, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", ["zstd", "uncompressed", "without chunks"])
def test_a_file_cut_at_any_byte_keeps_all_that_is_there_in_full(
    in_memory: Path, quick: None, kind: str, each: int
) -> None:
    """All cuts of a file, or some, are the parts of one bag, repaired in one go; each is then read."""
    tmp_path = in_memory
    file = made(kind, n=12, qos="")  # short
    (tmp_path / "whole.mcap").write_bytes(file)
    messages = in_mcap(tmp_path / "whole.mcap")
    ends = ends_of_messages(file)
    assert len(messages) == 12
    assert len(set(ends)) >= 4  # several chunks, or messages that lie open to see
    cuts = [*range(0, len(file), each), len(file)]
    bag = folder_of(tmp_path / "bag", *(file[:cut] for cut in cuts))
    repaired = repair(bag)
    names = [part.name for part in repaired.parts]
    assert len(names) == len(cuts)
    assert repaired.rewritten == names[:-1]  # all but the last, which is not cut
    total = 0
    for cut, name in zip(cuts, names, strict=True):
        expected = messages[: sum(end <= cut for end in ends)]
        assert in_mcap(bag / name) == expected, f"cut at {cut} of {len(file)}"
        total += len(expected)
    assert repaired.whole.message_count == total == information(bag)["message_count"]
    assert (bag / names[-1]).read_bytes() == file


@pytest.mark.parametrize("cut", [None, -40])
@pytest.mark.parametrize("kind", KINDS)
def test_a_repaired_part_has_the_records_of_the_torn_one(tmp_path: Path, kind: str, cut: int | None) -> None:
    """Schemas, channels with their metadata, and metadata records; once, though a summary repeats them."""
    bag = folder_of(tmp_path / "bag", made(kind, finished=cut is not None)[:cut])
    repair(bag)
    with (bag / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        records = {record.name: record.metadata for record in reader.iter_metadata()}
        summary = reader.get_summary()
    assert summary is not None
    assert records.pop("rosbag2").keys() == {"serialized_metadata"}
    assert records == {"uav_dc_ros": {"seed": "3"}, "other": {"k": "v"}}
    assert [(s.name, s.encoding, s.data) for s in summary.schemas.values()] == [
        (STRING, "ros2msg", b"string data")
    ]
    assert [c.topic for c in summary.channels.values()] == ["/a", "/b", "/silent"]
    assert {c.metadata["topic_type_hash"] for c in summary.channels.values()} == {HASH}
    assert {"depth: 7" in c.metadata["offered_qos_profiles"] for c in summary.channels.values()} == {True}


def test_a_repaired_part_records_its_counts_once(tmp_path: Path) -> None:
    """Killed at the very end, a part has rosbag2's record of itself already; the copy has its own."""
    with BagWriter(tmp_path / "bag", {}) as writer:
        writer.add_topic("/a", STRING)
        writer.write("/a", text("x"), log_time_ns=1, publish_time_ns=1)
    torn = folder_of(tmp_path / "torn", content(tmp_path / "bag")["bag_0.mcap"][:-1])
    repair(torn)
    with (torn / "torn_0.mcap").open("rb") as file:
        records = [record for record in make_reader(file).iter_metadata() if record.name == "rosbag2"]
    [info] = [YAML(typ="safe").load(record.metadata["serialized_metadata"]) for record in records]
    assert (info["relative_file_paths"], info["message_count"]) == (["torn_0.mcap"], 1)


def test_metadata_yaml_of_a_repaired_bag(tmp_path: Path) -> None:
    bag = folder_of(tmp_path / "bag", made("without chunks", finished=False), made("zstd", n=4))
    repaired = repair(bag)
    info = information(bag)
    topics = {
        row["topic_metadata"]["name"]: (row["topic_metadata"], row["message_count"])
        for row in info["topics_with_message_count"]
    }
    assert {name: count for name, (_, count) in topics.items()} == {"/a": 17, "/b": 17, "/silent": 0}
    assert topics["/a"][0]["offered_qos_profiles"][0]["depth"] == 7
    assert topics["/a"][0]["type_description_hash"] == HASH
    assert info["custom_data"] == {"seed": "3"}
    assert info["relative_file_paths"] == ["bag_0.mcap", "bag_1.mcap"]
    assert [(f["path"], f["message_count"]) for f in info["files"]] == [("bag_0.mcap", 30), ("bag_1.mcap", 4)]
    assert [f["duration"]["nanoseconds"] for f in info["files"]] == [29, 3]
    assert (info["starting_time"]["nanoseconds_since_epoch"], info["duration"]["nanoseconds"]) == (1000, 29)
    assert [part.name for part in repaired.parts] == ["bag_0.mcap", "bag_1.mcap"]
    assert repaired.whole.counts == {"/a": 17, "/b": 17, "/silent": 0}
    assert repaired.whole.published_ns == {"/a": 928, "/b": 929}
    assert str(repaired) == "repaired bag_0.mcap: 34 messages, 0 bytes lost"
    assert len(in_bag(bag)) == 34


def test_a_writer_that_was_killed(tmp_path: Path) -> None:
    """Nothing is lost but the chunk that was being filled."""
    bag = tmp_path / "bag"
    written = killed_writer(bag, n=1500)
    torn = 0  # messages that mcap sees in the torn file
    with (bag / "bag_0.mcap").open("rb") as file, contextlib.suppress(Exception):
        for record in StreamReader(file).records:
            torn += isinstance(record, Message)
    repaired = repair(bag)
    assert repaired.rewritten == ["bag_0.mcap"]
    n = repaired.whole.message_count
    assert n >= torn > 0
    assert (written - n) * 500 <= CHUNK_BYTES
    expected = [text(f"{i:09d}" + 500 * "x") for i in range(n)]
    assert [data for *_, data in in_mcap(bag / "bag_0.mcap")] == expected
    assert [int(data[:9]) for _, _, data in in_bag(bag)] == list(range(n))
    assert repaired.whole.published_ns == {"/a": (n - 1) // 2 * 2, "/b": n // 2 * 2 - 1}


def test_repairing_twice_changes_nothing(tmp_path: Path) -> None:
    bag = folder_of(tmp_path / "bag", made("zstd")[:-200], made("zstd"))
    first = repair(bag)
    before = content(bag)
    stamps = {path: path.stat().st_mtime_ns for path in bag.iterdir()}
    second = repair(bag)
    assert content(bag) == before
    assert {path: path.stat().st_mtime_ns for path in bag.iterdir()} == stamps
    assert (first.rewritten, second.rewritten) == (["bag_0.mcap"], [])
    assert (first.lost_bytes > 0, second.lost_bytes) == (True, 0)
    assert first.whole.counts == second.whole.counts


def test_a_closed_bag_is_left_alone(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag, {"k": "v"}) as writer:
        writer.add_topic("/a", STRING)
        writer.write("/a", text("x"), log_time_ns=1, publish_time_ns=1)
    before = content(bag)
    assert repair(bag).rewritten == []
    assert content(bag) == before


@pytest.mark.parametrize("wrong", ["", "[}", "nothing: here", "rosbag2_bagfile_information: 3"])
def test_a_wrong_metadata_yaml_is_written_anew(tmp_path: Path, wrong: str) -> None:
    bag = folder_of(tmp_path / "bag", made("zstd"))
    (bag / "metadata.yaml").write_text(wrong)
    assert repair(bag).rewritten == []
    assert len(in_bag(bag)) == 30


def test_parts_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    bag = folder_of(tmp_path / "bag", *(made("zstd", n=1) for _ in range(11)))
    assert [part.name for part in repair(bag).parts] == [f"bag_{i}.mcap" for i in range(11)]
    assert information(bag)["relative_file_paths"][-2:] == ["bag_9.mcap", "bag_10.mcap"]


def test_hidden_files_are_no_parts(tmp_path: Path) -> None:
    """Such as those that a Mac leaves on a stick."""
    bag = folder_of(tmp_path / "bag", made("zstd"))
    (bag / "._bag_0.mcap").write_bytes(b"Mac OS X")
    assert [part.name for part in repair(bag).parts] == ["bag_0.mcap"]
    assert (bag / "._bag_0.mcap").exists()


def test_the_rest_of_an_export_into_the_bag_s_folder_does_not_prevent_a_repair(tmp_path: Path) -> None:
    """Killed, it leaves a folder with the suffix of a repair's file."""
    bag = folder_of(tmp_path / "bag", made("zstd", finished=False))
    (bag / ".tables.123.partial").mkdir()
    assert repair(bag).rewritten
    assert (bag / ".tables.123.partial").is_dir()


@pytest.mark.parametrize("left", [b"", b"\x89MCA", b"\x89MCAP0\r\n"])
def test_a_part_without_anything_becomes_an_empty_part(tmp_path: Path, left: bytes) -> None:
    bag = folder_of(tmp_path / "bag", left)
    assert repair(bag).whole.counts == {}
    assert (in_mcap(bag / "bag_0.mcap"), in_bag(bag)) == ([], [])
    two = folder_of(tmp_path / "two", made("zstd"), left)
    repair(two)
    assert [file["message_count"] for file in information(two)["files"]] == [30, 0]
    assert len(in_bag(two)) == 30


def test_zeros_that_a_power_cut_left_are_no_records(tmp_path: Path) -> None:
    file = made("zstd", finished=False)
    bag = folder_of(tmp_path / "bag", file + bytes(4096))
    repaired = repair(bag)
    assert repaired.lost_bytes == 4096
    assert repaired.whole.message_count == len(in_mcap(bag / "bag_0.mcap")) > 20


def test_a_damaged_chunk_costs_itself_alone(tmp_path: Path) -> None:
    """In a torn file, after a power cut; the first chunk holds the channels, so it is the second."""
    file = bytearray(made("uncompressed", finished=False))
    at = file.index(text("message 9"))
    file[at + 8] ^= 1
    bag = folder_of(tmp_path / "bag", bytes(file))
    repair(bag)
    kept = {log_time for _, _, log_time, *_ in in_mcap(bag / "bag_0.mcap")}
    lost = set(range(1000, max(kept))) - kept
    assert 1009 in lost
    assert len(lost) < 8
    assert max(kept) > max(lost)


def test_damage_in_a_part_that_has_its_end_is_no_torn_end(tmp_path: Path) -> None:
    file = bytearray(made("uncompressed"))
    file[file.index(text("message 9")) + 8] ^= 1
    bag = folder_of(tmp_path / "bag", bytes(file))
    with pytest.raises(BagError, match=r"bag_0.mcap has its end, but \d+ bytes before it are damaged"):
        repair(bag)
    assert content(bag) == {"bag_0.mcap": bytes(file)}


def test_a_summary_that_was_harmed_is_made_anew(tmp_path: Path) -> None:
    file = bytearray(made("zstd"))
    file[-60] ^= 1
    bag = folder_of(tmp_path / "bag", bytes(file))
    assert repair(bag).rewritten == ["bag_0.mcap"]
    assert len(in_mcap(bag / "bag_0.mcap")) == 30


def test_mistakes_are_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="No such file or directory; expected the folder of a bag"):
        repair(tmp_path / "none")
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="Not a directory; expected the folder of a bag"):
        repair(tmp_path / "file")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match="holds no MCAP file; expected at least one"):
        repair(tmp_path / "empty")


@pytest.mark.parametrize("other", [b"SQLite format 3\0", b"PNG", bytes(100)])
def test_a_file_that_is_no_mcap_file_is_refused_and_kept(tmp_path: Path, other: bytes) -> None:
    bag = folder_of(tmp_path / "bag", made("zstd"), other)
    before = content(bag)
    with pytest.raises(BagError, match=r"bag_1.mcap starts with b.*; expected b'.x89MCAP"):
        repair(bag)
    assert content(bag) == before


def test_a_compression_that_cannot_be_read_loses_no_message(tmp_path: Path) -> None:
    file = made("zstd", finished=False).replace(b"\x04\0\0\0zstd", b"\x04\0\0\0fast")
    file = file.replace(b"\x28\xb5\x2f\xfd", b"fast")  # zstd's magic: else its CRC shows that it is zstd
    bag = folder_of(tmp_path / "bag", file)
    with pytest.raises(BagError, match="unsupported compression type fast"):
        repair(bag)
    assert content(bag) == {"bag_0.mcap": file}


def test_a_bag_that_is_being_written_is_not_repaired(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", {}) as writer:
        with pytest.raises(BagError, match="is being written or repaired"):
            repair(tmp_path / "bag")
        writer.add_topic("/a", STRING)
        writer.write("/a", text("still here"), log_time_ns=1, publish_time_ns=1)
    repair(tmp_path / "bag")
    assert in_bag(tmp_path / "bag") == [("/a", 1, "still here")]


def test_a_full_disk_costs_nothing(tmp_path: Path) -> None:
    """A limit on the size of files stands in for the disk, in a process of its own."""
    bag = tmp_path / "bag"
    killed_writer(bag, n=3000)
    before = content(bag)
    size = len(before["bag_0.mcap"])
    repaired = subprocess.run(
        [sys.executable, "-c", "import sys\nfrom pathlib import Path\n"
         "from uav_dc_ros.bags.salvage.repair import repair\n"
         "from uav_dc_ros.errors import BagError\n"
         "try: repair(Path(sys.argv[1]))\nexcept BagError as error: print(error)", str(bag)],
        cwd=ROOT, capture_output=True, text=True, check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, size // 2)),
    )  # fmt: skip
    assert repaired.stdout == f"bag {bag} cannot be repaired: File too large; its contents are kept\n"
    assert content(bag) == before
    assert repair(bag).rewritten == ["bag_0.mcap"]


@pytest.mark.parametrize("step", ["finish", "add_message", "fsync"])
def test_a_killed_repair_can_be_repeated(tmp_path: Path, step: str) -> None:
    """Killed while it copies, before it finishes, and before the copy is on the disk."""
    file = made("zstd")[:-100]
    bag = folder_of(tmp_path / "bag", file, file)
    where = "os" if step == "fsync" else "PartWriter"
    killed = subprocess.run(
        [sys.executable, "-c", "import os, signal, sys; from pathlib import Path\n"
         "from uav_dc_ros.bags.salvage.repair import PartWriter, repair\n"
         f"{where}.{step} = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)\n"
         "repair(Path(sys.argv[1]))", str(bag)],
        cwd=ROOT, check=False,
    )  # fmt: skip
    assert killed.returncode == -signal.SIGKILL
    left, *whole = sorted(path.name for path in bag.iterdir())
    assert whole == ["bag_0.mcap", "bag_1.mcap"]
    assert left.startswith(".bag_0.mcap.")
    assert left.endswith(".partial")
    (bag / ".metadata.yaml.123.partial").write_text("rosbag2_")  # killed at the very end
    assert repair(bag).rewritten == ["bag_0.mcap", "bag_1.mcap"]
    assert {path.name for path in bag.iterdir()} == {"bag_0.mcap", "bag_1.mcap", "metadata.yaml"}
    assert len(in_bag(bag)) == 60


def test_memory_does_not_grow_with_the_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = tmp_path / "bag"
    writer = BagWriter(bag, {})
    writer.add_topic("/a", STRING)
    for i in range(1000):
        writer.write("/a", os.urandom(15_000), log_time_ns=i, publish_time_ns=i)
    torn = content(bag)["bag_0.mcap"][:-1000]
    writer.close()
    again = folder_of(tmp_path / "again", torn)
    monkeypatch.setattr(salvage_repair, "write_metadata", lambda *_: None)
    tracemalloc.start()
    try:
        repair(again)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < len(torn) / 4
