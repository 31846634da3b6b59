"""Nodes that are killed at random moments, and started again: the mission is what it would have been.

In lockstep a mission does not depend on time, so one with kills must end with the numbers of one without,
to the last bit. Each fixture `ros` asserts at its end that no process of the test is left.
"""

import json
import os
import random
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Ros, but_run, finish, read_bag, until
from tests.nodes.test_fuzz import Running
from uav_dc_ros.nodes.framework.node_table import NODES

COMPOSED = ["world", "channel_monitor", "policy"]
KILLED = [*COMPOSED, "recorder"]
COMPARED = ("/users", "/rates", "/move")
ENDLESS = 100_000  # missions: the flight goes on until it is stopped, however long the kills take


def flight(ros: Ros, name: str, *options: object, missions: int) -> subprocess.Popen[str]:
    """Start missions in lockstep with a bag and a summary of this name."""
    nodes = ("--nodes", ",".join(KILLED))
    given = (*nodes, "--bag", ros.folder / name, "--summary", ros.folder / f"{name}.json", *options)
    return ros.start("uav_dc_ros.run_all", "--pace", "lockstep", "--missions", missions, *given)


def summaries(folder: Path, name: str) -> list[dict[str, Any]]:
    """What run_all wrote, without the name of the bag."""
    return [mission | {"bag": None} for mission in json.loads((folder / f"{name}.json").read_text())]


def payloads(bag: Path, missions: int) -> dict[tuple[str, int, int], Any]:
    """Payloads by topic, mission and step of the first missions; a step told twice is told the same."""
    found: dict[tuple[str, int, int], Any] = {}
    for topic, payload in read_bag(bag, *COMPARED):
        if payload["mission"] < missions:
            key = (topic, payload["mission"], payload["step"])
            told = but_run(payload)
            assert found.setdefault(key, told) == told, f"step {key} is told in two ways"
    return found


def kill(
    ros: Ros,
    process: subprocess.Popen[str],
    rng: random.Random,
    kills: int,
    *,
    composed: bool,
    longest_s: float = 0.8,
) -> set[str]:
    """Kill nodes at random moments, none more often than it is started again; the processes' names.

    The first to be killed is the process of several nodes, where there is one.
    """
    killed, process_ids = [], set()
    deaths = dict.fromkeys(KILLED, 0)
    while len(killed) < kills:
        assert process.poll() is None, "it flies until it is stopped"
        time.sleep(rng.uniform(0.0, longest_s))
        name = rng.choice([name for name in KILLED if deaths[name] < NODES[name].max_restarts])
        if composed and not killed:
            name = "container"
        for process_id, command in ros.processes().items():
            # A killed process may stay in the table for a while on a busy machine: it dies once.
            if f"uav_dc_ros.nodes.{name} " in command and process_id not in process_ids:
                os.kill(process_id, signal.SIGKILL)
                process_ids.add(process_id)
                killed.append(name)
                for node in COMPOSED if name == "container" else [name]:
                    deaths[node] += 1
                break
    return set(killed)


def landed(flight: Running) -> int:
    """How many missions have come to their last step."""
    return sum("step 46/46" in line for line in flight.lines)


def check_a_flight_with_kills(ros: Ros, kills: int, seed: int, *, composed: bool, **how: float) -> None:
    """Fly with kills until all have come and missions land again, then as many missions in peace."""
    name, calm = f"disturbed{seed}", f"calm{seed}"
    process = flight(ros, name, "--compose" if composed else "--no-compose", missions=ENDLESS)
    disturbed = Running(process)
    killed = kill(ros, process, random.Random(seed), kills, composed=composed, **how)
    until(lambda: sum("killed by SIGKILL" in line for line in disturbed.lines) == kills)
    before = landed(disturbed)
    until(lambda: landed(disturbed) > before + 2)
    status, output = disturbed.end(signal.SIGINT)
    assert status == 130, output
    assert "Traceback" not in output
    assert output.count("killed by SIGKILL") == kills, output
    assert output.count("its nodes go on in processes of their own") == composed, output
    told = [mission for mission in summaries(ros.folder, name) if mission["outcome"] != "aborted"]
    status, output = finish(flight(ros, calm, missions=len(told)))
    assert status == 0, output
    assert told == summaries(ros.folder, calm)
    expected = payloads(ros.folder / calm, len(told))
    recorded = payloads(ros.folder / name, len(told))
    assert recorded.items() <= expected.items()
    if "recorder" not in killed:
        assert recorded == expected
    assert (ros.folder / name / "metadata.yaml").is_file()


@pytest.mark.long  # one kill: test_faults
def test_missions_end_as_if_nobody_had_been_killed(ros: Ros) -> None:
    check_a_flight_with_kills(ros, kills=3, seed=1, composed=True, longest_s=0.4)


@pytest.mark.long
def test_fifty_kills(ros: Ros) -> None:
    for seed in range(2, 7):
        check_a_flight_with_kills(ros, kills=10, seed=seed, composed=seed % 2 == 0)


@pytest.mark.parametrize(
    "node",
    ["policy", *(pytest.param(n, marks=pytest.mark.long) for n in ("world", "channel_monitor", "recorder"))],
)
def test_a_node_that_keeps_dying_ends_the_mission(
    ros: Ros, small_scenario: Path, small_policy: Path, node: str
) -> None:
    given = ("--scenario", small_scenario, "--policy", small_policy, "--pace", 1)
    process = flight(ros, "bag", *given, missions=1)
    killed: set[int] = set()
    while process.poll() is None and len(killed) <= NODES[node].max_restarts:
        killed_now = ros.node(node)
        if killed_now not in killed:
            os.kill(killed_now, signal.SIGKILL)
            killed.add(killed_now)
        time.sleep(0.05)
    status, output = finish(process)
    assert status == 1, output
    assert "Traceback" not in output
    times = NODES[node].max_restarts + 1
    assert f"error: node {node} was killed by SIGKILL" in output
    assert f"({times} times within 60 s)" in output
    summary = json.loads((ros.folder / "bag.json").read_text())
    assert summary["outcome"] == "aborted"
    if (ros.folder / "bag").is_dir():  # killed early enough, the recorder had not made it yet
        read_bag(ros.folder / "bag")
        assert (ros.folder / "bag" / "metadata.yaml").is_file()
