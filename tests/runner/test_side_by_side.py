"""Several missions on one network, one mission on several hosts, and nodes that come late."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import WITHOUT_VISUALIZER, Ros, each_once, finish, read_bag, wait_for
from tests.nodes.conftest import Alone
from uav_dc_ros.topics import TOPICS

COMPARED = ("users", "rates", "mission", "move")
SEEDS = (1, 2, 3)


@dataclass
class Small:
    """Options of a small mission in lockstep, and for each seed what is told of it when it is alone."""

    scenario: Path
    policy: Path
    options: list[object]
    alone: dict[int, dict[str, list[Any]]]


@pytest.fixture(scope="module")
def small(alone: Alone) -> Small:
    """The missions of all seeds as they were flown alone, one after another."""
    options = ["--scenario", alone.scenario, "--policy", alone.policy, "--pace", "lockstep"]
    told = {seed: payloads(alone.bag, mission=seed) for seed in SEEDS}
    return Small(alone.scenario, alone.policy, options, told)


def payloads(bag: Path, namespace: str = "", mission: int = 0) -> dict[str, list[Any]]:
    """Payloads of a mission by topic, without what depends on the missions before it."""
    names = [f"{namespace}/{topic}" for topic in COMPARED]
    told: dict[str, list[Any]] = {topic: [] for topic in COMPARED}
    for name, payload in read_bag(bag, *names):
        if payload["mission"] == mission:
            payload = {key: payload[key] for key in payload if key not in ("run", "mission", "stamp_ns")}
            told[name.rsplit("/", 1)[1]].append(payload)
    return {topic: each_once(each) for topic, each in told.items()}


def test_two_missions_in_two_namespaces_do_not_touch(ros: Ros, small: Small) -> None:
    assert small.alone[1] != small.alone[2]
    flights = [
        ros.start(
            "uav_dc_ros.run_all",
            *(*small.options, *WITHOUT_VISUALIZER, "--seed", seed),
            *("--namespace", f"/fleet/uav{seed}", "--bag", ros.folder / f"side{seed}"),
        )
        for seed in (1, 2)
    ]
    for flight in flights:
        status, output = finish(flight)
        assert status == 0, output
    for seed in (1, 2):
        assert payloads(ros.folder / f"side{seed}", f"/fleet/uav{seed}") == small.alone[seed]
        names = {name for name, _ in read_bag(ros.folder / f"side{seed}")}
        assert all(name.startswith(f"/fleet/uav{seed}/") for name in names)


@pytest.mark.long  # with a link that loses messages: test_bad_network
def test_one_mission_on_two_hosts(ros: Ros, small: Small) -> None:
    """Each host starts its share; the one without the world learns the seed from the vehicle."""
    bag = ros.folder / "shared"
    summaries = [ros.folder / "a.json", ros.folder / "b.json"]
    ground = ros.start(
        "uav_dc_ros.run_all",
        *small.options,
        *("--nodes", "policy,recorder", "--bag", bag, "--summary", summaries[0]),
    )
    ros.node("recorder")  # whoever comes first waits
    field = ros.start(
        "uav_dc_ros.run_all",
        *small.options,
        *("--nodes", "world,channel_monitor", "--seed", 3, "--summary", summaries[1]),
    )
    for flight in (ground, field):
        status, output = finish(flight)
        assert status == 0, output
    assert payloads(bag) == small.alone[3]
    told = [json.loads(summary.read_text()) for summary in summaries]
    assert told[0] == told[1] | {"bag": str(bag)}
    assert told[0]["seed"] == 3


@pytest.mark.long  # nodes that start one after another: test_alone
def test_a_policy_that_starts_late_flies_from_the_first_step(ros: Ros, small: Small) -> None:
    bag = ros.folder / "late"
    nodes = "world,channel_monitor,recorder"
    flight = ros.start("uav_dc_ros.run_all", *small.options, "--nodes", nodes, "--seed", 1, "--bag", bag)
    ros.node("recorder")
    time.sleep(2.0)
    policy = ros.start(
        "uav_dc_ros.nodes.policy",
        *("--ros-args", "-p", f"policy:={small.policy}", "-p", f"scenario:={small.scenario}"),
        *("-p", "peers:=[world, channel_monitor, recorder]"),  # with the recorder, as run_all has it
    )
    status, output = finish(flight)
    assert status == 0, output
    policy.terminate()
    finish(policy)
    assert payloads(bag) == small.alone[1]


@pytest.mark.long
def test_a_recorder_that_starts_late_is_told_what_it_missed(ros: Ros, small: Small) -> None:
    flight = ros.start("uav_dc_ros.run_all", *small.options, "--seed", 1, "--pace", 30, "--no-record")
    assert flight.stdout is not None
    wait_for(flight.stdout, "mission: step 5/30")
    bag = ros.folder / "late"
    given = ("-p", f"bag:={bag}", "-p", f"scenario:={small.scenario}")
    recorder = ros.start("uav_dc_ros.nodes.recorder", "--ros-args", *given)
    status, output = finish(flight)
    assert status == 0, output
    recorder.terminate()
    status, output = finish(recorder)
    assert status == 0, output
    late, alone = payloads(bag), small.alone[1]
    latched = [topic for topic in COMPARED if TOPICS[topic].latched]
    assert latched == ["users", "rates", "mission"]
    for topic in latched:  # a state has not changed since the first step; which step a move came in may
        assert [m["step"] for m in late[topic]] == [m["step"] for m in alone[topic]]
    assert 0 < len(late["move"]) < len(alone["move"]), "a move is not latched: an old one is worth nothing"
