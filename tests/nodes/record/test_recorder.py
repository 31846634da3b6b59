"""The recorder with real publishers: whatever they publish, however they offer it, and what is lost of it."""

import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from tests.conftest import PATIENCE_S, Ros, finish, wait_for
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.salvage.repair import repair

MIB = 2**20


def record(ros: Ros, *options: object) -> subprocess.Popen[str]:
    """Start the verb, and wait until it records into `ros.folder / "bag"`."""
    process = ros.start("uav_dc_ros.bag", "record", "--out", ros.folder / "bag", *options)
    assert process.stdout is not None
    wait_for(process.stdout, "Ctrl-C ends it")
    return process


def talk(ros: Ros, *rows: dict[str, Any]) -> subprocess.Popen[str]:
    """Start a publisher outside the mission."""
    process = ros.stranger("record/talker", json.dumps(rows))
    assert process.stdout is not None
    wait_for(process.stdout, "publishing")
    return process


def published(talker: subprocess.Popen[str], *, leave: bool = True) -> dict[str, int]:
    """Numbers of messages that it has published, once it has published all."""
    assert talker.stdout is not None
    counts: dict[str, int] = json.loads(talker.stdout.readline())
    if leave:
        talker.communicate(timeout=PATIENCE_S)
    return counts


def stop(process: subprocess.Popen[str]) -> str:
    """End a recorder as Ctrl-C does; what it printed."""
    process.send_signal(signal.SIGINT)
    status, output = finish(process)
    assert status == 0, output
    assert "Traceback" not in output
    return output


def numbers(bag: Path, topic: str) -> list[int]:
    """The numbers of a topic's messages."""
    with BagReader(bag) as reader:
        return [int(message.data[8:17]) for message in reader.messages([topic])]


def custom(bag: Path) -> dict[str, str]:
    """The custom data in metadata.yaml."""
    about: dict[str, str] = YAML(typ="safe").load(bag / "metadata.yaml")["rosbag2_bagfile_information"][
        "custom_data"
    ]
    return about


def offered(bag: Path, topic: str) -> set[tuple[str, str]]:
    """Reliability and durability that a topic's publishers offered."""
    with BagReader(bag) as reader:
        rows = YAML(typ="safe").load(reader.topics[topic].offered_qos)
    return {(row["reliability"], row["durability"]) for row in rows}


def test_whatever_is_published_is_recorded_also_late_and_with_its_qos(ros: Ros) -> None:
    shadow = ros.folder / "shadow" / "stereo_msgs"  # so that the recorder has no such messages
    shadow.mkdir(parents=True)
    (shadow / "__init__.py").touch()
    ros.environment["PYTHONPATH"] += f":{shadow.parent}"
    recorder = record(ros, "--split-s", 1)
    del ros.environment["PYTHONPATH"]
    talker = talk(
        ros,
        {"topic": "/reliable", "n": 300, "hz": 150},
        {"topic": "/late", "reliable": False, "n": 50, "after_s": 1.0, "hz": 150},
        {"topic": "/map", "latched": True, "n": 3, "depth": 10},
        {"topic": "/both", "latched": True, "n": 1},
        {"topic": "/both", "latched": False, "n": 1},
        {"topic": "/_hidden", "n": 1, "patience_s": 0.0},
        {"topic": "/unknown", "stereo": True, "n": 1, "patience_s": 0.0},
    )
    counts = published(talker, leave=False)
    output = stop(recorder)
    talker.communicate(timeout=PATIENCE_S)
    bag = ros.folder / "bag"
    for topic in ("/reliable", "/late", "/map"):
        assert numbers(bag, topic) == list(range(counts[topic])), topic
    assert offered(bag, "/late") == {("best_effort", "volatile")}
    assert offered(bag, "/map") == {("reliable", "transient_local")}
    assert len(numbers(bag, "/both")) >= 1
    with BagReader(bag) as reader:
        assert set(reader.topics) == {"/reliable", "/late", "/map", "/both"}
        assert reader.dropped == {}
        assert len(reader.parts) > 1
    with BagReader(bag / "bag_1.mcap") as part:
        assert [int(m.data[8:17]) for m in part.messages(["/map"])] == [2], "the last latched message, again"
    assert output.count("/unknown is not recorded: type stereo_msgs/msg/DisparityImage is not installed") == 1
    assert json.loads(custom(bag)["not_recorded"]).keys() == {"/unknown"}
    assert custom(bag)["dropped"] == "{}"


def test_poses_that_are_offered_best_effort_are_recorded_as_well(
    ros: Ros, small_scenario: Path, small_policy: Path
) -> None:
    """An autopilot's bridge offers no better; of our own nodes, which do, the recorder requests it."""
    peers = 'peers:=["world", "channel_monitor", "policy", "recorder", "mission_monitor"]'
    given = ("-p", f"scenario:={small_scenario}", "-p", peers, "-p", "pace:=100", "-r", "/clock:=clock")
    override = "qos_overrides./pose.publisher.reliability:=best_effort"
    world = ros.start("uav_dc_ros.nodes.world", "--ros-args", *given, "-p", override)
    given = ("--nodes", "channel_monitor,policy,recorder", "--compose", "--bag", "bag")
    given = ("--scenario", small_scenario, "--policy", small_policy, *given)
    status, output = ros.run_all(*given)
    assert status == 0, output
    assert "does not match" not in output
    world.send_signal(signal.SIGTERM)
    status, output = finish(world)
    assert status == 0, output
    assert "does not match" not in output
    bag = ros.folder / "bag"
    assert offered(bag, "/pose") == {("best_effort", "volatile")}
    with BagReader(bag) as reader:
        assert reader.topics["/pose"].count + reader.dropped.get("/pose", 0) == 31


@pytest.mark.long
def test_topics_by_list_and_a_namespace(ros: Ros) -> None:
    recorder = record(ros, "--namespace", "/uav1", "--topics", "a,/elsewhere/b,never", "--compression", "lz4")
    talker = talk(ros, *({"topic": t, "n": 5} for t in ("/uav1/a", "/elsewhere/b")), {
        "topic": "/uav1/c", "patience_s": 1.0
    })  # fmt: skip
    published(talker)
    stop(recorder)
    with BagReader(ros.folder / "bag") as reader:
        assert {name: topic.count for name, topic in reader.topics.items()} == {
            "/uav1/a": 5,
            "/elsewhere/b": 5,
        }
    assert json.loads(custom(ros.folder / "bag")["not_recorded"]) == {"/uav1/never": "it has no publisher"}


@pytest.mark.long
def test_a_publisher_that_offers_less_is_recorded_and_nothing_twice(ros: Ros) -> None:
    recorder = record(ros)
    talker = talk(
        ros,
        {"topic": "/a", "n": 600, "hz": 200},
        {"topic": "/a", "n": 100, "hz": 100, "reliable": False, "after_s": 1.0, "bytes": 20},
    )
    published(talker)
    stop(recorder)
    with BagReader(ros.folder / "bag") as reader:
        messages = [(message.data[17:18], int(message.data[8:17])) for message in reader.messages(["/a"])]
        assert reader.dropped == {}
    first = [number for end, number in messages if end != b"x"]
    second = [number for end, number in messages if end == b"x"]
    assert first == list(range(600))
    # What it publishes before its discovery, for a fifth of a second at most, reaches no subscriber.
    assert second == list(range(second[0], 100))
    assert len(second) > 50


def test_a_kill_takes_the_last_second_at_most(ros: Ros) -> None:
    recorder = record(ros)
    talker = talk(ros, {"topic": "/a", "n": 700, "hz": 200}, {"topic": "/b", "n": 30, "hz": 10})
    time.sleep(2.5)
    killed_ns = time.time_ns()
    recorder.kill()
    finish(recorder)
    published(talker)
    repair(ros.folder / "bag")
    with BagReader(ros.folder / "bag") as reader:
        published_ns = [message.publish_time_ns for message in reader.messages(["/a"])]
    assert len(published_ns) > 100
    assert published_ns[-1] > killed_ns - 2 * 10**9  # a second, and as much for a busy machine
    recorded = numbers(ros.folder / "bag", "/a")
    assert recorded == list(range(len(recorded)))


@pytest.mark.parametrize("reliable", [pytest.param(False, marks=pytest.mark.long), True])
def test_every_dropped_message_is_counted(ros: Ros, reliable: bool) -> None:
    """A recorder that stands still for a while gets more than its middleware can hold for it."""
    recorder = record(ros)
    talker = talk(
        ros,
        {"topic": "/a", "n": 12_000, "hz": 3000, "reliable": reliable, "depth": 500},
        {"topic": "/b", "n": 50, "hz": 20},
    )
    time.sleep(1.5)
    recorder.send_signal(signal.SIGSTOP)
    time.sleep(1.5)
    recorder.send_signal(signal.SIGCONT)
    counts = published(talker, leave=False)
    output = stop(recorder)
    talker.communicate(timeout=PATIENCE_S)
    with BagReader(ros.folder / "bag") as reader:
        recorded = reader.topics["/a"].count
        dropped = reader.dropped
    assert dropped is not None
    assert dropped.keys() == {"/a"}
    assert dropped["/a"] > 0
    assert recorded + dropped["/a"] == counts["/a"] == 12_000
    assert json.loads(custom(ros.folder / "bag")["dropped"]) == dropped
    assert f"dropped messages: /a {dropped['/a']}" in output


@pytest.mark.long
def test_recording_stops_before_the_disk_is_full(ros: Ros) -> None:
    status, output = ros.run(
        "uav_dc_ros.bag", "record", "--out", ros.folder / "never", "--min-free-bytes", 2**60
    )
    assert status == 2, output
    assert f"expected at least {2**60} (min_free_bytes)" in output
    assert not (ros.folder / "never").exists()

    least = shutil.disk_usage(ros.folder).free - 128 * MIB
    recorder = record(ros, "--min-free-bytes", least)
    talker = talk(ros, {"topic": "/a", "n": 100, "hz": 200})
    published(talker)
    with (ros.folder / "large").open("wb") as large:
        os.posix_fallocate(large.fileno(), 0, 512 * MIB)
    try:
        status, output = finish(recorder)
    finally:
        (ros.folder / "large").unlink()
    assert status == 3, output
    assert f"expected at least {least} (min_free_bytes). Recording stops here" in output
    assert "Traceback" not in output
    assert numbers(ros.folder / "bag", "/a") == list(range(100))
    assert (ros.folder / "bag" / "metadata.yaml").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--topics", "a,,b"), "topics: 'a,,b'; expected names of topics with a comma between"),
        pytest.param(("--topics", "1a"), "topics: '1a': ", marks=pytest.mark.long),
        pytest.param(
            ("--split-s", "-1"), "split_s: -1.0; expected a number from 0.0", marks=pytest.mark.long
        ),
        (("--split-s", "nan"), "split_s: nan; expected a number from 0.0"),
        pytest.param(
            ("--split-bytes", "-1"), "--split-bytes: '-1'; expected a whole number", marks=pytest.mark.long
        ),
        pytest.param(("--compression", "bz2"), "invalid choice: 'bz2'", marks=pytest.mark.long),
        (("--namespace", "a b"), "--namespace: 'a b'; "),
        pytest.param(("--out", "."), "exists already; expected a new one", marks=pytest.mark.long),
    ],
)
def test_mistakes_are_one_line(ros: Ros, options: tuple[str, ...], message: str) -> None:
    status, output = ros.run_fork("uav_dc_ros.bag", "record", "--out", ros.folder / "bag", *options)
    assert status == 2, output
    assert message in output
    assert "Traceback" not in output
    assert len(output.splitlines()) == 1, output
    assert not (ros.folder / "bag").exists()


@pytest.mark.long
def test_a_mission_s_bag_has_all_of_its_namespace_and_nothing_of_another_mission(
    ros: Ros, small_scenario: Path, small_policy: Path
) -> None:
    given = ("--scenario", small_scenario, "--policy", small_policy, "--pace", 80)
    flight = ros.start("uav_dc_ros.run_all", *given, "--bag", ros.folder / "bag")
    talker = talk(
        ros,
        {"topic": "/camera/info", "n": 20, "hz": 50},
        {"topic": "/uav2/mission", "n": 1, "patience_s": 1.0},
        {"topic": "/uav2/camera", "n": 1, "patience_s": 1.0},
        {"topic": "/ready_or_not", "latched": True},
    )
    published(talker, leave=False)
    status, output = finish(flight)
    talker.communicate(timeout=PATIENCE_S)
    assert status == 0, output
    assert numbers(ros.folder / "bag", "/camera/info") == list(range(20))
    with BagReader(ros.folder / "bag") as reader:
        assert "/ready_or_not" in reader.topics
        assert "/rates" in reader.topics
        assert not {name for name in reader.topics if name.startswith("/uav2")} | {"/ready"} & set(
            reader.topics
        )
        assert reader.dropped == {}


def disk_for(folder: Path) -> Path | None:
    """A disk of its own, mounted from an image file; None where that cannot be."""
    image, at = folder / "disk.img", folder / "disk"
    at.mkdir()
    commands = (
        ["truncate", "-s", "600M", image],
        ["mkfs.ext4", "-q", "-F", image],
        ["mount", "-o", "loop", image, at],
    )
    for command in commands:
        if (
            shutil.which(command[0]) is None
            or subprocess.run(command, check=False, capture_output=True).returncode
        ):
            return None
    return image


@pytest.mark.long
def test_a_pulled_plug_takes_the_last_second_at_most(
    ros: Ros, small_scenario: Path, small_policy: Path
) -> None:
    """What has reached the disk at some moment: a copy of its image, mounted as after a power cut."""
    image, later = disk_for(ros.folder), ros.folder / "later"
    if image is None:
        pytest.skip("a disk cannot be mounted here: needs root and loop devices")
    later.mkdir()
    options = ("--scenario", small_scenario, "--policy", small_policy, "--pace", 50)
    flight = ros.start("uav_dc_ros.run_all", *options, "--bag", ros.folder / "disk" / "bag")
    try:
        assert flight.stdout is not None
        wait_for(flight.stdout, "step 20/30")
        plug_ns = time.time_ns()
        copy = shutil.copy(image, ros.folder / "copy.img")
        assert finish(flight)[0] == 0
        subprocess.run(["mount", "-o", "loop", copy, later], check=True)
        status, output = ros.run(
            "uav_dc_ros.bag", "recover", later / "bag", "--out", ros.folder / "recovered"
        )
    finally:
        flight.wait(60)
        for mounted in (later, ros.folder / "disk"):
            subprocess.run(["umount", mounted], check=False, capture_output=True)
    assert status == 0, output
    with BagReader(ros.folder / "recovered") as reader:
        assert reader.message_count > 50
        assert plug_ns - reader.last_ns < 10**9
