"""Bags in several parts: where they are split, what parts repeat, what was dropped, what a kill takes."""

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from tests.support.bags import QOS, ROOT, STRING, in_bag, in_mcap, information, text
from uav_dc_ros.bags import COMPRESSIONS
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.salvage.repair import repair
from uav_dc_ros.bags.write import MIN_CHUNKS_PER_PART, BagWriter

S = 10**9
LIMIT = 64 * 1024


def qos(*, latched: bool) -> Qos:
    """A publisher's QoS."""
    return parse_qos(QOS.replace("volatile", "transient_local") if latched else QOS)[0]


def split_bag(folder: Path, n: int = 2000, **limits: float) -> Path:
    """A bag of incompressible messages, a hundred a second: every 500th message is on a latched topic."""
    noise = random.Random(1)
    with BagWriter(folder, {"seed": "3"}, compression="none", **limits) as bag:  # type: ignore[arg-type]
        bag.add_topic("/pose", STRING, [qos(latched=False)])
        bag.add_topic("/map", STRING, [qos(latched=True)])
        bag.add_topic("/silent", STRING, [qos(latched=True)])
        for i in range(n):
            topic = "/map" if i % 500 == 3 else "/pose"
            data = text(f"{i:09d}" + noise.randbytes(100).hex())
            bag.write(topic, data, log_time_ns=i * S // 100, publish_time_ns=i * S // 100 + 7)
    return folder


def test_parts_by_size(tmp_path: Path) -> None:
    bag = split_bag(tmp_path / "bag", split_bytes=LIMIT)
    info = information(bag)
    names = info["relative_file_paths"]
    assert len(names) > 5
    assert names == [f"bag_{n}.mcap" for n in range(len(names))]
    sizes = [(bag / name).stat().st_size for name in names]
    chunk = LIMIT // MIN_CHUNKS_PER_PART
    # A chunk that is too many has its index, and the file has its summary, too.
    assert all(LIMIT <= size < LIMIT + 4 * chunk for size in sizes[:-1]), sizes
    assert [len(in_mcap(bag / name)) for name in names] == [file["message_count"] for file in info["files"]]
    assert (
        len(in_bag(bag)) == info["message_count"] > 2000
    )  # what independent readers see: repeated ones, too


def test_parts_by_time(tmp_path: Path) -> None:
    bag = split_bag(tmp_path / "bag", split_s=4.0)
    info = information(bag)
    starts = [file["starting_time"]["nanoseconds_since_epoch"] for file in info["files"]]
    assert starts == [0, 4 * S, 8 * S, 12 * S, 16 * S]


def test_each_part_begins_with_the_latched_messages_and_the_bag_has_them_once(tmp_path: Path) -> None:
    bag = split_bag(tmp_path / "bag", split_s=4.0)
    first = in_mcap(bag / "bag_0.mcap")
    assert [sequence for topic, sequence, *_ in first if topic == "/map"] == [1]
    for n in range(1, 5):
        written = in_mcap(bag / f"bag_{n}.mcap")
        topic, sequence, log_time_ns, publish_time_ns, data = written[0]
        last = max(i for i in range(3, n * 400, 500))
        assert (topic, sequence) == ("/map", 0)
        assert data[8:17] == f"{last:09d}".encode()
        assert publish_time_ns == last * S // 100 + 7, "as it was published"
        assert log_time_ns == written[1][2] == n * 4 * S, "where the part begins"
        assert [one[1] for one in written[1:]].count(0) == 0
    with BagReader(bag) as reader:
        numbers = [int(message.data[8:17]) for message in reader.messages()]
        assert numbers == list(range(2000))
        assert (reader.message_count, reader.topics["/map"].count) == (2000, 4)
    with BagReader(bag / "bag_3.mcap") as alone:
        assert next(alone.messages()).topic == "/map"
        assert alone.topics["/map"].count == 2
    sequences = [one[1] for n in range(5) for one in in_mcap(bag / f"bag_{n}.mcap") if one[0] == "/pose"]
    assert sequences == list(range(1, 1997))


def test_a_latched_topic_of_several_publishers_repeats_one_message_of_each(tmp_path: Path) -> None:
    """As for /tf_static, where each of them publishes its own message, once."""
    with BagWriter(tmp_path / "bag", {}, split_s=1.0) as bag:
        bag.add_topic("/tf_static", STRING, [qos(latched=True)])
        bag.add_topic("/pose", STRING)
        bag.keep_latched("/tf_static", 2)
        for i, content in enumerate(("old", "a", "b")):
            bag.write("/tf_static", text(content), log_time_ns=i, publish_time_ns=i)
        bag.write("/pose", text("x"), log_time_ns=2 * S, publish_time_ns=2 * S)
    assert [data[8:9] for _, _, _, _, data in in_mcap(tmp_path / "bag" / "bag_1.mcap")] == [b"a", b"b", b"x"]


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_chunks_have_the_given_compression(tmp_path: Path, compression: str) -> None:
    with BagWriter(tmp_path / "bag", {}, compression=compression) as bag:
        bag.add_topic("/a", STRING)
        for i in range(100):
            bag.write("/a", text("x" * 1000), log_time_ns=i, publish_time_ns=i)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {index.compression for index in summary.chunk_indexes} == {compression.replace("none", "")}
    assert len(in_bag(tmp_path / "bag")) == 100


def test_each_part_records_its_dropped_messages_and_the_bag_their_sum(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    with BagWriter(folder, {}, split_s=1.0) as bag:
        for topic in ("/a", "/b"):
            bag.add_topic(topic, STRING)
        bag.set_dropped({})
        bag.write("/a", text("1"), log_time_ns=0, publish_time_ns=0)
        bag.set_dropped({"/a": 3})
        bag.write("/a", text("2"), log_time_ns=2 * S, publish_time_ns=0)
        bag.set_dropped({"/a": 5, "/b": 1})
        bag.set_dropped({"/a": 7, "/b": 1})
    assert information(folder)["custom_data"] == {"dropped": '{"/a": 7, "/b": 1}'}
    for name, dropped in (("bag_0.mcap", {"/a": 3}), ("bag_1.mcap", {"/a": 4, "/b": 1})):
        with BagReader(folder / name) as reader:
            assert reader.dropped == dropped
    with BagReader(folder) as reader:
        assert reader.dropped == {"/a": 7, "/b": 1}
    (folder / "metadata.yaml").unlink()
    repair(folder)
    assert information(folder)["custom_data"] == {"dropped": '{"/a": 7, "/b": 1}'}


def test_a_bag_without_dropped_messages_differs_from_one_without_a_count(
    tmp_path: Path,
) -> None:
    with BagWriter(tmp_path / "counted", {}) as bag:
        bag.set_dropped({})
    with BagWriter(tmp_path / "not", {}):
        pass
    assert information(tmp_path / "counted")["custom_data"] == {"dropped": "{}"}
    assert information(tmp_path / "not")["custom_data"] == {}
    with BagReader(tmp_path / "counted") as counted, BagReader(tmp_path / "not") as not_counted:
        assert (counted.dropped, not_counted.dropped) == ({}, None)


def test_a_split_part_that_is_cut_anywhere_counts_what_it_repeats(tmp_path: Path) -> None:
    whole = split_bag(tmp_path / "whole", n=500, split_s=4.0)
    last = (whole / "whole_1.mcap").read_bytes()
    for cut in random.Random(2).sample(range(8, len(last)), 40):
        folder = tmp_path / f"cut{cut}"
        folder.mkdir()
        (folder / "bag_0.mcap").write_bytes((whole / "whole_0.mcap").read_bytes())
        (folder / "bag_1.mcap").write_bytes(last[:cut])
        repair(folder)
        with BagReader(folder) as reader:
            numbers = [int(message.data[8:17]) for message in reader.messages()]
            assert numbers == list(range(len(numbers)))
            assert reader.message_count == len(numbers) >= 400


def test_a_resumed_writer_repeats_the_latched_messages_too(tmp_path: Path) -> None:
    folder = split_bag(tmp_path / "bag", n=100)
    (folder / "metadata.yaml").unlink()
    with BagWriter(folder, {}, resume=True) as bag:
        bag.add_topic("/map", STRING, [qos(latched=True)])
        bag.add_topic("/pose", STRING, [qos(latched=False)])
        for i in range(100, 110):
            bag.write("/pose", text(f"{i:09d}"), log_time_ns=i * S // 100, publish_time_ns=i * S // 100)
    written = in_mcap(folder / "bag_1.mcap")
    assert [(topic, sequence) for topic, sequence, *_ in written[:2]] == [("/map", 0), ("/pose", 100)]
    with BagReader(folder) as reader:
        assert [int(message.data[8:17]) for message in reader.messages()] == list(range(110))


# Prints how many messages were synced; it writes a thousand a second, far less than fill a chunk.
SYNCING = """
import sys, time
from pathlib import Path
from tests.support.bags import STRING, text
from uav_dc_ros.bags.write import BagWriter
bag = BagWriter(Path(sys.argv[1]), {}, split_s=0.5)
bag.add_topic("/a", STRING)
for i in range(10**9):
    bag.write("/a", text(f"{i:09d}"), log_time_ns=time.time_ns(), publish_time_ns=i)
    if i % 100 == 99:
        bag.sync()
        print(i + 1, flush=True)
    time.sleep(0.001)
"""


def test_what_was_synced_survives_a_kill(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", SYNCING, str(tmp_path / "bag")], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    synced = 0
    while synced < 1000:
        synced = int(process.stdout.readline())
    os.kill(process.pid, signal.SIGKILL)
    synced = max([synced, *(int(line) for line in process.stdout.read().split())])
    process.stdout.close()
    process.wait()
    repair(tmp_path / "bag")
    with BagReader(tmp_path / "bag") as reader:
        numbers = [int(message.data[8:17]) for message in reader.messages()]
    assert len(reader.parts) > 1
    assert numbers == list(range(len(numbers)))
    assert synced <= len(numbers) < synced + 100 + 10
