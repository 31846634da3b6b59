"""The bag writer: whole rosbag2 folders that independent readers understand."""

import contextlib
from pathlib import Path

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader
from ruamel.yaml import YAML

from tests.support.bags import STRING, TYPES, text
from uav_dc_ros.bags.metadata import ABOUT_RECORD
from uav_dc_ros.bags.part_writer import CHUNK_BYTES
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.errors import BagError


def written(folder: Path, n: int = 3) -> Path:
    """A bag with two topics, one of them silent."""
    with BagWriter(folder, {"seed": "3", "note": "äöü: \n 'quoted'"}) as bag:
        bag.add_topic("/a", STRING)
        bag.add_topic("/silent", STRING)
        for i in range(n):
            bag.write("/a", text(f"message {i}"), log_time_ns=1000 + i, publish_time_ns=900 + i)
    return folder


def test_rosbags_reads_it(tmp_path: Path) -> None:
    with Reader(written(tmp_path / "bag")) as reader:
        read = [(c.topic, t, TYPES.deserialize_cdr(d, c.msgtype).data) for c, t, d in reader.messages()]
        assert read == [("/a", 1000 + i, f"message {i}") for i in range(3)]
        assert reader.topics["/silent"].msgcount == 0
        assert (reader.start_time, reader.end_time) == (1000, 1003)  # rosbags' end is exclusive


def test_mcap_reads_it(tmp_path: Path) -> None:
    folder = written(tmp_path / "bag")
    with (folder / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        read = [
            (s.name, s.encoding, c.topic, m.log_time, m.publish_time) for s, c, m in reader.iter_messages()
        ]
        assert read == [(STRING, "ros2msg", "/a", 1000 + i, 900 + i) for i in range(3)]
        about = {record.name: record.metadata for record in reader.iter_metadata()}
        assert about[ABOUT_RECORD] == {"seed": "3", "note": "äöü: \n 'quoted'"}
        summary = reader.get_summary()
        assert summary is not None
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}


def test_metadata_yaml_has_what_rosbag2_of_jazzy_writes(tmp_path: Path) -> None:
    folder = written(tmp_path / "bag")
    info = YAML(typ="safe").load(folder / "metadata.yaml")["rosbag2_bagfile_information"]
    assert list(info) == [
        "version",
        "storage_identifier",
        "duration",
        "starting_time",
        "message_count",
        "topics_with_message_count",
        "compression_format",
        "compression_mode",
        "relative_file_paths",
        "files",
        "custom_data",
        "ros_distro",
    ]
    assert (info["version"], info["storage_identifier"], info["ros_distro"]) == (9, "mcap", "jazzy")
    assert info["duration"] == {"nanoseconds": 2}
    assert info["relative_file_paths"] == ["bag_0.mcap"]
    assert info["custom_data"]["seed"] == "3"
    assert "&id" not in (folder / "metadata.yaml").read_text("utf-8")


def test_an_empty_bag_is_a_bag(tmp_path: Path) -> None:
    with Reader(written(tmp_path / "bag", n=0)) as reader:
        assert reader.message_count == 0


def test_a_bag_is_never_overwritten(tmp_path: Path) -> None:
    folder = written(tmp_path / "bag")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(BagError, match="exists already"):
        BagWriter(folder, {})
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot be made"):
        BagWriter(tmp_path / "file" / "bag", {})


def test_a_writer_that_is_killed_loses_its_last_chunk_at_most(tmp_path: Path) -> None:
    """The file as it lies on the disk while the writer still holds it open."""
    bag = BagWriter(tmp_path / "bag", {})
    bag.add_topic("/a", STRING)
    messages = [text(f"{i:04d}" + 1000 * "x") for i in range(1000)]  # chunks that compress to little
    for i, message in enumerate(messages):
        bag.write("/a", message, log_time_ns=i, publish_time_ns=i)
    read = []
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file, contextlib.suppress(EndOfFile):
        for record in StreamReader(file).records:
            if isinstance(record, Message):
                read.append(record.data)
    bag.close()
    assert read == messages[: len(read)]
    assert sum(map(len, messages[len(read) :])) <= CHUNK_BYTES


def test_what_was_written_before_a_failure_is_readable(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), BagWriter(tmp_path / "bag", {}) as bag:  # noqa: PT012
        bag.add_topic("/a", STRING)
        bag.write("/a", text("kept"), log_time_ns=1, publish_time_ns=1)
        raise RuntimeError
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 1
