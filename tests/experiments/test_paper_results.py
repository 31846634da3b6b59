"""Results in memory and on disk."""

import contextlib
import dataclasses

import msgspec
import numpy as np
import pytest

from tests.experiments.paper_sweeps import SHORT, WORLDS, realistic
from tests.support.worlds import changed
from uav_dc_ros import scenarios
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.experiments.paper.results import (
    CURVES_FILE,
    GREEDY,
    METRICS,
    RUNS_FILE,
    Results,
    ScenarioFacts,
)
from uav_dc_ros.experiments.paper.setting import SMOKE, Setting
from uav_dc_ros.planners import PLANNERS


@pytest.fixture(scope="module")
def results():
    return realistic(SMOKE)


def test_what_is_saved_is_read_again(results, tmp_path):
    results.save(tmp_path)
    read = Results.load(tmp_path)
    assert read.metadata == results.metadata
    assert read.planned == results.planned
    np.testing.assert_array_equal(read.episode, results.episode)
    for name in METRICS:
        np.testing.assert_array_equal(read.curves[name], results.curves[name])
        assert read.curves[name].dtype == np.float32
    for name in GREEDY:
        np.testing.assert_array_equal(read.greedy[name], results.greedy[name])
    assert {path.name for path in tmp_path.iterdir()} == {RUNS_FILE, CURVES_FILE}


@pytest.mark.parametrize("file", [RUNS_FILE, CURVES_FILE])
def test_a_damaged_file_is_refused_or_read_right(results, tmp_path, file):
    """One bit is another, anywhere: some bits mean nothing, and no other may go unnoticed."""
    results.save(tmp_path)
    content = (tmp_path / file).read_bytes()
    refused = 0
    for where in np.linspace(0, len(content) - 1, 60, dtype=int):
        damaged = bytearray(content)
        damaged[where] ^= 4
        (tmp_path / file).write_bytes(damaged)
        refused += 1
        with contextlib.suppress(TrainingError):
            read = Results.load(tmp_path)
            refused -= 1
            assert read.planned == results.planned
            for name in METRICS:
                np.testing.assert_array_equal(read.curves[name], results.curves[name])
            for name in GREEDY:
                np.testing.assert_array_equal(read.greedy[name], results.greedy[name])
    assert refused > 20


def test_a_changed_number_is_noticed(results, tmp_path):
    """In the middle of the greater file there is nothing but numbers."""
    results.save(tmp_path)
    content = bytearray((tmp_path / CURVES_FILE).read_bytes())
    content[len(content) // 2] ^= 4
    (tmp_path / CURVES_FILE).write_bytes(content)
    with pytest.raises(TrainingError, match=r"curves\.parquet cannot be read: "):
        Results.load(tmp_path)


@pytest.mark.parametrize("file", [RUNS_FILE, CURVES_FILE])
def test_a_file_cut_short_or_missing_is_refused(results, tmp_path, file):
    results.save(tmp_path)
    path = tmp_path / file
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(TrainingError, match=f"{file} cannot be read: "):
        Results.load(tmp_path)
    path.unlink()
    with pytest.raises(TrainingError, match=f"{file}: no such file"):
        Results.load(tmp_path)


def test_files_of_two_sweeps_are_not_taken_for_one(results, tmp_path):
    results.save(tmp_path)
    runs_file = (tmp_path / RUNS_FILE).read_bytes()
    metadata = msgspec.structs.replace(results.metadata, command="another")
    dataclasses.replace(results, metadata=metadata).save(tmp_path)
    (tmp_path / RUNS_FILE).write_bytes(runs_file)
    with pytest.raises(TrainingError, match="of different sweeps"):
        Results.load(tmp_path)
    (tmp_path / CURVES_FILE).write_bytes(runs_file)
    with pytest.raises(
        TrainingError, match=r"curves\.parquet has columns run, scenario, .*; expected run, episode"
    ):
        Results.load(tmp_path)


def test_a_folder_that_is_not_there(results, tmp_path):
    with pytest.raises(TrainingError, match="cannot be written: "):
        results.save(tmp_path / "nowhere")


def test_what_does_not_fit_is_refused(results):
    def broken(**values):
        return dataclasses.replace(results, **values)

    with pytest.raises(TrainingError, match=r"curves: reward has shape \(1, 2\); expected"):
        broken(curves=results.curves | {"reward": np.zeros((1, 2))})
    with pytest.raises(TrainingError, match="curves has arrival_step, "):
        broken(curves={name: results.curves[name] for name in METRICS if name != "reward"})
    nan = results.greedy["greedy_reward"].copy()
    nan[3] = np.nan
    with pytest.raises(TrainingError, match="greedy: greedy_reward holds a number that is not finite"):
        broken(greedy=results.greedy | {"greedy_reward": nan})
    with pytest.raises(TrainingError, match="expected each setting, environment and repeat once"):
        broken(planned=(*results.planned[1:], results.planned[1]))
    with pytest.raises(TrainingError, match="expected 10 points of 1 episodes"):
        broken(episode=results.episode + 1)
    metadata = msgspec.structs.replace(results.metadata, worlds={"five_clusters": WORLDS["five_clusters"]})
    with pytest.raises(TrainingError, match="no world of scenario 'three_clusters'"):
        broken(metadata=metadata)


def test_runs_come_by_environment_and_repeat():
    results = realistic(SHORT)
    found = results.of(Setting(batch_size=8))
    order = [results.planned[i][1:] for i in found]
    assert order == [(e, r) for e in SHORT.environments for r in range(SHORT.repeats)]
    assert all(results.planned[i].setting == Setting(batch_size=8) for i in found)
    assert len(results.of(Setting(batch_size=9))) == 0


def test_results_of_version_0_1_0_are_of_the_data_so_far(results):
    facts = msgspec.to_builtins(results.metadata.worlds["five_clusters"])
    assert facts.pop("reward_data") == "so_far"
    assert msgspec.convert(facts, ScenarioFacts) == results.metadata.worlds["five_clusters"]


@pytest.mark.parametrize("name", ["three_clusters_hover", "five_clusters_hover"])
def test_the_throughput_gives_the_data_term_of_the_mean_over_the_steps(name):
    """Where a mission is over the dock from its arrival on, and not before."""
    scenario = changed(name, reward={"beta": 3.0, "zeta": 2.0, "r_plus": "binary", "data": "step"})
    facts, n_steps = ScenarioFacts.of(scenario), scenario.mission.max_steps
    assert facts.reward_data == "step"
    for planner in ("tour", "random"):
        missions = roll_out(scenario, PLANNERS[planner](scenario), range(5))
        docked = np.where(missions.landed, n_steps + 1 - missions.arrival_step, 0) / n_steps
        expected = 3 * facts.data_per_bps * missions.sum_rate_bps + 2 * docked
        np.testing.assert_allclose(missions.reward, expected, rtol=1e-9)


@pytest.mark.parametrize("name", ["three_clusters_hover", "five_clusters_hover"])
def test_the_throughput_gives_the_data_term(name):
    """Of flown missions: r^t with the binary R_plus is beta c throughput + zeta landed."""
    scenario = changed(name, reward={"beta": 3.0, "zeta": 2.0, "r_plus": "binary"})
    for planner in ("tour", "random"):
        missions = roll_out(scenario, PLANNERS[planner](scenario), range(5))
        data = ScenarioFacts.of(scenario).data_per_bps * missions.sum_rate_bps
        np.testing.assert_allclose(missions.reward, 3 * data + 2 * missions.landed, rtol=1e-9)


def test_a_world_whose_missions_end_on_arrival_is_refused():
    with pytest.raises(TrainingError, match="episode_end = 'on_arrival'; expected 'at_time_limit'"):
        ScenarioFacts.of(changed("five_clusters", mission={"episode_end": "on_arrival"}))
    assert ScenarioFacts.of(scenarios.load("five_clusters")).n_users == 50
