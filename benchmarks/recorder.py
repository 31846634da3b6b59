"""The highest message rate that the recorder takes without a drop, beside what bounds it, in the same run.

    python benchmarks/recorder.py [ROUNDS]

Bounds are the bare `mcap` writer, which writes the same bytes into a file as fast as it can, and raw rclpy
subscriptions that only count: one with rclpy's SingleThreadedExecutor, one with the nodes' own executor.
Messages, of 200 bytes and of 200 kB, come from a publisher in another process, reliable, at a fixed rate.

A rate is sustained if every message is there: counted a second after the last one was published, or found in
the bag of a recorder that was killed a second and a half after it, since twice a second its bag is handed to
the operating system. So there is no long queue either. The search doubles the rate, and then halves the gap.
"""

import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mcap.writer import Writer

from uav_dc_ros import cdr
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.salvage.repair import repair

SECONDS = 3.0  # that a rate is held
SETTLE_S = 1.0
SYNCED_S = 0.5
HALVINGS = 3
FIRST_HZ = {200: 2000.0, 200_000: 50.0}
BARE_BYTES = 100e6
ENVIRONMENT = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
PUBLISHER = """
import random, sys, time
import rclpy
from std_msgs.msg import String
from uav_dc_ros.nodes.ros import fastdds
from uav_dc_ros import cdr
size, rate_hz, seconds = int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
fastdds.select_transports(shared_memory=True)
rclpy.init()
node = rclpy.create_node("publisher")
publisher = node.create_publisher(String, "t", 1000 if size < 1000 else 50)
data = cdr.encode_string(random.Random(1).randbytes(size // 2).hex().encode())
while not publisher.get_subscription_count():
    time.sleep(0.01)
time.sleep(0.5)
begun_s, said = time.perf_counter(), 0
while said < rate_hz * seconds:
    due = min((time.perf_counter() - begun_s) * rate_hz + 1, rate_hz * seconds)
    while said < due:
        publisher.publish(data)
        said += 1
    time.sleep(0.001)
print(said, time.perf_counter() - begun_s, flush=True)
sys.stdin.read()
"""
COUNTER = """
import sys, threading
import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile
from std_msgs.msg import String
from uav_dc_ros.nodes.ros import fastdds
from uav_dc_ros.nodes.ros.executor import DirectExecutor
fastdds.select_transports(shared_memory=True)
rclpy.init()
node = rclpy.create_node("counter")
counted = 0
def hear(data):
    global counted
    counted += 1
node.create_subscription(String, "t", hear, QoSProfile(history=HistoryPolicy.KEEP_ALL), raw=True)
def tell():
    sys.stdin.readline()
    print(counted, flush=True)
threading.Thread(target=tell, daemon=True).start()
if sys.argv[1] == "DirectExecutor":
    executor = DirectExecutor(0.005)
    executor.add_node(node)
    executor.spin(lambda: False)
else:
    rclpy.spin(node)
"""


def bare_hz(folder: Path, size: int) -> float:
    """Messages a second that the mcap writer takes, with its own defaults."""
    data = cdr.encode_string(random.Random(1).randbytes(size // 2).hex().encode())
    n = int(min(BARE_BYTES / size, 200_000))
    with (folder / "bare.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/t", "cdr", schema)
        begun_s = time.perf_counter()
        for i in range(n):
            writer.add_message(channel, i, data, i, i)
        writer.finish()
        took_s = time.perf_counter() - begun_s
    (folder / "bare.mcap").unlink()
    return n / took_s


def published(size: int, rate_hz: float) -> tuple[subprocess.Popen[str], int, bool]:
    """Publish at a rate; the publisher, which is still there, how many, and whether it kept the rate."""
    process = subprocess.Popen(
        [sys.executable, "-c", PUBLISHER, str(size), str(rate_hz), str(SECONDS)],
        env=ENVIRONMENT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    said, took_s = process.stdout.readline().split()
    return process, int(said), float(took_s) < 1.05 * SECONDS


def counted(executor: str) -> Callable[[Path, int, float], tuple[bool, bool]]:
    """A trial of a raw subscription that only counts."""

    def trial(folder: Path, size: int, rate_hz: float) -> tuple[bool, bool]:
        counter = subprocess.Popen(
            [sys.executable, "-c", COUNTER, executor],
            env=ENVIRONMENT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        publisher, said, kept = published(size, rate_hz)
        time.sleep(SETTLE_S)
        assert counter.stdin is not None
        assert counter.stdout is not None
        counter.stdin.write("\n")
        counter.stdin.flush()
        heard = int(counter.stdout.readline())
        counter.kill()
        for process in (counter, publisher):
            process.communicate()
        return heard == said, kept

    return trial


def recorded(folder: Path, size: int, rate_hz: float) -> tuple[bool, bool]:
    """A trial of the recorder."""
    bag = folder / "bag"
    recorder = subprocess.Popen(
        [sys.executable, "-m", "uav_dc_ros.bag", "record", "--out", str(bag), "--topics", "/t"],
        env=ENVIRONMENT,
        stderr=subprocess.DEVNULL,
    )
    publisher, said, kept = published(size, rate_hz)
    time.sleep(SETTLE_S + SYNCED_S)
    recorder.send_signal(signal.SIGKILL)
    recorder.wait()
    publisher.communicate()
    repair(bag)
    with BagReader(bag) as reader:
        there = reader.message_count
    for path in bag.iterdir():
        path.unlink()
    bag.rmdir()
    return there == said, kept


def highest_hz(
    trial: Callable[[Path, int, float], tuple[bool, bool]], folder: Path, size: int
) -> tuple[float, bool]:
    """The highest rate that is sustained, and whether it was the publisher that could do no more."""
    good_hz, bad_hz, limited = 0.0, 0.0, False
    rate_hz = FIRST_HZ[size]
    halvings = 0
    while halvings < HALVINGS:
        all_there, kept = trial(folder, size, rate_hz)
        if all_there and kept:
            good_hz = rate_hz
        else:
            bad_hz, limited = rate_hz, all_there
        halvings += bool(bad_hz)
        rate_hz = (good_hz + bad_hz) / 2 if bad_hz else 2 * rate_hz
    return good_hz, limited


def main() -> None:
    """Print the rates of each size, medians over the rounds, and the ratios."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    trials: dict[str, Callable[[Path, int, float], tuple[bool, bool]]] = {
        "raw subscription, SingleThreadedExecutor": counted("SingleThreadedExecutor"),
        "raw subscription, DirectExecutor": counted("DirectExecutor"),
        "recorder": recorded,
    }
    print(f"{os.cpu_count()} cores, medians of {rounds} rounds")
    # On the disk of the working directory; git ignores the name, since a killed benchmark leaves the folder.
    with tempfile.TemporaryDirectory("_cache", ".recorder_", Path.cwd()) as name:
        folder = Path(name)
        for size in FIRST_HZ:
            rates: dict[str, list[float]] = {"bare mcap writer": [], **{trial: [] for trial in trials}}
            limits: set[str] = set()
            for _ in range(rounds):
                rates["bare mcap writer"].append(bare_hz(folder, size))
                for told, trial in trials.items():
                    rate_hz, limited = highest_hz(trial, folder, size)
                    rates[told].append(rate_hz)
                    limits |= {told} if limited else set()
            own_hz = statistics.median(rates["recorder"])
            for told, each in rates.items():
                hz = statistics.median(each)
                bound = "  (the publisher can do no more)" if told in limits else ""
                print(
                    f"{size:>7} bytes  {told:<42} {hz:>8.0f} messages/s {hz * size * 1e-6:>6.1f} MB/s  "
                    f"recorder {own_hz / hz if hz else float('nan'):.2f} of it{bound}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
