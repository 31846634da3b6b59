"""Energy through nodes, bag, verify, export and summary: equal to the environment to the last bit."""

import json

import msgspec
import numpy as np
import pytest
from pyarrow import parquet

from tests.conftest import Ros, each_once, read_bag
from tests.nodes.conftest import SMALL
from tests.recordings.made import about, changing, copy, flight, write
from tests.support.worlds import changed, saved, tiny
from uav_dc_ros import bag as command
from uav_dc_ros import messages, payloads, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.env.vector_env import DataCollectionVectorEnv
from uav_dc_ros.errors import MessageError, PolicyError
from uav_dc_ros.offboard.mission.progress import Checkpoint, MissionProgress
from uav_dc_ros.recordings.pages.compare import Group
from uav_dc_ros.recordings.pages.missions import read_missions
from uav_dc_ros.recordings.pages.page import world_data
from uav_dc_ros.recordings.step_reader import Steps

# Ten hovers of 10 s, about: each mission of at most 30 steps ends by the battery.
BATTERY = "[energy]\nbattery_j = 17000.0\nends = 'both'\ncruise_mps = 18.3\n"
MISSIONS = 2


class Flown:
    """Missions that real nodes flew in lockstep, and the same missions in the environment."""

    def __init__(self, ros: Ros) -> None:
        self.file = ros.folder / "small.toml"
        self.file.write_text(SMALL + BATTERY)
        self.scenario = scenarios.load(self.file)
        self.policy = saved(ros.folder / "untrained", self.scenario, observation="energy")
        self.bag = ros.folder / "bag"
        given = (
            "--scenario",
            self.file,
            "--policy",
            self.policy,
            "--missions",
            MISSIONS,
            "--pace",
            "lockstep",
        )
        status, self.output = ros.run_all(*given, "--bag", self.bag, "--summary", "summary.json")
        assert status == 0, self.output
        self.summaries = json.loads((ros.folder / "summary.json").read_text())
        self.simulated = [self.simulate(seed) for seed in range(MISSIONS)]

    def simulate(self, seed):
        """`info` of each step."""
        policy = policies.load(self.policy)
        env = DataCollectionEnv(self.scenario, "energy")
        observation, info = env.reset(seed=seed)
        infos, over = [info], False
        while not over:
            observation, _, terminated, truncated, info = env.step(np.int64(policy.act(observation)))
            infos.append(info)
            over = terminated or truncated
        return infos


@pytest.fixture(scope="module")
def flown(module_ros: Ros) -> Flown:
    return Flown(module_ros)


def bag_command(capsys, *arguments):
    with pytest.raises(SystemExit) as exit:
        command.main([str(one) for one in arguments])
    return exit.value.code, capsys.readouterr().out


def test_nodes_use_the_energy_of_the_environment_and_end_with_it(flown):
    published = [payload for topic, payload in read_bag(flown.bag) if topic == "/mission"]
    found = [
        (one["mission"], one["step"], one["cell"], one["energy_used_j"], one["state_of_charge"])
        for one in each_once(published)
    ]
    expected = [
        (i, step, info["cell"].tolist(), float(info["energy_used_j"]), float(info["state_of_charge"]))
        for i, infos in enumerate(flown.simulated)
        for step, info in enumerate(infos)
    ]
    assert found == expected
    assert all(5 < len(infos) - 1 < 30 for infos in flown.simulated), "ended by the battery"
    for summary, infos in zip(flown.summaries, flown.simulated, strict=True):
        used_j, data_bits = float(infos[-1]["energy_used_j"]), float(infos[-1]["data_bits"].sum())
        assert summary["energy_used_j"] == used_j
        assert summary["energy_per_mbit_j"] == pytest.approx(used_j / (data_bits / 1e6))
        assert summary["steps"] == len(infos) - 1
        assert summary["outcome"] == ("landed" if infos[-1]["landed"] else "timeout")


def test_verify_recomputes_the_energy(flown, tmp_path, capsys):
    status, out = bag_command(capsys, "verify", flown.bag, "--policy-dir", flown.policy, "--complete")
    assert status == 0, out
    assert out.splitlines()[-1] == "verified"

    def more(payload):
        return msgspec.structs.replace(payload, energy_used_j=float(np.nextafter(payload.energy_used_j, 1e9)))

    status, out = bag_command(
        capsys, "verify", copy(flown.bag, tmp_path / "x", changing("mission", 1, 3, more))
    )
    assert status == 1
    assert "mission: mission 1, step 3, energy_used_j: recorded " in out
    # The end is that of the recorded energy: with a full battery the mission goes on.
    full = changing(
        "mission", 0, len(flown.simulated[0]) - 1, lambda one: msgspec.structs.replace(one, energy_used_j=0.0)
    )
    status, out = bag_command(capsys, "verify", copy(flown.bag, tmp_path / "y", full))
    assert status == 1
    assert "energy_used_j: recorded 0.0" in out


def test_export_holds_it(flown, tmp_path, capsys):
    status, out = bag_command(capsys, "export", flown.bag, "--out", tmp_path / "tables")
    assert status == 0, out
    steps, missions = (
        parquet.read_table(tmp_path / "tables" / f"{name}.parquet") for name in ("steps", "missions")
    )
    infos = [info for infos in flown.simulated for info in infos]
    for name in ("energy_used_j", "state_of_charge"):
        assert steps[name].to_pylist() == [float(info[name]) for info in infos]
    for name in ("energy_used_j", "energy_per_mbit_j"):
        assert missions[name].to_pylist() == [summary[name] for summary in flown.summaries]
    out_file = tmp_path / "t.npz"
    status, out = bag_command(
        capsys, "export", flown.bag, "--out", out_file, "--transitions", "--observation", "energy"
    )
    assert status == 0, out
    with np.load(out_file) as made:
        np.testing.assert_array_equal(
            np.flatnonzero(made["terminated"]) + 1, np.cumsum([len(x) - 1 for x in flown.simulated])
        )
        charge = [np.float32(info["state_of_charge"]) for infos in flown.simulated for info in infos[1:]]
        np.testing.assert_allclose(made["next_observation"][:, -1], charge, rtol=1e-6)


def test_reports_hold_it(flown):
    group = Group("bag", flown.scenario, "untrained", "bag")
    with BagReader(flown.bag) as reader:
        for mission in read_missions(Steps(reader, "", flown.scenario.step_ns), flown.scenario, False):
            group.add(mission)
    for name in ("energy_used_j", "energy_per_mbit_j"):
        assert [one[name] for one in group.summaries] == [summary[name] for summary in flown.summaries]
    metrics = group.data(group, np.arange(5))["metrics"]
    assert metrics["energy_used_j"]["mean"] == pytest.approx(
        np.mean([s["energy_used_j"] for s in flown.summaries])
    )
    for summary in group.summaries:
        summary["energy_per_mbit_j"] = None  # as of missions that collect nothing
    assert group.data(group, np.arange(5))["metrics"]["energy_per_mbit_j"] is None


def test_a_page_holds_the_charge_of_each_step(flown):
    with BagReader(flown.bag) as reader:
        missions = list(read_missions(Steps(reader, "", flown.scenario.step_ns), flown.scenario, False))
    for mission, infos in zip(missions, flown.simulated, strict=True):
        charges = [step["state_of_charge"] for step in mission.steps()]
        assert charges == [float(info["state_of_charge"]) for info in infos]


def test_diagnostics_name_the_model():
    world = tiny(energy={"battery_j": 1e5})
    assert payloads.battery_diagnostics(world, np.asarray(25_000.0)) == {"battery by the model": "75%"}
    assert payloads.battery_diagnostics(tiny(), np.asarray(0.0)) == {}


def test_a_world_without_a_battery_has_none_of_it(tmp_path, capsys):
    world = tiny()
    recorded = flight(world)
    assert all(b"energy" not in message.data for message in recorded)
    folder = write(tmp_path / "bag", recorded, about(world))
    with BagReader(folder) as reader:
        (mission,) = read_missions(Steps(reader, "", world.step_ns), world, False)
    assert all("state_of_charge" not in step for step in mission.steps())
    assert "battery_j" not in world_data(world)
    bag_command(capsys, "export", folder, "--out", tmp_path / "tables")
    assert not any(
        "energy" in name for name in parquet.read_table(tmp_path / "tables/steps.parquet").column_names
    )
    with pytest.raises(ValueError, match=r"expected a scenario with \[energy\]"):
        DataCollectionEnv(world, "energy")
    status, _ = bag_command(
        capsys, "export", folder, "--out", tmp_path / "t.npz", "--transitions", "--observation", "energy"
    )
    assert status == 2


def test_payloads_and_policies_are_checked_against_the_battery(flown, tmp_path):
    with_battery, without = tiny(energy={"battery_j": 1e5}), tiny()
    status = {
        world.fingerprint: messages.Mission(
            mission=0,
            step=0,
            phase=messages.Phase.READY,
            cell=(0, 0, 0),
            remaining_steps=8,
            seed=0,
            scenario=world.name,
            fingerprint=world.fingerprint,
        )
        for world in (with_battery, without)
    }
    with pytest.raises(MessageError, match="no energy_used_j; expected one in scenario 'tiny'"):
        payloads.check(status[with_battery.fingerprint], with_battery)
    full = msgspec.structs.replace(status[without.fingerprint], energy_used_j=0.0)
    with pytest.raises(MessageError, match="energy_used_j; expected none in scenario 'tiny'"):
        payloads.check(full, without)
    with pytest.raises(MessageError, match=r"Expected `float` <= 1.0 - at `\$.state_of_charge`"):
        messages.decode(messages.encode(msgspec.structs.replace(full, state_of_charge=1.5)), messages.Mission)
    needs = policies.load(saved(tmp_path / "needs", with_battery, observation="energy"))
    needs.check(with_battery)
    with pytest.raises(PolicyError, match="policy 'test' needs the observation 'energy' in scenario 'tiny'"):
        needs.check(without)
    policies.load(saved(tmp_path / "plain", without)).check(with_battery)


def test_a_real_vehicle_counts_the_energy_of_its_steps_and_resumes_with_it():
    level_j = tiny(energy={"battery_j": 1e5}).step_energies_j.level
    world = tiny(energy={"battery_j": 5.5 * level_j, "ends": "both"})
    progress = MissionProgress(world)
    for goal in ((1, 0, 0), (2, 0, 0), (2, 0, 0)):
        progress.goal = goal
        progress.complete_step()
    used_j = 2 * level_j + world.step_energies_j.hover
    assert float(progress.energy_used_j) == pytest.approx(used_j, rel=1e-12)
    assert not progress.is_done
    resumed = MissionProgress(
        world, Checkpoint(step=progress.step, cell=progress.cell, energy_used_j=float(progress.energy_used_j))
    )
    for goal in ((2, 1, 0), (2, 2, 0)):
        resumed.goal = goal
        resumed.complete_step()
    assert resumed.is_done
    assert resumed.is_at_dock
    assert resumed.step == 5


def test_the_vector_environment_is_the_single_one(flown):
    policy = policies.load(flown.policy)
    env = DataCollectionVectorEnv(MISSIONS, flown.scenario, "energy")
    observation, info = env.reset(seed=0)
    length = min(map(len, flown.simulated))
    for step in range(length):
        for i, infos in enumerate(flown.simulated):
            assert info["energy_used_j"][i] == infos[step]["energy_used_j"]
        observation, _, _, _, info = env.step(policy.act(observation))
    assert info["energy_used_j"].min() == 0.0, "the shorter mission restarted"


def test_changed_worlds_keep_the_shipped_fingerprint():
    assert changed("five_clusters_hover").fingerprint == scenarios.load("five_clusters_hover").fingerprint
