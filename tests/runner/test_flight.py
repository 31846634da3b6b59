"""Ten missions in lockstep through real nodes over real DDS, against the environment."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from mcap.reader import make_reader

import uav_dc_ros
from tests.conftest import Ros, but_run, each_once, finish, read_bag
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.users.service import FIGURES
from uav_dc_ros.env.registration import ENV_ID
from uav_dc_ros.topics import TOPICS

MISSIONS = 10
SCENARIO = scenarios.load("five_clusters")
GRID = SCENARIO.grid
STEPS = SCENARIO.mission.max_steps


@dataclass
class Flown:
    """What a run left behind."""

    status: int
    output: str
    bag: Path
    summaries: list[dict[str, Any]]

    def __post_init__(self) -> None:
        self.messages = read_bag(self.bag)

    def payloads(self, topic: str) -> list[Any]:
        return each_once([message for name, message in self.messages if name == f"/{topic}"])


@pytest.fixture(scope="module")
def flown(module_ros: Ros) -> Flown:
    bag, summary = module_ros.folder / "bag", module_ros.folder / "summary.json"
    status, output = module_ros.run_all(
        "--missions", MISSIONS, "--pace", "lockstep", "--bag", bag, "--summary", summary
    )
    return Flown(status, output, bag, json.loads(summary.read_text()))


@pytest.fixture(scope="module")
def simulated() -> list[list[dict[str, Any]]]:
    """The same missions in the environment: `info` of each step, with the reward."""
    policy = policies.load("five_clusters_dueling")
    env = gymnasium.make(ENV_ID, scenario=SCENARIO).unwrapped
    missions = []
    for seed in range(MISSIONS):
        _, info = env.reset(seed=seed)
        steps = [info]
        over = False
        while not over:
            seen = {name: info[name] for name in ("cell", "step", "data_bits", "collected")}
            action = policy.act(policy.observe(SCENARIO, **seen))
            _, reward, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            steps.append(info | {"reward": reward, "action": int(action)})
        missions.append(steps)
    return missions


def test_it_ends_well(flown: Flown) -> None:
    assert flown.status == 0, flown.output
    assert "another world" not in flown.output
    assert "Traceback" not in flown.output
    assert "rejected" not in flown.output
    assert "bag: bag\n" in flown.output


def test_progress_is_told_while_it_flies(flown: Flown) -> None:
    assert f"mission 7 of {MISSIONS}: step {STEPS}/{STEPS}: " in flown.output
    progress = rf"mission 1 of {MISSIONS}: step \d+/{STEPS}: \d+/50 users, .* Mbit/s, .* m to the dock"
    assert re.search(progress, flown.output)


def test_the_cells_are_those_of_the_environment(flown: Flown, simulated: list[Any]) -> None:
    told = [(m["mission"], m["step"], m["cell"]) for m in flown.payloads("mission")]
    expected = [
        (i, step, info["cell"].tolist())
        for i, steps in enumerate(simulated)
        for step, info in enumerate(steps)
    ]
    assert told == expected


def test_the_moves_are_those_of_the_environment(flown: Flown, simulated: list[Any]) -> None:
    told = [(m["mission"], m["step"], m["action"]) for m in flown.payloads("move")]
    expected = [
        (i, step, Action(info["action"]).label)
        for i, steps in enumerate(simulated)
        for step, info in enumerate(steps[1:])
    ]
    assert told == expected


def test_users_stand_where_they_stand_in_the_environment_to_the_last_bit(
    flown: Flown, simulated: list[Any]
) -> None:
    expected = [info["users_m"] for steps in simulated for info in steps]
    told = [np.stack([m["x_m"], m["y_m"]], axis=-1) for m in flown.payloads("users")]
    np.testing.assert_array_equal(told, expected)


@pytest.mark.parametrize("column", ["data_bits", "collected", "served", "sinr", "rate_bps"])
def test_the_channel_is_that_of_the_environment_to_the_last_bit(
    flown: Flown, simulated: list[Any], column: str
) -> None:
    told = [m[column] for m in flown.payloads("rates") if m["step"] > 0]
    expected = [info[column] for steps in simulated for info in steps[1:]]
    assert len(told) == MISSIONS * STEPS
    np.testing.assert_array_equal(told, expected)


def test_the_summaries_are_the_environment_s_numbers(flown: Flown, simulated: list[Any]) -> None:
    assert len(flown.summaries) == MISSIONS
    for seed, (summary, steps) in enumerate(zip(flown.summaries, simulated, strict=True)):
        last = steps[-1]
        cells = np.asarray([info["cell"] for info in steps], dtype=float)
        metres = np.diff(cells, axis=0) * (GRID.cell_m, GRID.cell_m, GRID.altitude_step_m)
        assert summary == {
            "scenario": "five_clusters",
            "policy": "five_clusters_dueling",
            "seed": seed,
            "outcome": "landed" if last["landed"] else "timeout",
            "steps": STEPS,
            "users_collected": int(last["collected"].sum()),
            "users_total": 50,
            "data_bits": float(last["data_bits"].sum()),
            "sum_rate_bps": pytest.approx(np.mean([info["sum_rate_bps"] for info in steps[1:]])),
            "distance_m": pytest.approx(np.abs(metres).sum()),
            # The episode form pays r^t itself; with the data of the step a mission's reward is its mean.
            "reward": pytest.approx(np.mean([info["reward"] for info in steps[1:]])),
            "reward_data": "step",
            "reason": "",
            "steps_not_reached": 0,
            **{name: pytest.approx(float(last[name])) for name in FIGURES},
            "bag": str(flown.bag),
        }


def test_the_bag_holds_every_message_from_the_first(flown: Flown) -> None:
    every_step = [(mission, step) for mission in range(MISSIONS) for step in range(STEPS + 1)]
    for topic in ("users", "rates", "mission"):
        assert [(m["mission"], m["step"]) for m in flown.payloads(topic)] == every_step
    for topic in ("pose", "target"):
        stamps = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for m in flown.payloads(topic)]
        step_s = SCENARIO.mission.step_s
        assert stamps == pytest.approx([i * step_s for i in range(len(every_step))])
        assert {m.header.frame_id for m in flown.payloads(topic)} == {"map"}
    recorded = {f"/{topic.name}" for topic in TOPICS.values() if topic.recorded and not topic.optional}
    assert {name for name, _ in flown.messages} == recorded


def test_every_payload_says_which_run_it_belongs_to(flown: Flown) -> None:
    runs = {m["run"] for topic in ("users", "rates", "mission", "move") for m in flown.payloads(topic)}
    assert len(runs) == 1
    assert re.fullmatch("[0-9a-f]{16}", *runs)


def test_the_pose_is_the_cell_s_centre(flown: Flown) -> None:
    for pose, mission in zip(flown.payloads("pose"), flown.payloads("mission"), strict=True):
        east, north, up = mission["cell"]
        at = pose.pose.position
        altitude_m = GRID.altitude_min_m + GRID.altitude_step_m * up
        assert (at.x, at.y, at.z) == (GRID.cell_m * east, GRID.cell_m * north, altitude_m)


def test_the_bag_says_what_it_is_about(flown: Flown) -> None:
    policy = policies.load("five_clusters_dueling")
    with next(flown.bag.glob("*.mcap")).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        about = next(record.metadata for record in reader.iter_metadata() if record.name == "uav_dc_ros")
        summary = reader.get_summary()
    values = json.loads(about.pop("scenario_values"))
    assert values["mission"]["r_min_bits"] == SCENARIO.mission.r_min_bits
    assert about == {
        "version": uav_dc_ros.__version__,
        "scenario": "five_clusters",
        "scenario_fingerprint": SCENARIO.fingerprint,
        "policy": policy.name,
        "policy_sha256": policy.sha256,
        "seed": "0",
        "missions": str(MISSIONS),
        "pace": "lockstep",
        "vehicle": "simulated",
    }
    assert summary is not None
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    for channel in summary.channels.values():
        topic = TOPICS[channel.topic.removeprefix("/")]
        offered = channel.metadata["offered_qos_profiles"]
        assert "reliability: reliable" in offered
        assert ("transient_local" if topic.latched else "volatile") in offered


def test_the_same_seed_gives_the_same_payloads_also_from_a_process_for_each_node(
    flown: Flown, module_ros: Ros
) -> None:
    bag = module_ros.folder / "again"
    names = ("world", "channel_monitor", "policy", "recorder")
    given = ("--missions", 2, "--pace", "lockstep", "--no-compose", "--nodes", ",".join(names), "--bag", bag)
    process = module_ros.start("uav_dc_ros.run_all", *given)
    ids = {module_ros.node(name) for name in names}
    status, output = finish(process)
    assert len(ids) == 4
    assert status == 0, output
    again = Flown(status, output, bag, [])
    for topic in ("users", "rates", "mission", "move"):
        first = [but_run(payload) for payload in flown.payloads(topic) if payload["mission"] < 2]
        assert [but_run(payload) for payload in again.payloads(topic)] == first
