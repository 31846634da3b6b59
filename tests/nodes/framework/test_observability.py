"""What the nodes report: diagnostics, the clock, peers that do not match."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Ros, finish, read_bag, wait_for
from tests.nodes.conftest import CLOCKS, Observed, python
from uav_dc_ros.nodes.framework.node_table import NODES

CLOCK = """
import time
import rclpy
from rosgraph_msgs.msg import Clock
rclpy.init()
node = rclpy.create_node("clock")
publisher = node.create_publisher(Clock, "/clock", 1)
begun = time.monotonic()
while True:
    now_s = 300 * (time.monotonic() - begun)
    message = Clock()
    message.clock.sec, message.clock.nanosec = int(now_s), int(now_s % 1 * 1e9)
    publisher.publish(message)
    time.sleep(0.01)
"""
DEMANDING = """
import sys, time
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
rclpy.init()
node = rclpy.create_node("demanding", namespace="/somebody")
node.create_subscription(
    PoseStamped, "/pose", print, QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
)
print("listening", flush=True)
rclpy.spin(node)
"""


@pytest.fixture
def options(small_scenario: Path, small_policy: Path) -> list[object]:
    """A small mission of three seconds: steps of a tenth of a second."""
    return ["--scenario", small_scenario, "--policy", small_policy, "--pace", 100]


def diagnostics(bag: Path) -> dict[str, list[tuple[Any, dict[str, str]]]]:
    """Statuses and values by node."""
    found: dict[str, list[tuple[Any, dict[str, str]]]] = {}
    for name, message in read_bag(bag):
        if name.endswith("/diagnostics"):
            for status in message.status:
                values = {pair.key: pair.value for pair in status.values}
                found.setdefault(status.name, []).append((status, values))
    return found


def test_every_node_tells_of_itself_once_a_second(observed: Observed) -> None:
    reported = diagnostics(observed.bag)
    assert set(reported) == {f"uav1/{name}" for name, row in NODES.items() if not row.on_request}
    assert all(len(each) >= 2 for each in reported.values()), {n: len(e) for n, e in reported.items()}
    for each in reported.values():
        assert {status.level for status, _ in each} <= {b"\0", 0, 1}  # a warning: a busy machine is late
        assert each[-1][1]["state"] == "active"
        assert each[-1][1]["restarts"] == "0"
    assert len({each[-1][1]["process id"] for each in reported.values()}) == len(reported), (
        "a process for each"
    )
    _, world = reported["uav1/world"][-1]
    assert "ready" in {values.get("phase") for _, values in reported["uav1/world"]}
    # Steps begin ten times a second, whatever else the machine does.
    assert float(world["pose published [Hz]"]) == pytest.approx(10.0, rel=0.5)
    assert float(world["move received [Hz]"]) > 0.0
    transport, handling = (
        [float(world[f"move {kind} latency {percentile} [ms]"]) for percentile in ("p50", "p99")]
        for kind in ("transport", "handling")
    )
    assert 0.0 < transport[0] <= transport[1]
    assert transport[0] <= handling[0] <= handling[1]
    recorder = {key for _, values in reported["uav1/recorder"] for key in values}
    assert {f"move {kind} latency p50 [ms]" for kind in ("transport", "handling")} <= recorder
    assert float(world["step lateness p99 [ms]"]) >= 0.0
    assert {"step overruns", "hovered steps"} <= set(world)
    assert float(reported["uav1/channel_monitor"][-1][1]["users received [Hz]"]) > 0.0
    assert reported["uav1/mission_monitor"][-1][1]["restarts of policy"] == "0"


def test_the_clock_is_mission_time_and_the_nodes_go_by_it(observed: Observed) -> None:
    assert len(observed.times) == CLOCKS
    times_s = [time_s for _, time_s in observed.times]
    assert times_s == sorted(times_s)
    passed_s, flown_s = observed.times[-1][0] - observed.times[0][0], times_s[-1] - times_s[0]
    # A subscriber on a busy core receives in bursts: this separates mission time from wall time.
    assert flown_s / passed_s > 20.0
    messages = read_bag(observed.bag, "/uav1/diagnostics")
    stamps = {
        name: [status_time(message) for topic, message in messages if is_of(topic, message, name)]
        for name in ("policy", "world")
    }
    assert max(stamps["policy"]) <= 31 * 10.0, "the policy goes by the mission's clock"
    assert min(stamps["world"]) > 1e9, "the world makes that clock, and goes by its own"


def test_the_world_goes_by_somebody_else_s_clock(ros: Ros, small_scenario: Path) -> None:
    """Alone, without a policy: steps of ten seconds, on a clock three hundred times too fast."""
    probe = ros.stranger("probe", "/mission")
    assert probe.stdout is not None
    given = ("-p", f"scenario:={small_scenario}", "-p", "pace:=1", "-p", "peers:=[world]")
    world = ros.start("uav_dc_ros.nodes.world", "--ros-args", *given, "-p", "use_sim_time:=true")
    assert '\\"step\\":0' in probe.stdout.readline()
    clock = python(ros, CLOCK)
    received = wait_for(probe.stdout, '\\"remaining_steps\\":0').splitlines()
    clock.kill()
    clock.communicate()
    world.terminate()
    status, output = finish(world)
    probe.communicate()
    assert status == 0, output
    assert [json.loads(json.loads(line)["data"])["step"] for line in received] == list(range(1, 31))
    assert "30 steps were hovered" in output


def is_of(topic: str, message: Any, node: str) -> bool:
    """Are these the diagnostics of a node."""
    return topic == "/uav1/diagnostics" and message.status[0].name == f"uav1/{node}"


def status_time(message: Any) -> float:
    """Stamp of a message, seconds."""
    return float(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)


def test_a_peer_with_another_qos_is_told_by_name_once(ros: Ros, options: list[object]) -> None:
    peer = python(ros, DEMANDING)
    assert peer.stdout is not None
    wait_for(peer.stdout, "listening")
    given = ("--no-record", "--nodes", "world,channel_monitor,policy", "--compose")
    status, output = ros.run_all(*options, *given, "--pace", 40)  # the second check reports it
    peer.kill()
    peer.communicate()
    assert status == 0, output
    assert (
        output.count("container: WARN: world: /pose: /somebody/demanding does not match: its QoS: ") == 1
    ), output
    assert output.count("does not match") == 1, "no other node"


def test_qos_is_overridden_the_ros_way(ros: Ros, small_scenario: Path) -> None:
    """A best-effort `target` does not match a subscription that requests reliability."""
    peer = python(ros, DEMANDING.replace("/pose", "/target").replace("TRANSIENT_LOCAL", "VOLATILE"))
    assert peer.stdout is not None
    wait_for(peer.stdout, "listening")
    world = ros.start(
        "uav_dc_ros.nodes.world",
        *("--ros-args", "-p", f"scenario:={small_scenario}"),
        *("-p", "qos_overrides./target.publisher.reliability:=best_effort"),
    )
    assert world.stdout is not None
    reported = wait_for(world.stdout, "does not match")
    assert "/target: /somebody/demanding does not match: its QoS: " in reported
    assert "Best effort publisher and reliable subscription; (logged once)" in reported
    world.terminate()
    peer.kill()
    peer.communicate()
    assert finish(world)[0] == 0
