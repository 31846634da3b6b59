"""Several missions on one network, one mission on several hosts, and nodes that come late."""

import json
import time
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Ros, but_run, finish, read_bag, wait_for
from uav_dc_ros.topics import TOPICS

COMPARED = ("users", "rates", "mission", "move")


@pytest.fixture
def options(small_scenario: Path, small_policy: Path) -> list[object]:
    """A small mission in lockstep."""
    return ["--scenario", small_scenario, "--policy", small_policy, "--pace", "lockstep"]


def payloads(bag: Path, namespace: str = "") -> dict[str, list[Any]]:
    """Payloads of a bag by topic."""
    messages = read_bag(bag)
    return {
        topic: [but_run(m) for name, m in messages if name == f"{namespace}/{topic}"] for topic in COMPARED
    }


def test_two_missions_in_two_namespaces_do_not_touch(ros: Ros, options: list[object]) -> None:
    alone = {}
    for seed in (1, 2):
        status, output = ros.run_all(*options, "--seed", seed, "--bag", ros.folder / f"alone{seed}")
        assert status == 0, output
        alone[seed] = payloads(ros.folder / f"alone{seed}")
    assert alone[1] != alone[2]
    given = (*options, "--missions", 1)
    flights = [
        ros.start(
            "uav_dc_ros.run_all",
            *given,
            *("--seed", seed, "--namespace", f"/fleet/uav{seed}", "--bag", ros.folder / f"side{seed}"),
        )
        for seed in (1, 2)
    ]
    for flight in flights:
        status, output = finish(flight)
        assert status == 0, output
    for seed in (1, 2):
        assert payloads(ros.folder / f"side{seed}", f"/fleet/uav{seed}") == alone[seed]
        names = {name for name, _ in read_bag(ros.folder / f"side{seed}")}
        assert all(name.startswith(f"/fleet/uav{seed}/") for name in names)


def test_one_mission_on_two_hosts(ros: Ros, options: list[object]) -> None:
    """Each host starts its share; the one without the world learns the seed from the vehicle."""
    status, output = ros.run_all(*options, "--seed", 3, "--bag", ros.folder / "alone")
    assert status == 0, output
    bag = ros.folder / "shared"
    summaries = [ros.folder / "a.json", ros.folder / "b.json"]
    ground = ros.start(
        "uav_dc_ros.run_all",
        *options,
        *("--nodes", "policy,recorder", "--bag", bag, "--summary", summaries[0]),
    )
    time.sleep(1.0)  # whoever comes first waits
    field = ros.start(
        "uav_dc_ros.run_all",
        *options,
        *("--nodes", "world,channel_monitor", "--seed", 3, "--summary", summaries[1]),
    )
    for flight in (ground, field):
        status, output = finish(flight)
        assert status == 0, output
    assert payloads(bag) == payloads(ros.folder / "alone")
    told = [json.loads(summary.read_text()) for summary in summaries]
    assert told[0] == told[1] | {"bag": str(bag)}
    assert told[0]["seed"] == 3


def test_a_policy_that_starts_late_flies_from_the_first_step(
    ros: Ros, options: list[object], small_scenario: Path, small_policy: Path
) -> None:
    status, output = ros.run_all(*options, "--bag", ros.folder / "alone")
    assert status == 0, output
    bag = ros.folder / "late"
    flight = ros.start(
        "uav_dc_ros.run_all", *options, "--nodes", "world,channel_monitor,recorder", "--bag", bag
    )
    time.sleep(5.0)
    policy = ros.start(
        "uav_dc_ros.nodes.policy",
        *("--ros-args", "-p", f"policy:={small_policy}", "-p", f"scenario:={small_scenario}"),
        *("-p", "peers:=[world, channel_monitor, recorder]"),  # with the recorder, as run_all has it
    )
    status, output = finish(flight)
    assert status == 0, output
    policy.terminate()
    finish(policy)
    assert payloads(bag) == payloads(ros.folder / "alone")


@pytest.mark.long
def test_a_recorder_that_starts_late_is_told_what_it_missed(
    ros: Ros, options: list[object], small_scenario: Path
) -> None:
    status, output = ros.run_all(*options, "--bag", ros.folder / "alone")
    assert status == 0, output
    flight = ros.start("uav_dc_ros.run_all", *options, "--pace", 30, "--no-record")
    assert flight.stdout is not None
    wait_for(flight.stdout, "mission: step 5/30")
    bag = ros.folder / "late"
    given = ("-p", f"bag:={bag}", "-p", f"scenario:={small_scenario}")
    recorder = ros.start("uav_dc_ros.nodes.recorder", "--ros-args", *given)
    status, output = finish(flight)
    assert status == 0, output
    recorder.terminate()
    status, output = finish(recorder)
    assert status == 0, output
    late, alone = payloads(bag), payloads(ros.folder / "alone")
    latched = [topic for topic in COMPARED if TOPICS[topic].latched]
    assert latched == ["users", "rates", "mission"]
    for topic in latched:  # a state has not changed since the first step; which step a move came in may
        assert [m["step"] for m in late[topic]] == [m["step"] for m in alone[topic]]
    assert 0 < len(late["move"]) < len(alone["move"]), "a move is not latched: an old one is worth nothing"
