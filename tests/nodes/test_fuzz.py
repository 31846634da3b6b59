"""Garbage by the thousand on every topic, while missions are flown: refused and counted, and nothing else."""

import json
import re
import signal
import subprocess
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rosbags.highlevel import AnyReader

from tests.conftest import PATIENCE_S, Ros
from tests.nodes import garbage
from uav_dc_ros import cdr, messages, scenarios
from uav_dc_ros.errors import MessageError
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.ros import fastdds

PEERS = ("world", "channel_monitor", "policy", "recorder", "mission_monitor")
BY_HAND = ("world", "channel_monitor", "policy")
# What a burst of garbage pushes off the wire is sent again, from as far back as the publisher keeps it.
KEPT = 10_000
# Then the first poses have left the monitor's memory: users of the past find none.
FROM_MISSION = 9
COMPARED = ("users", "rates", "mission", "move")
LOCALHOST = Path(fastdds.__file__).with_name("fastdds_localhost.xml")


class Running:
    """A process whose output is read as it comes, so that its pipe never fills."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.lines: list[str] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(self.process.stdout)

    def end(self, number: int | None = None, timeout_s: float = 200.0) -> tuple[int, str]:
        """Ask it to end, or wait until it does; its exit status and what it printed."""
        if number is not None:
            self.process.send_signal(number)
        try:
            status = self.process.wait(timeout_s)
        finally:
            self.process.kill()
            self._thread.join(90)
        return status, "".join(self.lines)


def parameters(node: str) -> list[str]:
    """ROS parameters with which a node loses nothing: neither of what it hears, nor of what it says."""
    row = NODES[node]
    values: dict[str, object] = {"peers": json.dumps(PEERS), "run": garbage.RUN}
    values |= {f"qos_overrides./{topic}.subscription.history": "keep_all" for topic in row.subscribes}
    values |= {
        f"qos_overrides./{topic}.publisher.depth": KEPT for topic in row.publishes if topic in COMPARED
    }
    if "pose" in row.subscribes:
        values["qos_overrides./pose.subscription.reliability"] = "reliable"
    return [argument for name, value in values.items() for argument in ("-p", f"{name}:={value}")]


def said_by_nodes(bag: Path) -> dict[str, list[Any]]:
    """Payloads that nodes have said, without what a stranger said: nodes write no blanks. Repeats too."""
    said: dict[str, list[Any]] = {topic: [] for topic in COMPARED}
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            topic = connection.topic.removeprefix("/")
            if topic not in said:
                continue
            try:
                text = cdr.decode_string(data)
                payload = messages.decode(text, messages.PAYLOADS[topic])
            except MessageError:
                continue
            if messages.encode(payload) == text:
                said[topic].append(payload)
    return said


def flown(said: list[Any]) -> dict[tuple[int, int], Any]:
    """The payload of each step, of whatever run. A lockstep that stood still says a step again, the same."""
    steps: dict[tuple[int, int], Any] = {}
    for payload in said:
        if getattr(payload, "phase", None) is messages.Phase.ABORTED:
            continue
        payload = msgspec.structs.replace(payload, run="")
        assert steps.setdefault((payload.mission, payload.step), payload) == payload
    assert list(steps) == sorted(steps)
    return steps


def fly_under_fire(ros: Ros, scenario: Path, policy: Path, per_topic: int, oversized: int) -> dict[str, Any]:
    """Fly until all garbage has been fired and read; what the stranger tells, and what was flown."""
    # Bursts follow each other at once; what was lost is sent again before a node ends.
    eager = ros.folder / "eager.xml"
    eager.write_text(
        re.sub(r"(<heartbeatPeriod>.*?<nanosec>)\d+", r"\g<1>5000000", LOCALHOST.read_text(), flags=re.S)
    )
    ros.environment.update(dict.fromkeys(fastdds.NAMES, str(eager)) | {fastdds.RANGE: "SUBNET"})
    world = ("-p", f"scenario:={scenario}")
    given = {
        "world": (*world, "-p", "missions:=1000000"),
        "channel_monitor": world,
        "policy": (*world, "-p", f"policy:={policy}"),
    }
    nodes = {
        name: Running(ros.start(f"uav_dc_ros.nodes.{name}", "--ros-args", *parameters(name), *given[name]))
        for name in BY_HAND
    }
    options = ("--scenario", scenario, "--policy", policy, "--pace", "lockstep", "--missions", 1000000)
    bag = ros.folder / "disturbed"
    flight = Running(ros.start("uav_dc_ros.run_all", *options, "--nodes", "recorder", "--bag", bag))
    stranger = Running(
        ros.start("tests.nodes.stranger", scenario, 1, per_topic, oversized, FROM_MISSION, ",".join(PEERS))
    )
    running = {"stranger": stranger, **nodes, "run_all": flight}
    try:
        status, output = stranger.end(timeout_s=PATIENCE_S + per_topic / 100)
        assert status == 0, "\n".join([output, *("".join(each.lines[-50:]) for each in running.values())])
        told = json.loads(output.splitlines()[-1])
        for name, node in nodes.items():
            assert node.process.poll() is None, f"{name}: {''.join(node.lines)}"
        ended = {name: node.end(signal.SIGTERM) for name, node in nodes.items()}
        ended["run_all"] = flight.end(signal.SIGINT)  # the recorder last: it must hear the last word
    finally:
        for each in running.values():
            each.process.kill()
    assert {name: status for name, (status, _) in ended.items()} == dict.fromkeys(BY_HAND, 0) | {
        "run_all": 130
    }
    for name, (_, output) in ended.items():
        assert "Traceback" not in output, f"{name}: {output}"
        assert "it is restarted" not in output
    return told | {"output": {name: output for name, (_, output) in ended.items()}, "bag": bag}


def check(ros: Ros, scenario: Path, policy: Path, per_topic: int, oversized: int) -> dict[str, Any]:
    """Garbage on every topic has no effect but that it is counted, each message once, by its reason."""
    disturbed = fly_under_fire(ros, scenario, policy, per_topic, oversized)
    said = said_by_nodes(disturbed["bag"])
    missions = flown(said["mission"])
    n_missions = max(mission for mission, _ in missions) + 1
    assert n_missions > FROM_MISSION + 1

    bag = ros.folder / "undisturbed"
    options = ("--scenario", scenario, "--policy", policy, "--pace", "lockstep", "--missions", n_missions)
    status, output = ros.run_all(*options, "--nodes", ",".join(PEERS[:4]), "--bag", bag, timeout_s=600)
    assert status == 0, output
    undisturbed = said_by_nodes(bag)
    for topic in COMPARED:
        under_fire, alone = flown(said[topic]), flown(undisturbed[topic])
        assert len(alone) - len(under_fire) <= scenarios.load(scenario).mission.max_steps + 1  # of the last
        for (step, one), (other_step, other) in zip(under_fire.items(), alone.items(), strict=False):
            assert step == other_step
            assert messages.encode(one) == messages.encode(other)

    expected: dict[str, dict[str, int]] = {name: {} for name in PEERS}
    for kind, count in disturbed["sent"].items():
        topic = kind.split()[0]
        for name in PEERS:
            if topic in NODES[name].subscribes and name != "recorder":  # which writes bytes as they come
                expected[name][kind] = count
    # A step that is said again is answered again: moves of the policy's own that come too late.
    again = len(said["move"]) - len(flown(said["move"]))
    if "move wrong_step" in expected["world"]:
        expected["world"]["move wrong_step"] += again
    undecodable = expected["channel_monitor"].pop(f"pose {garbage.UNDECODABLE}")
    # The middleware drops what it cannot decode without a word; a node that decodes by itself counts it.
    allowed = ({}, {"pose malformed": undecodable})
    for name in PEERS:
        counted = disturbed["diagnosed"][name].copy()
        if "pose no_pose" in counted:  # users wait for their pose: it may be a pose that brings to light
            counted["users no_pose"] += counted.pop("pose no_pose")  # that there is none for them
        surplus = allowed if name == "channel_monitor" else ({},)
        assert counted in [expected[name] | more for more in surplus], name
    assert disturbed["other_type_heard"] == 0  # the middleware brings only ends of one type together
    for name in BY_HAND:
        line = re.search(r"rejected messages: (.*)", disturbed["output"][name])
        assert line is not None
        printed = dict(entry.rsplit(" ", 1) for entry in line[1].split(", "))
        assert {kind: int(count) for kind, count in printed.items()} == disturbed["diagnosed"][name]
    return disturbed | {"missions": n_missions, "again": again}


@pytest.mark.long  # a few of each kind are in test_garbage
def test_dozens_on_each_topic(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    check(ros, small_scenario, small_policy, 40, 0)


@pytest.mark.long
def test_a_hundred_thousand_on_each_topic(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    told = check(ros, small_scenario, small_policy, 100_000, 2)
    print({key: told[key] for key in ("sent", "fired_s", "missions", "again")})
