"""How well play keeps recorded times, beside a bare loop of sleeps in the same run; and how fast it can be.

    python benchmarks/play.py [SECONDS] [MESSAGES]

Spacing: a bag of SECONDS with three topics at 200, 100 and 10 messages a second, at irregular times, is
played at rate 1 to a subscriber in a process of its own. A bare loop does the same from a list in memory,
with the priority that play takes (if it may): it sleeps until each message's time, and publishes. The error
is that of the distance between a message and the next, of whatever topic, as published and as received,
against the distance in the bag.

Highest rate: a bag of MESSAGES of 200 bytes on one reliable topic, as fast as can be (`--rate max`), to a
subscriber that takes some time for each; and a bare loop that does not wait for anybody.
"""

import json
import os
import random
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from rclpy.qos import QoSProfile
from rosbags.typesys import Stores, get_typestore

from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.nodes.ros import recorded_qos

TYPES = get_typestore(Stores.ROS2_JAZZY)
STRING = "std_msgs/msg/String"
QOS = recorded_qos.offered(QoSProfile(depth=10), 10)
LISTENER = Path(__file__).parents[1] / "tests" / "nodes" / "play" / "listener.py"
ENVIRONMENT = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
START_NS = 1_700_000_000 * 10**9
HZ = {"/fast": 200, "/medium": 100, "/slow": 10}
SLOW_S = 50e-6  # that the subscriber takes for each message, beside Python's own time
BARE = """
import contextlib, gc, os, sys, time
from pathlib import Path
import rclpy
from rclpy.duration import Duration
from std_msgs.msg import String
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.nodes.ros import fastdds
from uav_dc_ros.nodes.play.bag_play import PRIORITY
fastdds.select_transports(shared_memory=True)
if sys.argv[2] == "sleeps":
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
rclpy.init()
node = rclpy.create_node("bare")
with BagReader(Path(sys.argv[1])) as reader:
    messages = list(reader.messages())
    publishers = {topic: node.create_publisher(String, topic, 1000) for topic in reader.topics}
while not all(publisher.get_subscription_count() for publisher in publishers.values()):
    time.sleep(0.01)
time.sleep(0.5)
gc.freeze()
sleeps, began = sys.argv[2] == "sleeps", time.monotonic()
first_ns = messages[0].log_time_ns
for message in messages:
    if sleeps:
        time.sleep(max(0.0, began + (message.log_time_ns - first_ns) * 1e-9 - time.monotonic()))
    publishers[message.topic].publish(message.data)
for publisher in publishers.values():
    publisher.wait_for_all_acked(Duration(seconds=30))
"""


def string(content: str) -> bytes:
    """A std_msgs/String, serialised."""
    return bytes(TYPES.serialize_cdr(TYPES.types[STRING](content), STRING))


def make(folder: Path, messages: list[tuple[int, str]]) -> Path:
    """A bag of messages of 200 bytes: nanoseconds from its beginning, topic."""
    with BagWriter(folder, {}) as bag:
        for topic in sorted({topic for _, topic in messages}):
            bag.add_topic(topic, STRING, [QOS])
        for i, (at_ns, topic) in enumerate(messages):
            data = string(f"{i:010d}" + 182 * "x")
            bag.write(topic, data, log_time_ns=START_NS + at_ns, publish_time_ns=START_NS + at_ns)
    return folder


def heard(command: list[object], bag: Path, each_s: float = 0.0) -> list[tuple[str, str, int, int]]:
    """What a subscriber hears of a command: topic, data, when published and received, nanoseconds."""
    with BagReader(bag) as reader:
        topics = {topic: {"type": STRING} for topic in reader.topics}
    spec = json.dumps({"topics": topics, "each_s": each_s})
    listener = subprocess.Popen(
        [sys.executable, str(LISTENER), spec],
        env=ENVIRONMENT,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert listener.stdout is not None
    listener.stdout.readline()
    subprocess.run(
        [sys.executable, *map(str, command)], check=True, env=ENVIRONMENT, stdout=subprocess.DEVNULL
    )
    told, _ = listener.communicate()
    return [tuple(each) for each in json.loads(told)]


def spacing(name: str, messages: list[tuple[str, str, int, int]], times_ns: np.ndarray) -> None:
    """Print errors of the distances, milliseconds."""
    if len(messages) != len(times_ns):
        print(f"{name:<12} {len(messages)} of {len(times_ns)} messages")
        return
    for what, column in (("published", 2), ("received", 3)):
        at_ns = np.array(sorted(message[column] for message in messages))
        error_ms = np.abs(np.diff(at_ns) - np.diff(times_ns)) * 1e-6
        middle, high, most = (*np.percentile(error_ms, [50, 99]), error_ms.max())
        print(f"{name:<12} {what:<10} p50 {middle:7.3f} ms   p99 {high:7.3f} ms   max {most:8.3f} ms")


def main() -> None:
    """Measure, and print."""
    seconds, n = (int(text) for text in (*sys.argv[1:], *("20", "100000")[len(sys.argv) - 1 :]))
    draw = random.Random(0)
    play: list[object] = ["-m", "uav_dc_ros.bag", "play"]
    wait: list[object] = ["--wait-for-subscribers", 20]
    with tempfile.TemporaryDirectory() as scratch:
        messages = sorted(
            (round(draw.random() * seconds * 1e9), topic)
            for topic, hz in HZ.items()
            for _ in range(hz * seconds)
        )
        times_ns = np.array([at_ns for at_ns, _ in messages])
        bag = make(Path(scratch) / "spacing", messages)
        print(f"spacing at rate 1: {len(messages)} messages in {seconds} s")
        spacing("play", heard([*play, bag, *wait], bag), times_ns)
        spacing("bare sleeps", heard(["-c", BARE, bag, "sleeps"], bag), times_ns)

        bag = make(Path(scratch) / "fast", [(i * 1000, "/a") for i in range(n)])
        print(f"highest rate: {n} messages to a subscriber that takes {SLOW_S * 1e6:.0f} us for each")
        for name, command in (
            ("play", [*play, bag, *wait, "--rate", "max"]),
            ("bare loop", ["-c", BARE, bag, "no"]),
        ):
            for each_s in (0.0, SLOW_S):
                got = heard(command, bag, each_s)
                took_s = (max(m[2] for m in got) - min(m[2] for m in got)) * 1e-9
                lost = n - len({data for _, data, *_ in got})
                who = "slow" if each_s else "quick"
                print(f"{name:<12} {who:<6} subscriber {len(got) / took_s:9.0f} messages/s   lost {lost}")


if __name__ == "__main__":
    main()
