"""Playing a bag: what a subscriber in another process receives."""

import base64
import json
import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.interfaces import Qos
from rosbags.rosbag2 import StoragePlugin, Writer

from tests.conftest import PATIENCE_S, Ros, each_once, finish, read_bag, until
from tests.nodes.conftest import Alone
from tests.support.bags import STRING, TYPES, text
from uav_dc_ros import cli
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.errors import ParameterError, UavDcError
from uav_dc_ros.nodes.play import bag_play as verb
from uav_dc_ros.nodes.ros import recorded_qos

BAG, PLAY = "uav_dc_ros.bag", "play"
MS = 10**6
START_NS = 1_700_000_000 * 10**9
VOLATILE = recorded_qos.offered(QoSProfile(depth=10), 10)
LATCHED = recorded_qos.offered(QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL), 2)
WAIT = ("--wait-for-subscribers", 20)
Messages = list[tuple[str, float, str]]  # topic, milliseconds from the beginning, text
Received = list[tuple[str, str, int, int]]  # topic, text, when published, when received, nanoseconds


def made(folder: Path, topics: dict[str, Qos], messages: Messages) -> Path:
    """A bag with strings."""
    with BagWriter(folder, {}) as bag:
        for topic, qos in topics.items():
            bag.add_topic(topic, STRING, [qos])
        for topic, at_ms, content in messages:
            at_ns = START_NS + round(at_ms * MS)
            bag.write(topic, text(content), log_time_ns=at_ns, publish_time_ns=at_ns)
    return folder


def numbers(topic: str, n: int, each_ms: float) -> Messages:
    """Numbered messages at equal distances."""
    return [(topic, i * each_ms, str(i)) for i in range(n)]


def listener(ros: Ros, *topics: str, each_s: float = 0.0, **row: Any) -> "subprocess.Popen[str]":
    """A subscriber to some topics of strings, that listens by now."""
    rows = {topic: {"type": STRING, **row} for topic in topics}
    process = ros.stranger("play/listener", json.dumps({"topics": rows, "each_s": each_s}))
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    return process


def count_received(process: "subprocess.Popen[str]") -> int:
    """Number of messages that a listener has received."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return int(process.stdout.readline())


def raw(process: "subprocess.Popen[str]") -> list[tuple[str, bytes, int, int]]:
    """End a listener; all that it received, serialised, in the order of receipt."""
    content, _ = process.communicate(timeout=PATIENCE_S)
    return [
        (topic, base64.b64decode(data), a, b) for topic, data, a, b in json.loads(content.splitlines()[-1])
    ]


def received_by(process: "subprocess.Popen[str]") -> Received:
    """End a listener of strings; all that it received, in the order of receipt."""
    return [(t, TYPES.deserialize_cdr(data, STRING).data, a, b) for t, data, a, b in raw(process)]


def play(ros: Ros, *arguments: object) -> str:
    """Play to the end; what was printed."""
    status, printed = ros.run(BAG, PLAY, *arguments)
    assert status == 0, printed
    assert "Traceback" not in printed
    return printed


def by_rosbags(folder: Path, storage: StoragePlugin, messages: Messages) -> Path:
    """A bag that rosbags wrote."""
    with Writer(folder, version=9, storage_plugin=storage) as bag:
        topics = sorted({topic for topic, *_ in messages})
        connections = {topic: bag.add_connection(topic, STRING, typestore=TYPES) for topic in topics}
        for topic, at_ms, content in messages:
            bag.write(connections[topic], START_NS + round(at_ms * MS), text(content))
    return folder


def test_every_play_publishes_what_the_bag_holds_in_its_order(ros: Ros, tmp_path: Path) -> None:
    """Over all topics, by the time at which each was published; a subscriber gets each topic in order."""
    messages = [("/" + "abc"[i * i % 3], i * 0.01, f"{i}") for i in range(3000)]
    mcap = by_rosbags(tmp_path / "mcap", StoragePlugin.MCAP, messages)
    sqlite = by_rosbags(tmp_path / "sqlite", StoragePlugin.SQLITE3, messages)
    listens = listener(ros, "/a", "/b", "/c")
    for bag in (mcap, sqlite):
        play(ros, bag, "--rate", "max", *WAIT)
    received = received_by(listens)
    assert len({sent for _, _, sent, _ in received}) == len(received)  # so there is one order
    published = sorted(received, key=lambda each: each[2])
    assert [(topic, content) for topic, content, *_ in published] == 2 * [
        (t, content) for t, _, content in messages
    ]
    for topic in ("/a", "/b", "/c"):
        each = [content for name, content, *_ in received if name == topic]
        assert each == 2 * [content for name, _, content in messages if name == topic]


def loses_nothing(ros: Ros, folder: Path, qos: Qos, n: int, each_s: float) -> None:
    """Play more messages than any history holds, so that the publisher has to wait."""
    bag = made(folder, {"/a": qos}, numbers("/a", n, 0.001))
    latched = qos.durability.name == "TRANSIENT_LOCAL"
    listens = listener(ros, "/a", latched=latched, each_s=each_s)
    play(ros, bag, "--rate", "max", *WAIT)
    assert [int(content) for _, content, *_ in received_by(listens)] == list(range(n))


def test_a_reliable_subscriber_that_falls_behind_loses_nothing(ros: Ros, tmp_path: Path) -> None:
    """It stands still for a while, in which all could be published, and more than any history holds."""
    n = 15_000
    bag = made(tmp_path / "bag", {"/a": VOLATILE}, numbers("/a", n, 0.001))
    listens = listener(ros, "/a")
    player = ros.start(BAG, PLAY, bag, "--rate", "max", *WAIT)
    until(lambda: count_received(listens))
    listens.send_signal(signal.SIGSTOP)
    time.sleep(2.5)
    assert player.poll() is None  # it waits
    listens.send_signal(signal.SIGCONT)
    status, printed = finish(player)
    assert status == 0, printed
    assert [int(content) for _, content, *_ in received_by(listens)] == list(range(n))


@pytest.mark.long
@pytest.mark.parametrize("qos", [VOLATILE, LATCHED])
@pytest.mark.parametrize("each_s", [0.0, 0.001])
def test_no_subscriber_loses_anything_for_long(ros: Ros, tmp_path: Path, qos: Qos, each_s: float) -> None:
    loses_nothing(ros, tmp_path / "bag", qos, 30_000, each_s)


def test_distances_in_time_are_kept(ros: Ros, tmp_path: Path) -> None:
    """As well as this machine lets anybody sleep at that time: a thread here measures it, besides."""
    draws = np.random.default_rng(1).random(400)
    at_ms = np.sort(draws) * 2000.0
    bag = made(tmp_path / "bag", {"/a": VOLATILE}, [("/a", at, f"{i}") for i, at in enumerate(at_ms)])
    late_ms: list[float] = []
    over = threading.Event()

    def sleep() -> None:
        while not over.is_set():
            began_s = time.perf_counter()
            time.sleep(0.005)
            late_ms.append((time.perf_counter() - began_s) * 1e3 - 5.0)

    sleeper = threading.Thread(target=sleep)
    listens = listener(ros, "/a")
    sleeper.start()
    play(ros, bag, *WAIT)
    over.set()
    sleeper.join()
    sent_ms = np.array([sent for _, _, sent, _ in received_by(listens)]) * 1e-6
    assert len(sent_ms) == len(at_ms)
    # A distance has two ends. On a machine with much else to do, a late one is the machine's.
    assert np.median(np.abs(np.diff(sent_ms) - np.diff(at_ms))) < 2.0 + 2 * np.median(late_ms)
    # Lateness does not add up: of the last ones, most are as punctual as of the first.
    late = sent_ms - at_ms
    assert abs(np.median(late[-50:]) - np.median(late[:50])) < 5.0 + 2 * max(late_ms)


def test_options_choose_what_is_played_and_how(ros: Ros, tmp_path: Path) -> None:
    """A second of three, three times as fast, under other names, with the bag's time beside it."""
    messages = sorted([*numbers("/a", 60, 50.0), *numbers("/b", 60, 50.0), *numbers("/c", 60, 50.0)])
    messages.sort(key=lambda each: each[1])
    bag = made(tmp_path / "bag", dict.fromkeys(("/a", "/b", "/c"), VOLATILE), messages)
    listens = listener(ros, "/a", "/b", "/c", "/other", "/uav1/b")
    clock = {"topics": {"/clock": {"type": "rosgraph_msgs/msg/Clock", "reliable": False}}}
    clocks = ros.stranger("play/listener", json.dumps(clock))
    assert clocks.stdout is not None
    assert clocks.stdout.readline() == "there\n"
    options = ["--rate", 0.5, "--start", 1, "--duration", 1, "--exclude", "/c", "--namespace", "/uav1"]
    play(ros, bag, *options, "--remap", "/a:=/other", "--clock", 50)
    received = received_by(listens)
    for topic in ("/other", "/uav1/b"):
        of_it = [(int(content), sent) for name, content, sent, _ in received if name == topic]
        assert [i for i, _ in of_it] == list(range(20, 40))
        took_s = (of_it[-1][1] - of_it[0][1]) * 1e-9
        assert took_s == pytest.approx(0.95 / 0.5, abs=1.0)
    assert len(received) == 40
    times = [
        (clock.clock.sec * 10**9 + clock.clock.nanosec, sent)
        for clock, sent in (
            (TYPES.deserialize_cdr(data, "rosgraph_msgs/msg/Clock"), sent) for _, data, sent, _ in raw(clocks)
        )
    ]
    assert times == sorted(times)
    # The clock waits for no subscriber: on a busy machine one is matched after the first ticks.
    assert START_NS + 10**9 <= times[0][0] < START_NS + 1.5e9
    assert START_NS + 1.9e9 <= times[-1][0] <= START_NS + 1.95e9  # not ahead of the last message
    running = [(at, sent) for at, sent in times if START_NS + 1.5e9 < at < START_NS + 1.8e9]
    speed = (running[-1][0] - running[0][0]) / (running[-1][1] - running[0][1])
    assert speed == pytest.approx(0.5, rel=0.4)
    assert 5 < len(running) < 0.3 / 0.5 * 50 * 1.3


def test_a_split_bag_repeats_nothing(ros: Ros, tmp_path: Path) -> None:
    """A recorder begins each file with what is latched: with its old publish time."""
    qos = (
        "- {history: keep_last, depth: 2, reliability: reliable, durability: transient_local, "
        "deadline: {sec: 0, nsec: 0}, lifespan: {sec: 0, nsec: 0}, liveliness: automatic, "
        "liveliness_lease_duration: {sec: 0, nsec: 0}, avoid_ros_namespace_conventions: false}"
    )
    parts = [
        [(1, 1, "a"), (2, 2, "b"), (3, 3, "b")],  # log and publish time, milliseconds; text
        [(4, 2, "b"), (4, 3, "b"), (5, 5, "b"), (6, 6, "c")],
        [(7, 5, "b"), (7, 6, "c"), (8, 8, "a")],
    ]
    (tmp_path / "bag").mkdir()
    for n, part in enumerate(parts):
        with (tmp_path / "bag" / f"bag_{n}.mcap").open("wb") as file:
            writer = McapWriter(file)
            writer.start("ros2", "test")
            schema = writer.register_schema(STRING, "ros2msg", b"string data")
            channel = writer.register_channel("/a", "cdr", schema, {"offered_qos_profiles": qos})
            for logged, published, content in part:
                writer.add_message(channel, START_NS + logged * MS, text(content), START_NS + published * MS)
            writer.finish()
    listens = listener(ros, "/a", latched=True)
    play(ros, tmp_path / "bag", *WAIT)
    assert [content for _, content, *_ in received_by(listens)] == ["a", "b", "b", "b", "c", "a"]


def test_a_loop_goes_on_until_it_is_stopped(ros: Ros, tmp_path: Path) -> None:
    bag = made(tmp_path / "bag", {"/a": LATCHED}, numbers("/a", 3, 20.0))
    listens = listener(ros, "/a", latched=True)
    player = ros.start(BAG, PLAY, bag, "--loop", *WAIT)
    until(lambda: count_received(listens) >= 8)
    player.send_signal(signal.SIGINT)
    status, printed = finish(player)
    assert status == 130, printed
    assert "Traceback" not in printed
    content = [int(content) for _, content, *_ in received_by(listens)]
    assert content == [i % 3 for i in range(len(content))]


def test_what_cannot_be_played_is_noted_and_left_out(ros: Ros, tmp_path: Path) -> None:
    """Types that are not installed, or others by now, two on one topic, and an incompatible subscriber.

    And 57 years without a message, of a clock that was set forward: beyond the range of /clock.
    """
    bag = tmp_path / "bag.mcap"
    with bag.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2", "test")
        for topic, name, definition in (
            ("/fine", STRING, b"string data"),
            ("/foreign", "their_msgs/msg/Thing", b"string data"),
            ("/changed", "std_msgs/msg/Float64", b"float32 data"),
            ("/odd", "os.path/msg/../x", b""),
            ("/two", STRING, b"string data"),
            ("/two", "std_msgs/msg/Float64", b"float64 data"),
        ):
            schema = writer.register_schema(name, "ros2msg", definition)
            channel = writer.register_channel(topic, "cdr", schema, {})
            for i in range(40):
                writer.add_message(channel, START_NS + i * 10 * MS, text(f"{i}"), START_NS + i * 10 * MS)
            if topic == "/fine":
                later_ns = START_NS + 57 * 365 * 86400 * 1000 * MS
                writer.add_message(channel, later_ns, text("40"), later_ns)
        writer.finish()
    listens = listener(ros, "/fine")
    incompatible = listener(ros, "/fine", latched=True)
    printed = play(ros, bag, "--clock")
    assert [int(content) for _, content, *_ in received_by(listens)] == list(range(41))
    assert (
        "no message for 1,797,552,000 s after 0.4 s: skipped, as it is longer than --max-gap 600" in printed
    )
    assert "/two is not played: it has several types: std_msgs/msg/String, std_msgs/msg/Float64" in printed
    assert received_by(incompatible) == []
    assert printed.count("/foreign") == printed.count("/changed") == printed.count("/odd") == 1
    assert "their_msgs/msg/Thing is not installed" in printed
    assert "another definition" in printed
    assert printed.count("receives nothing on /fine") == 1
    status, printed = ros.run_fork(BAG, PLAY, bag, "--topics", "/foreign,/changed")
    assert (status, "no message that can be played" in printed) == (2, True), printed


def test_a_monitor_receives_the_same_from_a_played_mission_as_from_the_real_one(
    ros: Ros, alone: Alone
) -> None:
    """Its rates are those of the bag, to the last digit."""
    recorded = [content for topic, content in read_bag(alone.bag) if topic == "/rates"]
    assert len(recorded) >= 31
    # A best-effort subscription of a busy machine may lose the first poses, and with them a mission.
    reliable = "qos_overrides./pose.subscription.reliability:=reliable"
    given = ("-p", f"scenario:={alone.scenario}", "-p", reliable)
    monitor = ros.start("uav_dc_ros.nodes.channel_monitor", "--ros-args", *given)
    listens = listener(ros, "/rates", latched=True)
    play(ros, alone.bag, "--topics", "/pose,/users", *WAIT)
    again = [json.loads(content) for _, content, *_ in received_by(listens)]
    monitor.terminate()
    assert finish(monitor)[0] == 0
    assert each_once(again) == each_once(recorded)


@pytest.fixture(scope="module")
def small_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of two topics that lasts 20 ms."""
    folder = tmp_path_factory.mktemp("small") / "bag"
    return made(folder, {"/a": VOLATILE, "/b": VOLATILE}, numbers("/a", 3, 10.0))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--topics", "/a,/x"], "--topics /x: no such topic in bag .*; it has /a, /b"),
        (["--exclude", "/x"], "--exclude /x: no such topic"),
        (["--exclude", "/a,/b"], "--exclude leaves no topic"),
        (["--remap", "/x:=/y"], "--remap /x: no such topic"),
        (["--remap", "/a:=/no good"], "'/no good': Invalid topic name"),
        (["--start", "9"], "lasts 0.020 s"),
        (["--paused"], "no terminal"),
    ],
)
def test_what_the_bag_has_not_is_refused(small_bag: Path, arguments: list[str], message: str) -> None:
    parser = cli.Parser(prog="play")
    verb.add_options(parser)
    with BagReader(small_bag) as reader, pytest.raises(ParameterError, match=message):
        verb._playback_options(reader, parser.parse_args([str(small_bag), *arguments]))


@pytest.mark.parametrize(
    ("topics", "arguments", "message"),
    [
        ({}, [], "holds no message; expected at least one to play"),
        ({"/a": VOLATILE}, [], "holds no message"),
        ({"/clock": VOLATILE}, ["--clock"], "--clock leaves no topic"),
    ],
)
def test_a_bag_that_holds_nothing_is_refused(
    tmp_path: Path, topics: dict[str, Qos], arguments: list[str], message: str
) -> None:
    bag = made(tmp_path / "bag", topics, [("/clock", 0.0, "now")] if "/clock" in topics else [])
    parser = cli.Parser(prog="play")
    verb.add_options(parser)
    with BagReader(bag) as reader, pytest.raises(UavDcError, match=message):
        verb._playback_options(reader, parser.parse_args([str(bag), *arguments]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rate", "0"], "'0'; expected a number from 0.001 to 1e+06, or max"),
        (["--rate", "nan"], "'nan'; expected"),
        (["--rate", "inf"], "'inf'; expected"),
        (["--duration", "0"], "expected seconds, more than 0"),
        (["--start", "-1"], "expected seconds, of at least 0"),
        (["--max-gap", "nan"], "expected seconds, more than 0"),
        (["--topics", "a"], "beginning with '/'"),
        (["--topics", "/a,/a"], "each once"),
        (["--remap", "/a=/b"], "expected FROM:=TO"),
        (["--namespace", "a b"], "expected a ROS namespace"),
        (["--clock", "0"], "expected a number"),
    ],
)
def test_options_that_make_no_sense_are_refused(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    parser = cli.Parser(prog="play")
    verb.add_options(parser)
    with pytest.raises(SystemExit):
        parser.parse_args(["bag", *arguments])
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1


def test_a_play_that_waits_ends_without_subscribers(ros: Ros, small_bag: Path) -> None:
    status, printed = ros.run_fork(BAG, PLAY, small_bag, "--wait-for-subscribers", 0.2)
    assert status == 2
    assert "no subscriber of /a within 0.2 s" in printed
    assert "/b within" not in printed  # it is silent
    assert "Traceback" not in printed


@pytest.mark.long
def test_a_bag_that_is_larger_than_memory_is_no_problem(ros: Ros, tmp_path: Path) -> None:
    """A gigabyte passes through a process that needs a fifth of that, and most of it for histories."""
    block = os.urandom(2**20)
    with BagWriter(tmp_path / "bag", {}) as bag:
        bag.add_topic("/a", STRING, [VOLATILE])
        for i in range(1024):
            data = text("") + f"{i:08d}".encode() + block
            bag.write("/a", data, log_time_ns=START_NS + i * MS, publish_time_ns=START_NS + i * MS)
    player = ros.start(BAG, PLAY, tmp_path / "bag", "--rate", "max")
    peaks_kb = [0]
    while player.poll() is None:
        status = Path(f"/proc/{player.pid}/status").read_text()
        peaks_kb += [int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")]
        time.sleep(0.02)
    status, printed = finish(player)
    assert status == 0, printed
    assert "published 1024 messages" in printed
    assert 0 < max(peaks_kb) < 400_000
