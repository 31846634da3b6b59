"""Bags of other writers: what MCAP, SQLite storage and rosbag2 leave to the writer changes nothing."""

import contextlib
import os
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.writer import IndexType, Writer
from rosbags.rosbag2 import StoragePlugin

from tests.bags.test_read import by_rosbags, messages
from tests.support.bags import QOS, STRING, bare, in_bag, text
from uav_dc_ros import bag as command
from uav_dc_ros.bags import mcap_storage, message_definitions
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.salvage.recover import recover, report
from uav_dc_ros.errors import BagDamagedError, BagError
from uav_dc_ros.recordings.info.survey import survey

N = 60
ABOUT = {"seed": "3", "policy": "p"}


def written(path: Path, *, about: bool = True, **options: Any) -> Path:
    """An MCAP file with numbered messages on two topics, in small chunks."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=500, **options)
        writer.start("ros2", "field")
        if about:
            writer.add_metadata("uav_dc_ros", ABOUT)
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        topics = [
            writer.register_channel(name, "cdr", schema, {"offered_qos_profiles": QOS})
            for name in ("/a", "/b")
        ]
        for i in range(N):
            writer.add_message(topics[i % 2], 1000 + i, text(f"message {i}"), 900 + i, i + 1)
        writer.finish()
    return path


Row = tuple[str, bytes, int, str]  # topic, data, time, type


def rows(path: Path, *messages: Row) -> Path:
    """An MCAP file with some messages."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "field")
        channels: dict[tuple[str, str], int] = {}
        for n, (topic, data, time_ns, type) in enumerate(messages):
            if (topic, type) not in channels:
                schema = writer.register_schema(type, "ros2msg", b"string data" if type == STRING else b"")
                channels[topic, type] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic, type], time_ns, data, time_ns, n + 1)
        writer.finish()
    return path


OPTIONAL: dict[str, dict[str, Any]] = {
    "statistics": {"use_statistics": False},
    "channels and schemas": {"repeat_channels": False, "repeat_schemas": False},
    "schemas": {"repeat_schemas": False},
    "index of chunks": {"index_types": IndexType.ALL & ~IndexType.CHUNK},
    "index of messages": {"index_types": IndexType.ALL & ~IndexType.MESSAGE},
    "index of metadata": {"index_types": IndexType.ALL & ~IndexType.METADATA},
    "any index": {"index_types": IndexType.NONE},
    "chunks": {"use_chunking": False},
    "checksums": {"enable_crcs": False},
}


@pytest.mark.parametrize("lacks", [*OPTIONAL, "summary", "summary, chunks"])
def test_what_mcap_leaves_to_the_writer_changes_nothing(tmp_path: Path, lacks: str) -> None:
    whole = written(tmp_path / "whole.mcap")
    path = written(tmp_path / "one.mcap", **OPTIONAL.get(lacks.removeprefix("summary, "), {}))
    if lacks.startswith("summary"):
        bare(path)
    assert messages(path) == messages(whole)
    with BagReader(path) as reader, BagReader(whole) as expected:
        assert reader.about == ABOUT
        assert reader.topics == expected.topics
        assert (reader.first_ns, reader.last_ns) == (1000, 1000 + N - 1)
        assert len(list(reader.messages(["/a"], start_ns=1010, end_ns=1020))) == 5
        assert [message for _, message in reader.received(["/b"])] == list(expected.messages(["/b"]))
        assert reader.set_back_ns == 0
    assert not recover(path, tmp_path / "out").lost_bytes
    # Cut or damaged it is neither whole nor of another content.
    file = path.read_bytes()
    path.write_bytes(file[:-30])
    with pytest.raises(BagDamagedError):
        messages(path)
    if lacks not in ("chunks", "summary, chunks", "checksums"):  # nothing else shows the damage
        at = file.index(b"\4\0\0\0zstd") + 60
        path.write_bytes(file[:at] + bytes([file[at] ^ 1]) + file[at + 1 :])
        with pytest.raises(BagDamagedError):
            messages(path)


def test_a_wrong_count_of_messages_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "one.mcap", enable_crcs=False)
    file = path.read_bytes()
    counted = struct.pack("<HQHQ", 1, N // 2, 2, N // 2)
    path.write_bytes(file.replace(counted, struct.pack("<HQHQ", 1, N // 2, 2, 7)))
    assert "/b has 30 messages; its index lists 7" in run(capsys, "info", path)


def run(capsys: pytest.CaptureFixture[str], *arguments: object, status: int = 0) -> str:
    """What a verb prints; its errors come after it."""
    with pytest.raises(SystemExit) as stopped:
        command.main([str(one) for one in arguments])
    printed = capsys.readouterr()
    assert stopped.value.code == status, printed.err
    return printed.out + printed.err


def by_message(path: Path, damaged: int = -1) -> Path:
    """As of rosbag2's `--compression-mode message`: each payload is a zstd frame; one may be damaged."""
    pack = zstandard.ZstdCompressor().compress
    if path.suffix == ".mcap":
        packed = [(m.topic, pack(m.data), m.log_time_ns, m.type) for m in messages(written(path))]
        if damaged >= 0:
            packed[damaged] = (packed[damaged][0], packed[damaged][1][:9], *packed[damaged][2:])
        return rows(path, *packed)
    bag = by_rosbags(path, StoragePlugin.SQLITE3)
    (storage,) = bag.glob("*.db3")
    with contextlib.closing(sqlite3.connect(storage)) as database:
        for number, data in database.execute("SELECT id, data FROM messages").fetchall():
            database.execute("UPDATE messages SET data = ? WHERE id = ?", (pack(data), number))
        database.commit()
    return bag


@pytest.mark.parametrize("name", ["one.mcap", "sqlite"])
def test_messages_that_are_compressed_one_by_one_are_read_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path = by_message(tmp_path / name)
    assert [m.data for m in messages(path)] == [text(f"message {i}") for i in range(len(messages(path)))]
    assert "message by message, on 2 topics (zstd)" in run(capsys, "info", path)
    if path.is_file():
        assert messages(path) == messages(path, torn=True)
        recover(path, tmp_path / "out")
        assert in_bag(tmp_path / "out")[3] == ("/b", 1003, "message 3"), "plain, for readers of metadata.yaml"


def test_recover_reports_payloads_that_cannot_be_decoded(tmp_path: Path) -> None:
    path = by_message(tmp_path / "one.mcap", damaged=5)
    lines = report(recover(path, tmp_path / "out"))
    assert (
        "  1 messages of /b cannot be read: encapsulation: a zstd frame that is damaged; "
        "expected CDR (0x0000 or 0x0001)" in lines
    )
    for data, expected in {
        b"\0\7\0\0\1\0\0\0\0": "encapsulation: XCDR2 (0x0007); expected CDR",
        b"\0\3\0\0": "encapsulation: parameter list (0x0003)",
        b"\x7b\x7d\0\0": "encapsulation: 0x7b7d",
        b"\0\1": "malformed: 2 bytes; expected a message with its encapsulation",
        text("hello")[:-2]: "malformed: 4 bytes of text; expected 6, its length field",
    }.items():
        path = rows(tmp_path / f"{expected[:25]}.mcap", *(("/a", data, i, STRING) for i in range(3)))
        lines = report(recover(path, tmp_path / f"out {path.stem}"))
        assert any(f"3 messages of /a cannot be read: {expected}" in line for line in lines), lines


def test_sqlite_storage_needs_no_metadata(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = by_rosbags(tmp_path / "bag", StoragePlugin.SQLITE3)
    expected = messages(bag)
    (storage,) = bag.glob("*.db3")
    assert messages(storage) == expected
    assert "complete" in run(capsys, "info", bag).splitlines()[0]
    metadata = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(metadata.replace("message_count: 20", "message_count: 371", 1))
    assert "metadata.yaml lists other files, or other numbers of messages" in run(capsys, "info", bag)
    (bag / "metadata.yaml").unlink()
    assert messages(bag) == expected
    assert "metadata.yaml is missing" in run(capsys, "info", bag)
    assert "it is SQLite storage, which needs no recovery" in run(
        capsys, "recover", bag, "--out", tmp_path / "out", status=2
    )
    with BagReader(bag) as reader:
        assert [message for _, message in reader.received(["/a", "/b"])] == expected


def test_what_a_killed_recorder_left_in_a_write_ahead_log_is_read(tmp_path: Path) -> None:
    bag = by_rosbags(tmp_path / "bag", StoragePlugin.SQLITE3)
    (storage,) = bag.glob("*.db3")
    with contextlib.closing(sqlite3.connect(storage)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("INSERT INTO messages VALUES (1000, 1, 500, ?)", (text("the last"),))
        database.commit()
        assert messages(bag)[-1].data == text("the last")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("UPDATE messages SET data = 3", "a message of /a has data or a time of the wrong type"),
        ("UPDATE messages SET timestamp = 'noon'", "is damaged"),
        ("DROP TABLE messages", "is damaged: no such table: messages"),
    ],
)
def test_sqlite_storage_that_holds_something_else(tmp_path: Path, change: str, expected: str) -> None:
    bag = by_rosbags(tmp_path / "bag", StoragePlugin.SQLITE3)
    (storage,) = bag.glob("*.db3")
    with contextlib.closing(sqlite3.connect(storage)) as database:
        database.execute("PRAGMA writable_schema = ON")
        database.execute(change)
        database.commit()
    with pytest.raises(BagError, match=expected) as raised:
        messages(bag)
    assert str(storage) in str(raised.value)


@pytest.mark.parametrize(
    ("beginning", "expected"),
    [
        (b"\x28\xb5\x2f\xfd", r"is compressed as a whole \(zstd\); expected it unpacked, as `zstd -d` does"),
        (b"\x1f\x8b\x08", r"is compressed as a whole \(gzip\)"),
        (b"#ROSBAG V2.0\n", "is a bag of ROS 1"),
    ],
)
def test_files_are_called_what_they_are(tmp_path: Path, beginning: bytes, expected: str) -> None:
    path = tmp_path / "bag.mcap"
    path.write_bytes(beginning + bytes(100))
    with pytest.raises(BagError, match=expected):
        messages(path)
    with pytest.raises(BagError, match=f"no MCAP file: it {expected}"):
        recover(path, tmp_path / "out")


@pytest.mark.parametrize("name", ["b_0.mcap.zstd", "b_0.db3.zst", "b_0.mcap.gz"])
def test_compressed_files_of_a_folder_are_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"")
    for refuse in (messages, lambda folder: recover(folder, tmp_path / "out")):
        with pytest.raises(BagError, match=f"holds {name}, which is compressed as a whole"):
            refuse(tmp_path)


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """Without the rights of root."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


def test_what_may_not_be_read_is_named() -> None:
    """In a folder that any user may enter; those of pytest are private."""
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        bag = by_rosbags(Path(place) / "bag", StoragePlugin.MCAP)
        (storage,) = bag.glob("*.mcap")
        for path, mode, expected in (
            (storage, 0, f"{storage} cannot be read: Permission denied"),
            (bag, 0, f"bag {bag} cannot be read: Permission denied"),
            (bag, 0o311, f"bag {bag} cannot be read: Permission denied"),  # may be entered, not listed
        ):
            before = path.stat().st_mode
            path.chmod(mode)
            with unprivileged(), pytest.raises(BagError) as raised:
                messages(bag)
            path.chmod(before)
            assert str(raised.value) == expected
        (bag / "metadata.yaml").chmod(0)
        with unprivileged():
            problems = survey(bag).problems
        assert problems == [f"{bag / 'metadata.yaml'} cannot be read: Permission denied"]


def test_a_definition_with_the_line_ends_of_windows_is_the_same() -> None:
    for type in (STRING, "geometry_msgs/msg/PoseStamped"):
        text_of_it = message_definitions.definition(type)
        assert message_definitions.matches_jazzy(type, "ros2msg", text_of_it.replace(b"\n", b"\r\n"))
    assert not message_definitions.matches_jazzy(STRING, "ros2msg", b"int8 data\r\n")


def test_mistakes_of_ours_are_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "one.mcap")

    def mistaken(*_: object) -> bytes:
        raise TypeError("a mistake")

    monkeypatch.setattr(mcap_storage, "decompress_payload", mistaken)
    with pytest.raises(TypeError, match="a mistake"):
        messages(path)


def test_a_bag_named_damaged_is_not_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Only the class of an error reports damage."""
    path = rows(
        tmp_path / "damaged.mcap",
        ("/mission", text("x"), 1, STRING),
        ("/users", text("x"), 1, "std_msgs/msg/Bool"),
    )
    printed = run(capsys, "info", path)
    assert "topic /users is of type std_msgs/msg/Bool" in printed
    assert "recover" not in printed


def test_times_beyond_those_of_ros_are_the_last_of_them(tmp_path: Path) -> None:
    path = rows(
        tmp_path / "one.mcap", *(("/a", text("x"), at_ns, STRING) for at_ns in (5, 2**63 + 7, 2**64 - 1))
    )
    for torn in (False, True):
        assert [m.log_time_ns for m in messages(path, torn=torn)] == [5, 2**63 - 1, 2**63 - 1]
    assert survey(path).problems == [
        "some message times exceed the limit of ROS 2 (2^63 ns): shown as the limit"
    ]
    assert recover(path, tmp_path / "out").whole.last_ns == 2**63 - 1
    assert [time_ns for _, time_ns, _ in in_bag(tmp_path / "out")][-1] == 2**63 - 1


def test_a_topic_of_two_types_is_read_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    for part, other in enumerate(("std_msgs/msg/Bool", "std_msgs/msg/Int8")):
        both = (("/a", text("x"), 10 * part + i, type) for i, type in enumerate((STRING, other)))
        rows(bag / f"bag_{part}.mcap", *both)
    assert [(m.log_time_ns, m.type) for m in messages(bag)] == [
        (0, STRING), (1, "std_msgs/msg/Bool"), (10, STRING), (11, "std_msgs/msg/Int8"),
    ]  # fmt: skip
    with BagReader(bag) as reader:
        assert reader.topics["/a"].other_types == ("std_msgs/msg/Bool", "std_msgs/msg/Int8")
        assert reader.topics["/a"].count == 4
    assert "String, Bool" in run(capsys, "info", bag / "bag_0.mcap")


def test_a_name_that_is_no_utf_8_is_read(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"caf\xe9_0.mcap")
    written(path)
    assert messages(path) == messages(tmp_path)
    bag = by_rosbags(tmp_path / "sql", StoragePlugin.SQLITE3)
    (storage,) = bag.glob("*.db3")
    odd = storage.rename(bag / os.fsdecode(b"caf\xe9 ?#%.db3"))
    assert len(messages(odd)) == 40


def test_parts_side_by_side_are_brought_together(tmp_path: Path) -> None:
    """Of two recorders at once; none of their clocks was set back."""
    bag = tmp_path / "bag"
    bag.mkdir()
    for part, topic in enumerate(("/a", "/b")):
        messages = ((topic, text("x"), (10 * i + part) * 10**9, STRING) for i in range(5))
        rows(bag / f"bag_{part}.mcap", *messages)
    with BagReader(bag) as reader:
        assert reader.set_back_ns == 0
        got = [(message.topic, message.log_time_ns) for _, message in reader.received(["/a", "/b"])]
        assert got == [(m.topic, m.log_time_ns) for m in reader.messages()]
        assert [topic for topic, _ in got] == 5 * ["/a", "/b"]
