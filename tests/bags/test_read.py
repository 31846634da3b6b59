"""Reading bags of any source: what is there, or one clear line; never something else."""

import contextlib
import os
import random
import signal
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from tests.support.bags import STRING, TYPES, bare, in_bag, mcap_file, text
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.errors import BagError

SECONDS_MAX = 10


def messages(path: Path, *, torn: bool = False) -> list[BagMessage]:
    """All messages of a bag; a reader that hangs is killed."""
    signal.alarm(SECONDS_MAX)
    try:
        with BagReader(path, torn=torn) as reader:
            return list(reader.messages())
    finally:
        signal.alarm(0)


def small_bag(folder: Path, n: int = 40) -> Path:
    """A whole bag of ours."""
    with BagWriter(folder, {"seed": "3"}) as bag:
        bag.add_topic("/a", STRING)
        bag.add_topic("/b", STRING)
        for i in range(n):
            bag.write(("/a", "/b")[i % 2], text(f"message {i}"), log_time_ns=100 + i, publish_time_ns=90 + i)
    return folder


def check_flips(path: Path, flips: list[tuple[int, int]]) -> tuple[int, int]:
    """Flip each of the bits alone: equal messages, or a BagError. Returns how often it was which."""
    file = path.read_bytes()
    expected = messages(path)
    assert expected
    equal = refused = 0
    line = ""
    for at, bit in flips:
        path.write_bytes(file[:at] + bytes([file[at] ^ (1 << bit)]) + file[at + 1 :])
        try:
            found = messages(path)
        except BagError as error:
            line = str(error)
            refused += 1
        else:
            assert found == expected, f"bit {bit} of byte {at}"
            equal += 1
        assert "\n" not in line
    path.write_bytes(file)
    assert messages(path) == expected
    return equal, refused


KINDS = {
    "ours": None,
    "lz4": CompressionType.LZ4,
    "uncompressed": CompressionType.NONE,
    "bare": CompressionType.ZSTD,
}


def flip_target(tmp_path: Path, kind: str) -> Path:
    """A whole file of a kind."""
    compression = KINDS[kind]
    if compression is None:
        return small_bag(tmp_path / "bag") / "bag_0.mcap"
    path = tmp_path / "one.mcap"
    path.write_bytes(mcap_file(compression=compression, chunked=True, n=30))
    return bare(path) if kind == "bare" else path


@pytest.mark.parametrize("kind", KINDS)
def test_flipped_bits_are_refused_or_change_nothing(tmp_path: Path, kind: str) -> None:
    path = flip_target(tmp_path, kind)
    chance = random.Random(kind)
    flips = [(chance.randrange(path.stat().st_size), chance.randrange(8)) for _ in range(120)]
    equal, refused = check_flips(path, flips)
    assert min(equal, refused) > 10


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_every_bit_of_a_bag_flipped(tmp_path: Path, kind: str) -> None:
    path = flip_target(tmp_path, kind)
    check_flips(path, [(at, bit) for at in range(path.stat().st_size) for bit in range(8)])


@pytest.mark.parametrize("each", [101, pytest.param(37, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_bag_is_refused_and_read_as_torn(tmp_path: Path, kind: str, each: int) -> None:
    path = flip_target(tmp_path, kind)
    file, expected = path.read_bytes(), messages(path)
    n_before = 0
    for cut in range(0, len(file), each):
        path.write_bytes(file[:cut])
        with pytest.raises(BagError, match="is empty" if cut == 0 else "has no end: its recorder was killed"):
            messages(path)
        found = messages(path, torn=True)
        assert found == expected[: len(found)]
        assert len(found) >= n_before
        n_before = len(found)


def test_a_bit_flipped_in_sqlite_is_no_traceback(tmp_path: Path) -> None:
    """SQLite has no checksums: its data may be other data."""
    bag = by_rosbags(tmp_path / "bag", StoragePlugin.SQLITE3)
    [path] = bag.glob("*.db3")
    file = path.read_bytes()
    chance = random.Random(0)
    for _ in range(100):
        at = chance.randrange(len(file))
        path.write_bytes(file[:at] + bytes([file[at] ^ (1 << chance.randrange(8))]) + file[at + 1 :])
        with contextlib.suppress(BagError):
            messages(bag)


def by_rosbags(folder: Path, plugin: StoragePlugin, n: int = 40) -> Path:
    """A bag that rosbags wrote."""
    with RosbagsWriter(folder, version=9, storage_plugin=plugin) as writer:
        connections = [writer.add_connection(topic, STRING, typestore=TYPES) for topic in ("/a", "/b")]
        for i in range(n):
            writer.write(connections[i % 2], 100 + i, text(f"message {i}"))
    return folder


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_what_rosbags_writes_is_read_message_for_message(tmp_path: Path, plugin: StoragePlugin) -> None:
    bag = by_rosbags(tmp_path / "bag", plugin)
    found = messages(bag)
    assert [(m.topic, m.type, m.data, m.log_time_ns) for m in found] == [
        (("/a", "/b")[i % 2], STRING, text(f"message {i}"), 100 + i) for i in range(40)
    ]
    with BagReader(bag) as reader:
        assert {topic.name: topic.count for topic in reader.topics.values()} == {"/a": 20, "/b": 20}
        assert (reader.first_ns, reader.last_ns) == (100, 139)
        assert len(list(reader.messages(["/a"], start_ns=110, end_ns=120))) == 5


@pytest.mark.parametrize(
    "metadata", [None, "", "[}", "rosbag2_bagfile_information: 3", "\0\xff", "a: " * 9000]
)
def test_a_folder_without_metadata_or_with_rubbish_is_read(tmp_path: Path, metadata: str | None) -> None:
    bag = small_bag(tmp_path / "bag")
    expected = messages(bag)
    (bag / "metadata.yaml").unlink()
    if metadata is not None:
        (bag / "metadata.yaml").write_text(metadata, "latin-1")
    assert messages(bag) == expected


def test_messages_come_in_the_order_of_time_also_without_an_index(tmp_path: Path) -> None:
    """Whole and torn, with chunks that overlap and without any."""
    chance = random.Random(0)
    times = [1000 + 10 * i + chance.randrange(300) for i in range(500)]
    for chunked in (True, False):
        path = tmp_path / f"{chunked}.mcap"
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=500, use_chunking=chunked)
            writer.start("ros2", "test")
            channel = writer.register_channel("/a", "cdr", writer.register_schema(STRING, "ros2msg", b""))
            for i, time_ns in enumerate(times):
                writer.add_message(channel, time_ns, text(f"{i}"), time_ns)
            writer.finish()
        assert [m.log_time_ns for m in messages(path)] == sorted(times)
        assert messages(path, torn=True) == messages(path)
        path.write_bytes(path.read_bytes()[:-300])
        found = messages(path, torn=True)
        assert len(found) > 480
        assert [m.log_time_ns for m in found] == sorted(m.log_time_ns for m in found)


def test_each_bad_bag_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "nothing").mkdir()
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "text.mcap").write_text("hello, world")
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / "packed_0.mcap.zstd").write_bytes(b"")
    (tmp_path / "sql").mkdir()
    (tmp_path / "sql" / "sql_0.db3").write_bytes(b"SQLite format 3\0")
    (tmp_path / "odd.mcap").write_bytes(
        mcap_file(compression=CompressionType.ZSTD, chunked=True, n=9).replace(
            b"\4\0\0\0zstd", b"\4\0\0\0fast"
        )
    )
    for path, expected in {
        "none": "no such folder or file",
        "nothing": "holds no MCAP file; expected at least one",
        "empty.mcap": "is empty; expected an MCAP file",
        "text.mcap": "starts with b'hello, w'; expected",
        "packed": "holds packed_0.mcap.zstd, which is compressed as a whole; expected its files unpacked",
        "sql": "sql_0.db3 is damaged: ",
        "odd.mcap": "has no end",  # its summary's CRC does not hold any more
    }.items():
        with pytest.raises(BagError, match=expected) as raised:
            messages(tmp_path / path)
        assert "\n" not in str(raised.value)
        assert str(tmp_path / path) in str(raised.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    bag = small_bag(tmp_path / "bag")
    (bag / "bag_0.mcap").chmod(0)
    with pytest.raises(BagError, match="cannot be read: Permission denied"):
        messages(bag)


def test_a_foreign_bag_without_our_topics_is_read(tmp_path: Path) -> None:
    """No ROS at all: JSON, a schema of its own, no QoS, and a channel without a schema."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "other")
        schema = writer.register_schema("Thing", "jsonschema", b'{"type": "object"}')
        channels = [writer.register_channel("things", "json", schema), writer.register_channel("raw", "", 0)]
        for i, channel in enumerate(channels):
            writer.add_message(channel, 10 + i, b"{}", 5 + i)
        writer.finish()
    assert messages(path) == [
        BagMessage("things", "Thing", b"{}", 10, 5),
        BagMessage("raw", "", b"{}", 11, 6),
    ]


def test_what_we_write_is_read_by_rosbags(tmp_path: Path) -> None:
    bag = small_bag(tmp_path / "bag")
    assert in_bag(bag) == [(m.topic, m.log_time_ns, m.data[8:-1].decode()) for m in messages(bag)]
