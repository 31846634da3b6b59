"""Playing a bag: what a subscriber in another process hears of it."""

import base64
import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from rosbags.interfaces import Qos

from tests.bags.made import STRING, TYPES, text
from tests.conftest import Ros
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.nodes import convert

BAG, PLAY = "uav_dc_ros.bag", "play"
POSE = "geometry_msgs/msg/PoseStamped"
MS = 10**6
START_NS = 1_700_000_000 * 10**9
VOLATILE = convert.offered_qos(depth=10, reliable=True, latched=False)
LATCHED = convert.offered_qos(depth=3, reliable=True, latched=True)
Heard = list[tuple[str, str, int, int]]  # topic, text, when published, when received, nanoseconds


def made(folder: Path, topics: dict[str, Qos], messages: list[tuple[str, float, str]]) -> Path:
    """A bag with strings: topic, milliseconds from the beginning, text."""
    with BagWriter(folder, {}) as bag:
        for topic, qos in topics.items():
            bag.add_topic(topic, STRING, [qos])
        for topic, at_ms, content in messages:
            at_ns = START_NS + round(at_ms * MS)
            bag.write(topic, text(content), log_time_ns=at_ns, publish_time_ns=at_ns)
    return folder


def listener(ros: Ros, *topics: str, each_s: float = 0.0, **row: Any) -> "subprocess.Popen[str]":
    """A subscriber to some topics of strings, that listens by now."""
    rows = {topic: {"type": STRING, **row} for topic in topics}
    process = ros.stranger("listener", json.dumps({"topics": rows, "each_s": each_s}))
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    return process


def heard_by(process: "subprocess.Popen[str]") -> Heard:
    """End a listener; all that it heard, in the order of receipt."""
    told, _ = process.communicate(timeout=60)
    heard = json.loads(told.splitlines()[-1])
    return [(t, TYPES.deserialize_cdr(base64.b64decode(d), STRING).data, a, b) for t, d, a, b in heard]


def play(ros: Ros, *arguments: object) -> str:
    """Play to the end; what was printed."""
    status, printed = ros.run(BAG, PLAY, *arguments)
    assert status == 0, printed
    assert "Traceback" not in printed
    return printed


def numbers(topic: str, n: int, each_ms: float) -> list[tuple[str, float, str]]:
    """Numbered messages at equal distances."""
    return [(topic, i * each_ms, str(i)) for i in range(n)]


def test_two_plays_publish_the_same_messages_in_the_order_of_the_bag(ros: Ros, tmp_path: Path) -> None:
    """Over all topics, by the time at which each was published; a subscriber gets each topic in order."""
    messages = [("/abc"[0] + "abc"[i * i % 3], i * 0.01, f"{i}") for i in range(3000)]
    bag = made(tmp_path / "bag", dict.fromkeys(("/a", "/b", "/c"), VOLATILE), messages)
    for _ in range(2):
        listens = listener(ros, "/a", "/b", "/c")
        play(ros, bag, "--rate", "max", "--wait-for-subscribers", 20)
        heard = heard_by(listens)
        assert len({sent for _, _, sent, _ in heard}) == len(heard)  # so there is one order
        published = sorted(heard, key=lambda each: each[2])
        assert [(topic, told) for topic, told, *_ in published] == [(t, told) for t, _, told in messages]
        for topic in ("/a", "/b", "/c"):
            each = [told for name, told, *_ in heard if name == topic]
            assert each == [told for name, _, told in messages if name == topic]


@pytest.mark.parametrize(
    ("depth", "latched", "each_s"),
    [(1, False, 0.0005), (1, True, 0.0), (10, False, 0.0), (1000, True, 0.0005)],
)
def test_a_slow_reliable_subscriber_loses_nothing_however_fast_it_is_played(
    ros: Ros, tmp_path: Path, depth: int, latched: bool, each_s: float
) -> None:
    """More messages than any history holds, so that the publisher has to wait."""
    n = 8000 if each_s else 3000
    qos = convert.offered_qos(depth=depth, reliable=True, latched=latched)
    bag = made(tmp_path / "bag", {"/a": qos}, numbers("/a", n, 0.001))
    listens = listener(ros, "/a", latched=latched, each_s=each_s)
    play(ros, bag, "--rate", "max", "--wait-for-subscribers", 20)
    assert [int(told) for _, told, *_ in heard_by(listens)] == list(range(n))
