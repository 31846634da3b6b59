"""Time and memory of `bag cut`, `merge`, `filter` and `convert`, beside the bare `mcap` reader and writer.

    python benchmarks/edit_bags.py [--megabytes N] [--verbs VERB ...]

The bag has missions with 50 users, as a recorder writes them. Each command is a process of its own; the bare
one reads the same bag in the order of time and writes every message into a file of the same chunks and
compression. Times are CPU seconds; memory is the peak of the resident set.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rosbags.rosbag2.metadata import parse_qos

from uav_dc_ros import cdr, messages, payloads, scenarios, topics
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.core import world
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.scenario import Scenario

QOS = """
- history: keep_last
  depth: 100
  reliability: reliable
  durability: {}
  deadline: {{sec: 0, nsec: 0}}
  lifespan: {{sec: 0, nsec: 0}}
  liveliness: automatic
  liveliness_lease_duration: {{sec: 0, nsec: 0}}
  avoid_ros_namespace_conventions: false
"""
BARE = """
import sys
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
with open(sys.argv[1], "rb") as source, open(sys.argv[2], "xb") as file:
    reader = make_reader(source, validate_crcs=True)
    writer = Writer(file, chunk_size=128 * 1024, compression=CompressionType.ZSTD)
    writer.start("ros2")
    channels = {}
    for schema, channel, message in reader.iter_messages():
        if channel.id not in channels:
            own = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, own, channel.metadata
            )
        writer.add_message(
            channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
        )
    writer.finish()
"""


def mission(scenario: Scenario) -> Iterator[tuple[str, bytes]]:
    """Topic and data of the messages of a mission; texts have the mission 0."""
    rng = np.random.default_rng(0)
    state = world.initial(scenario, rng.random(scenario.draws_shape))
    link = None
    while True:
        at = {"mission": 0, "step": int(state.step)}
        uav_m = scenario.grid.centre_m(state.cell, like=state.users_m)
        link = link or world.measure(scenario, uav_m, state.users_m, state.collected)
        time_ns = scenario.time_ns(0, at["step"])
        is_over = at["step"] == scenario.mission.max_steps
        action = int(rng.integers(len(ACTION_LABELS)))
        status = messages.Mission(
            **at,
            phase=messages.Phase.TIMEOUT if is_over else messages.Phase.READY,
            cell=tuple(state.cell.tolist()),
            remaining_steps=scenario.mission.max_steps - at["step"],
            seed=0,
            scenario=scenario.name,
            fingerprint=scenario.fingerprint,
        )
        yield "pose", cdr.encode_pose(uav_m, time_ns)
        found: dict[str, messages.Payload] = {
            "users": payloads.users(scenario, state.users_m, time_ns=time_ns, **at),
            "mission": status,
            "rates": payloads.rates(link, state.data_bits, state.collected, **at),
        }
        if not is_over:
            found["move"] = messages.Move(**at, action=ACTION_LABELS[action])
        yield from ((topic, messages.encode(payload)) for topic, payload in found.items())
        if is_over:
            return
        state, outcome = world.step(scenario, state, np.asarray(action), rng.random(scenario.draws_shape))
        link = outcome.link


def make(folder: Path, n_bytes: float) -> int:
    """Write a bag of a size with a message each millisecond; how many missions it has."""
    scenario = scenarios.load("five_clusters_hover")
    recorded = list(mission(scenario))
    now_ns, n = 10**18, 0
    with BagWriter(folder, {"scenario": scenario.name, "seed": "0"}) as bag:
        for name in dict.fromkeys(topic for topic, _ in recorded):
            row = topics.TOPICS[name]
            offered = parse_qos(QOS.format("transient_local" if row.latched else "volatile"))
            bag.add_topic(f"/{name}", row.type, offered)
        while (folder / f"{folder.name}_0.mcap").stat().st_size < n_bytes:
            for name, data in recorded:
                now_ns += 10**6
                if name != "pose":
                    data = cdr.encode_string(data.replace(b'"mission":0', b'"mission":%d' % n, 1))
                bag.write(f"/{name}", data, log_time_ns=now_ns, publish_time_ns=now_ns - 1000)
            n += 1
    return n


def measured(command: list[object]) -> tuple[float, float, float]:
    """CPU seconds, wall seconds and peak memory, MB, of a process that succeeds."""
    begun_s = time.perf_counter()
    process = subprocess.Popen([sys.executable, *map(str, command)], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, command
    return usage.ru_utime + usage.ru_stime, time.perf_counter() - begun_s, usage.ru_maxrss / 1024


def main() -> None:
    """Print a line for each command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--megabytes", type=float, default=50.0)
    parser.add_argument("--verbs", nargs="+", help="only these")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory("_cache", ".edit_", Path.cwd()) as name:
        folder = Path(name)
        n = make(folder / "bag", options.megabytes * 1e6)
        with BagReader(folder / "bag") as reader:
            seconds, count = (reader.last_ns - reader.first_ns) / 1e9, reader.message_count
        size = (folder / "bag" / "bag_0.mcap").stat().st_size
        print(
            f"{os.cpu_count()} cores, {size / 1e6:.0f} MB, {count:,} messages of {n:,} missions", flush=True
        )
        bare_s, _, _ = bare = measured(["-c", BARE, folder / "bag" / "bag_0.mcap", folder / "bare.mcap"])
        print(
            f"{'bare mcap reader and writer':<38} CPU {bare[0]:7.1f} s            {bare[2]:4.0f} MB",
            flush=True,
        )
        (folder / "bare.mcap").unlink()
        commands: dict[str, list[object]] = {
            "convert": ["convert", "bag"],
            "convert --json-channels": ["convert", "bag", "--json-channels"],
            "filter --exclude /move": ["filter", "bag", "--exclude", "/move"],
            "cut --end (the first half)": ["cut", "bag", "--end", seconds / 2],
            "cut --start (the second half)": ["cut", "bag", "--start", seconds / 2],
            "cut --missions (the last tenth)": ["cut", "bag", "--missions", f"{n - n // 10}-{n - 1}"],
            "merge (both halves)": ["merge", "0", "1"],
        }
        for title, (verb, *arguments) in commands.items():
            if options.verbs and verb not in options.verbs:
                continue
            out = folder / {"--end": "0", "--start": "1"}.get(
                str(title.split()[1:2] and title.split()[1]), "out"
            )
            sources = [folder / one if one in ("bag", "0", "1") else one for one in arguments]
            cpu_s, wall_s, peak_mb = measured(["-m", "uav_dc_ros.bag", verb, *sources, "--out", out])
            ratio = f"{cpu_s / bare_s:5.2f} x bare"
            print(
                f"{title:<38} CPU {cpu_s:7.1f} s  {ratio}  {peak_mb:4.0f} MB  wall {wall_s:.1f} s", flush=True
            )
            if out.name == "out":
                for path in out.iterdir():
                    path.unlink()
                out.rmdir()


if __name__ == "__main__":
    main()
