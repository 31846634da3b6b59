"""Whole steps per second in lockstep, beside the bare round trip of two rclpy processes in the same run.

    python benchmarks/lockstep.py [ROUNDS]

A step is three messages one after the other (world to monitor to policy to world), three more beside them,
and the computations of all nodes; a bare round trip is two messages and nothing else. Each round measures
the round trip with rclpy's SingleThreadedExecutor, with its experimental EventsExecutor and with the nodes'
own, and then flies missions through world, channel monitor, policy and recorder: as a lockstep does it, with
the first three in one process, and with a process for each.
"""

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from flights import ENVIRONMENT, NODES, Flown, fly

MISSIONS = 60
ROUND_TRIPS = 3000
WAYS = {"composed": "--compose", "a process for each node": "--no-compose"}
EXECUTORS = ("SingleThreadedExecutor", "EventsExecutor", "DirectExecutor")
BARE = """
import os, statistics, sys, threading, time
import rclpy
from std_msgs.msg import String
role, executor, trips = sys.argv[1], sys.argv[2], int(sys.argv[3])
rclpy.init()
node = rclpy.create_node(role)
mine, other = ("ping", "pong") if role == "ping" else ("pong", "ping")
publisher = node.create_publisher(String, mine, 10)
times, sent = [], [0.0]
def hear(message):
    if role == "ping":
        times.append(time.perf_counter() - sent[0])
        if len(times) == trips:
            print(statistics.median(times[trips // 10:]) * 1e3, flush=True)
            os._exit(0)
        sent[0] = time.perf_counter()
    publisher.publish(message)
node.create_subscription(String, other, hear, 10)
def begin():
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    time.sleep(0.5)
    sent[0] = time.perf_counter()
    publisher.publish(String(data="x" * 200))
if role == "ping":
    threading.Thread(target=begin, daemon=True).start()
if executor == "DirectExecutor":
    from uav_dc_ros.nodes.ros.executor import DirectExecutor
    spinner = DirectExecutor()
    spinner.add_node(node)
    spinner.spin(lambda: False)
else:
    import rclpy.executors, rclpy.experimental
    makers = {"SingleThreadedExecutor": rclpy.executors.SingleThreadedExecutor}
    makers["EventsExecutor"] = rclpy.experimental.EventsExecutor
    spinner = makers[executor]()
    spinner.add_node(node)
    spinner.spin()
"""


def round_trip_ms(executor: str) -> float:
    """Median round trip of two processes, milliseconds; NaN if no message came back."""
    command = [sys.executable, "-c", BARE]
    pong = subprocess.Popen([*command, "pong", executor, "0"], env=ENVIRONMENT)
    try:
        ping = subprocess.run(
            [*command, "ping", executor, str(ROUND_TRIPS)],
            env=ENVIRONMENT,
            timeout=20,
            check=True,
            capture_output=True,
            text=True,
        )
        return float(ping.stdout)
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError):
        return float("nan")
    finally:
        pong.kill()
        pong.wait()


def median(values: list[float]) -> float:
    """Median of the numbers among the values."""
    return statistics.median([value for value in values if value == value] or [float("nan")])


def where(flown: Flown, rate_hz: float) -> None:
    """Print where the time of a step goes."""
    cpu_ms = {
        " + ".join(nodes): flown.cpu_percent(nodes[0], skip=1) * 10 / rate_hz
        for nodes in flown.processes((*NODES, "mission_monitor"))
    }
    told = ", ".join(f"{name} {ms:.2f}" for name, ms in cpu_ms.items())
    print(f"CPU per step, ms: {told}; together {sum(cpu_ms.values()):.2f}, of {os.cpu_count()} cores' time")
    ways = (
        ("channel_monitor", "pose"),
        ("channel_monitor", "users"),
        ("policy", "mission"),
        ("policy", "rates"),
        ("world", "move"),
    )
    medians = [
        f"{topic} {flown.last(node, f'{topic} handling latency p50 [ms]'):.2f}" for node, topic in ways
    ]
    print(f"from publishing to the end of the handling, ms, median: {', '.join(medians)}")


def main() -> None:
    """Print the rates of each round, their medians, and where the time goes."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    trips: dict[str, list[float]] = {executor: [] for executor in EXECUTORS}
    steps_ms: dict[str, list[float]] = {way: [] for way in WAYS}
    ratios: dict[str, list[float]] = {way: [] for way in WAYS}
    flown: dict[str, Flown] = {}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(rounds):
            for executor in EXECUTORS:
                known_silent = executor == "EventsExecutor" and trips[executor]
                trips[executor].append(float("nan") if known_silent else round_trip_ms(executor))
            print(
                f"bare round trip {trips['SingleThreadedExecutor'][-1]:.3f} ms, with the nodes' executor "
                f"{trips['DirectExecutor'][-1]:.3f} ms"
            )
            for way, option in WAYS.items():
                flown[way] = fly(Path(folder), "--pace", "lockstep", "--missions", MISSIONS, option)
                steps_ms[way].append(statistics.median(flown[way].step_ms))
                ratios[way].append(steps_ms[way][-1] / trips["SingleThreadedExecutor"][-1])
                print(f"  {way}: step {steps_ms[way][-1]:.3f} ms, {ratios[way][-1]:.1f} times the bare one")
    print(f"medians of {rounds} rounds, {os.cpu_count()} cores")
    for executor in EXECUTORS:
        silent = not any(trip == trip for trip in trips[executor])
        told = "it called no callback" if silent else f"{median(trips[executor]):.3f} ms"
        print(f"bare round trip, {executor}: {told}")
    for way in WAYS:
        print(
            f"{way}: step {median(steps_ms[way]):.3f} ms, {1e3 / median(steps_ms[way]):.0f} steps/s, "
            f"{median(ratios[way]):.1f} times the bare round trip"
        )
        where(flown[way], 1e3 / statistics.mean(flown[way].step_ms))


if __name__ == "__main__":
    main()
