"""Resuming a bag whose writer was killed: the next part, and nothing twice."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from tests.support.bags import ROOT, STRING, TYPES, content, in_bag, in_mcap, information, killed_writer, text
from uav_dc_ros.bags import write
from uav_dc_ros.bags.part_writer import PartWriter, folder_lock
from uav_dc_ros.bags.salvage.repair import repair
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.errors import BagError


def qos(depth: int) -> Qos:
    """A QoS that differs from others by its depth."""
    never = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE, QosDurability.VOLATILE, never, never,
        QosLiveliness.AUTOMATIC, never, False,
    )  # fmt: skip


def left_by_a_killed_writer(
    folder: Path, n: int = 3, *, type: str = STRING, offered: tuple[Qos, ...] = ()
) -> Path:
    """A bag without metadata.yaml, its part whole: the kill fell between the two."""
    with BagWriter(folder, {"seed": "3"}) as bag:
        bag.add_topic("/a", type, offered)
        for i in range(n):
            bag.write("/a", text(f"{i}"), log_time_ns=1000 + i, publish_time_ns=900 + i)
    (folder / "metadata.yaml").unlink()
    return folder


def test_killed_twice_and_then_closed(tmp_path: Path) -> None:
    """Three parts; a resumed writer repeats lost messages, and skips others, as with latched topics."""
    bag = tmp_path / "bag"
    first = 0
    for resume in (False, True):
        killed_writer(bag, first=first, n=900, resume=resume)
        assert not (bag / "metadata.yaml").exists()
        with folder_lock(bag):
            pass  # a killed writer holds no lock
        # What a second writer would read, without making a part.
        shadow = tmp_path / f"shadow_{resume}"
        shadow.mkdir()
        for name, data in content(bag).items():
            (shadow / name).write_bytes(data)
        first = max(repair(shadow).whole.published_ns.values()) + 1
    with BagWriter(bag, {"seed": "3"}, resume=True) as writer:
        assert dict(writer.already_written) == repair(shadow).whole.published_ns
        assert sorted(writer.already_written.values()) == [first - 2, first - 1]
        assert writer.message_count == first
        for topic in ("/a", "/b"):
            writer.add_topic(topic, STRING)
        for i in range(first - 100, first + 10):
            topic = "/ab"[0] + "ab"[i % 2]
            if i > writer.already_written[topic]:
                writer.write(topic, text(f"{i:09d}"), log_time_ns=i, publish_time_ns=i)
    n = first + 10
    assert [int(data[:9]) for _, _, data in in_bag(bag)] == list(range(n))
    info = information(bag)
    names = ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]
    assert info["relative_file_paths"] == [file["path"] for file in info["files"]] == names
    in_parts = [in_mcap(bag / name) for name in names]
    assert [file["message_count"] for file in info["files"]] == [len(part) for part in in_parts]
    assert min(map(len, in_parts)) == 10
    for file, part in zip(info["files"], in_parts, strict=True):
        times = [log_time for _, _, log_time, *_ in part]
        assert file["starting_time"]["nanoseconds_since_epoch"] == times[0]
        assert file["duration"]["nanoseconds"] == times[-1] - times[0]
    assert (info["message_count"], info["duration"]["nanoseconds"]) == (n, n - 1)
    topics = [
        (row["topic_metadata"]["name"], row["message_count"]) for row in info["topics_with_message_count"]
    ]
    assert topics == [("/a", (n + 1) // 2), ("/b", n // 2)]
    assert info["custom_data"] == {"seed": "3"}
    sequences = [sequence for part in in_parts for topic, sequence, *_ in part if topic == "/a"]
    assert sequences == list(range(1, len(sequences) + 1))
    before = content(bag)
    assert repair(bag).rewritten == []
    assert content(bag) == before


def test_a_bag_that_was_closed_is_finished(tmp_path: Path) -> None:
    bag = left_by_a_killed_writer(tmp_path / "bag")
    repair(bag)
    before = content(bag)
    with pytest.raises(BagError, match=r"was closed: it has a metadata.yaml; expected one whose writer was"):
        BagWriter(bag, {}, resume=True)
    assert content(bag) == before


def test_a_bag_that_is_being_written_is_not_resumed(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", {}), pytest.raises(BagError, match="is being written or repaired"):
        BagWriter(tmp_path / "bag", {}, resume=True)
    assert information(tmp_path / "bag")["relative_file_paths"] == ["bag_0.mcap"]


def test_what_is_no_bag_is_not_resumed(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="No such file or directory; expected the folder of a bag"):
        BagWriter(tmp_path / "none", {}, resume=True)
    (tmp_path / "papers").mkdir()
    (tmp_path / "papers" / "note.txt").write_text("mine")
    with pytest.raises(BagError, match="holds files, but no MCAP file; expected a bag to resume"):
        BagWriter(tmp_path / "papers", {}, resume=True)
    assert content(tmp_path / "papers") == {"note.txt": b"mine"}


def test_a_writer_that_was_killed_before_its_first_byte(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with BagWriter(tmp_path / "bag", {}, resume=True) as writer:
        assert writer.already_written == {}
    assert information(tmp_path / "bag")["relative_file_paths"] == ["bag_0.mcap"]
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "empty_0.mcap").write_bytes(b"")
    with BagWriter(tmp_path / "empty", {"seed": "3"}, resume=True) as writer:
        writer.add_topic("/a", STRING)
        writer.write("/a", text("x"), log_time_ns=7, publish_time_ns=7)
    info = information(tmp_path / "empty")
    assert [file["message_count"] for file in info["files"]] == [0, 1]
    assert (info["starting_time"]["nanoseconds_since_epoch"], info["duration"]["nanoseconds"]) == (7, 0)
    assert in_bag(tmp_path / "empty") == [("/a", 7, "x")]


def test_a_moved_bag_is_resumed_with_the_next_number(tmp_path: Path) -> None:
    moved = left_by_a_killed_writer(tmp_path / "bag").rename(tmp_path / "moved")
    BagWriter(moved, {}, resume=True).close()
    assert information(moved)["relative_file_paths"] == ["bag_0.mcap", "moved_1.mcap"]


@pytest.mark.parametrize("before", [(), (qos(1),)])
def test_rosbags_reads_every_part_though_the_qos_differs(tmp_path: Path, before: tuple[Qos, ...]) -> None:
    """It silently skips the messages of a channel whose QoS is not that of metadata.yaml."""
    bag = left_by_a_killed_writer(tmp_path / "bag", offered=before)
    with BagWriter(bag, {}, resume=True) as writer:
        writer.add_topic("/a", STRING, [qos(2), qos(3)])
        writer.write("/a", text("3"), log_time_ns=1003, publish_time_ns=903)
    assert [data for _, _, data in in_bag(bag)] == ["0", "1", "2", "3"]


def test_a_topic_that_was_silent_gets_its_qos_from_the_part_that_has_messages(tmp_path: Path) -> None:
    """Its publishers may not have been there yet."""
    bag = left_by_a_killed_writer(tmp_path / "bag", n=0)
    with BagWriter(bag, {}, resume=True) as writer:
        writer.add_topic("/a", STRING, [qos(2)])
        writer.write("/a", text("x"), log_time_ns=1, publish_time_ns=1)
    [row] = information(bag)["topics_with_message_count"]
    assert [offer["depth"] for offer in row["topic_metadata"]["offered_qos_profiles"]] == [2]
    assert in_bag(bag) == [("/a", 1, "x")]


def test_the_description_of_the_first_part_stays(tmp_path: Path) -> None:
    bag = left_by_a_killed_writer(tmp_path / "bag")
    BagWriter(bag, {"seed": "4", "more": "x"}, resume=True).close()
    assert information(bag)["custom_data"] == {"seed": "3", "more": "x"}


def test_a_topic_keeps_its_type(tmp_path: Path) -> None:
    bag = left_by_a_killed_writer(tmp_path / "bag")
    with (
        BagWriter(bag, {}, resume=True) as writer,
        pytest.raises(BagError, match="/a is of type nav_msgs/msg/Path; expected std_msgs/msg/String"),
    ):
        writer.add_topic("/a", "nav_msgs/msg/Path")


def test_a_full_disk_leaves_the_bag_as_it_was(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    killed_writer(bag, n=3000)
    before = content(bag)
    limit = len(before["bag_0.mcap"]) // 2
    resumed = subprocess.run(
        [sys.executable, "-c", "import sys; from pathlib import Path\n"
         "from uav_dc_ros.bags.write import BagWriter; from uav_dc_ros.errors import BagError\n"
         "try: BagWriter(Path(sys.argv[1]), {}, resume=True)\nexcept BagError as error: print(error)",
         str(bag)],
        cwd=ROOT, capture_output=True, text=True, check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )  # fmt: skip
    assert "cannot be repaired: File too large" in resumed.stdout
    assert content(bag) == before


@pytest.mark.parametrize("step", ["add_message", "add_channel", "finish"])
def test_a_failure_releases_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    bag = BagWriter(tmp_path / "bag", {})
    monkeypatch.setattr(PartWriter, step, full)
    with pytest.raises(BagError, match="written any further: No space left"), bag:  # noqa: PT012
        bag.add_topic("/a", STRING)
        bag.write("/a", text("x"), log_time_ns=1, publish_time_ns=1)
    monkeypatch.undo()
    monkeypatch.setattr(write, "PartWriter", full)
    with pytest.raises(BagError, match="cannot be written: No space left"):
        BagWriter(tmp_path / "bag", {}, resume=True)
    monkeypatch.undo()
    BagWriter(tmp_path / "bag", {}, resume=True).close()
    assert information(tmp_path / "bag")["relative_file_paths"] == ["bag_0.mcap", "bag_1.mcap"]


def test_every_message_type_of_ros_can_be_recorded(tmp_path: Path) -> None:
    """Also the nested ones, read back by the definitions that the bag itself holds."""
    t = TYPES.types
    header = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](1, 2), "map")
    pose = t["geometry_msgs/msg/Pose"](
        t["geometry_msgs/msg/Point"](1.0, 2.0, 3.0), t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    )
    status = t["diagnostic_msgs/msg/DiagnosticStatus"](
        2, "link", "lost", "uav", [t["diagnostic_msgs/msg/KeyValue"]("sinr", "0.1")]
    )
    black = t["std_msgs/msg/ColorRGBA"](0.0, 0.0, 0.0, 1.0)
    marker = t["visualization_msgs/msg/Marker"](
        header=header, ns="users", id=7, type=2, action=0, pose=pose,
        scale=t["geometry_msgs/msg/Vector3"](1.0, 1.0, 1.0), color=black,
        lifetime=t["builtin_interfaces/msg/Duration"](0, 0), frame_locked=False, points=[], colors=[black],
        texture_resource="", texture=t["sensor_msgs/msg/CompressedImage"](header, "", np.zeros(0, np.uint8)),
        uv_coordinates=[], text="", mesh_resource="",
        mesh_file=t["visualization_msgs/msg/MeshFile"]("", np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )  # fmt: skip
    messages = {
        "nav_msgs/msg/Path": t["nav_msgs/msg/Path"](
            header, [t["geometry_msgs/msg/PoseStamped"](header, pose)]
        ),
        "visualization_msgs/msg/MarkerArray": t["visualization_msgs/msg/MarkerArray"]([marker]),
        "diagnostic_msgs/msg/DiagnosticArray": t["diagnostic_msgs/msg/DiagnosticArray"](header, [status]),
        "rosgraph_msgs/msg/Clock": t["rosgraph_msgs/msg/Clock"](t["builtin_interfaces/msg/Time"](5, 6)),
    }
    with BagWriter(tmp_path / "bag", {}) as writer:
        for i, (type, message) in enumerate(messages.items()):
            writer.add_topic(f"/{i}", type)
            data = bytes(TYPES.serialize_cdr(message, type))
            writer.write(f"/{i}", data, log_time_ns=i, publish_time_ns=i)
    with AnyReader([tmp_path / "bag"]) as reader:
        read = {c.msgtype: reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()}
    assert list(read) == list(messages)
    assert read["nav_msgs/msg/Path"].poses[0].pose.position.z == 3.0
    assert read["visualization_msgs/msg/MarkerArray"].markers[0].ns == "users"
    assert read["diagnostic_msgs/msg/DiagnosticArray"].status[0].values[0].key == "sinr"
    assert read["rosgraph_msgs/msg/Clock"].clock.nanosec == 6
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        schemas = {schema.name for schema, _, _ in make_reader(file).iter_messages() if schema}
    assert schemas == set(messages)


def test_a_type_that_ros_does_not_have(tmp_path: Path) -> None:
    with (
        BagWriter(tmp_path / "bag", {}) as writer,
        pytest.raises(BagError, match="'std_msgs/msg/Strung'; expected a type of ROS 2 Jazzy"),
    ):
        writer.add_topic("/a", "std_msgs/msg/Strung")
