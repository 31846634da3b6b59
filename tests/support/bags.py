"""Bags for tests, and what independent readers see in them."""

import io
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

TYPES = get_typestore(Stores.ROS2_JAZZY)
STRING = "std_msgs/msg/String"
HASH = TYPES.hash_rihs01(STRING)
ROOT = Path(__file__).parents[2]
QOS = """
- history: keep_last
  depth: 7
  reliability: reliable
  durability: volatile
  deadline: {sec: 0, nsec: 0}
  lifespan: {sec: 0, nsec: 0}
  liveliness: automatic
  liveliness_lease_duration: {sec: 0, nsec: 0}
  avoid_ros_namespace_conventions: false
"""

# Writes numbered messages on two topics until it is killed; prints their number after each.
WRITER = """
import sys
from pathlib import Path
from tests.support.bags import STRING, text
from uav_dc_ros.bags.write import BagWriter
folder, first, resume = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "resume"
bag = BagWriter(folder, {"seed": "3"}, resume=resume)
for topic in ("/a", "/b"):
    bag.add_topic(topic, STRING)
for i in range(first, 10**9):
    bag.write("/ab"[0] + "ab"[i % 2], text(f"{i:09d}" + 500 * "x"), log_time_ns=i, publish_time_ns=i)
    print(i + 1, flush=True)
"""


def text(content: str) -> bytes:
    """A std_msgs/String, serialised."""
    return bytes(TYPES.serialize_cdr(TYPES.types[STRING](content), STRING))


def killed_writer(folder: Path, *, first: int = 0, n: int, resume: bool = False) -> int:
    """A process that writes messages from number `first` on, killed after `n`; how many it wrote at least."""
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder), str(first), "resume" if resume else "new"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    last = first
    for line in process.stdout:
        last = int(line)
        if last >= first + n:
            os.kill(process.pid, signal.SIGKILL)
            break
    rest = process.stdout.read().split("\n")[:-1]
    process.stdout.close()
    assert process.wait() == -signal.SIGKILL
    return int(rest[-1]) if rest else last


def mcap_file(
    *, compression: CompressionType, chunked: bool, n: int, finished: bool = True, qos: str = QOS
) -> bytes:
    """An MCAP file of a recorder, in small chunks, with a silent topic and two metadata records."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=200, compression=compression, use_chunking=chunked)
    writer.start("ros2", "test")
    writer.add_metadata("uav_dc_ros", {"seed": "3"})
    writer.add_metadata("other", {"k": "v"})
    schema = writer.register_schema(STRING, "ros2msg", b"string data")
    about = {"offered_qos_profiles": qos, "topic_type_hash": HASH}
    channels = [writer.register_channel(topic, "cdr", schema, about) for topic in ("/a", "/b", "/silent")]
    for i in range(n):
        writer.add_message(channels[i % 2], 1000 + i, text(f"message {i}"), 900 + i, sequence=i)
    if finished:
        writer.finish()
    return file.getvalue()


def bare(path: Path) -> Path:
    """A file without its summary section, as MCAP allows."""
    file = path.read_bytes()
    (start,) = struct.unpack_from("<Q", file, len(file) - 8 - 20)
    path.write_bytes(file[:start] + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + file[-8:])
    return path


def in_mcap(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Topic, sequence, log and publish time and data of a part's messages, by mcap's indexed reader.

    It checks the CRCs; without its end the file is refused.
    """
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_summary() is not None
        return [
            (channel.topic, m.sequence, m.log_time, m.publish_time, m.data)
            for _, channel, m in reader.iter_messages(log_time_order=False)
        ]


def in_bag(folder: Path) -> list[tuple[str, int, Any]]:
    """Topic, log time and text of a bag's messages, as rosbags reads them by metadata.yaml."""
    with AnyReader([folder]) as reader:
        return [
            (connection.topic, time_ns, reader.deserialize(data, connection.msgtype).data)
            for connection, time_ns, data in reader.messages()
        ]


def information(folder: Path) -> dict[str, Any]:
    """The content of metadata.yaml."""
    return dict(YAML(typ="safe").load(folder / "metadata.yaml")["rosbag2_bagfile_information"])


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}
