"""Planners: what they promise of every mission, and that they always come home."""

import json

import numpy as np
import pytest

from tests.support.worlds import changed
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.world import rollout_steps
from uav_dc_ros.experiments.evaluate.cli import main
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.planners.baselines import ENOUGH, EXACT_TOUR_MAX

SEEDS = range(20)


@pytest.mark.parametrize("name", scenarios.names())
@pytest.mark.parametrize("planner", ["nearest", "fixed_tour", "tour"])
def test_a_plan_collects_nearly_everyone_and_lands(name, planner):
    scenario = scenarios.load(name)
    missions = roll_out(scenario, PLANNERS[planner](scenario), SEEDS)
    assert missions.landed.all()
    assert missions.users_collected.mean() > ENOUGH * scenario.n_users


@pytest.mark.parametrize("planner", ["nearest", "fixed_tour", "tour"])
@pytest.mark.parametrize("max_steps", [20, 21, 27, 40])
def test_a_plan_is_home_in_time_however_short_that_is(planner, max_steps):
    scenario = changed("five_clusters_hover", mission={"max_steps": max_steps})
    assert roll_out(scenario, PLANNERS[planner](scenario), SEEDS).landed.all()


@pytest.mark.parametrize("planner", ["fixed_tour", "tour"])
def test_the_tour_is_flown_in_the_shortest_order(planner):
    scenario = scenarios.load("five_clusters_hover")
    goals = np.rint(np.asarray(scenario.users.cluster_centres_m) / 100).astype(int)
    visited = []
    for state, _ in rollout_steps(scenario, PLANNERS[planner](scenario), [0]):
        over = np.flatnonzero((goals == state.cell[0, :2]).all(axis=-1))
        if over.size and over[0] not in visited:
            visited.append(over[0])
    stops = [scenario.start_cell[:2], *goals[visited], scenario.dock_cell]
    assert len(visited) == 5
    assert np.abs(np.diff(np.asarray(stops), axis=0)).sum() == 32  # by hand, and in the scenario's comment


def test_many_clusters_need_no_search_of_all_orders():
    centres = [[100.0 * i, 100.0 * (i % 3)] for i in range(EXACT_TOUR_MAX + 2)]
    scenario = changed("five_clusters_hover", users={"cluster_centres_m": centres})
    assert roll_out(scenario, PLANNERS["fixed_tour"](scenario), [0]).landed.all()


def test_a_cluster_off_the_grid_is_approached_from_its_edge():
    scenario = changed("five_clusters_hover", users={"cluster_centres_m": [[-150.0, 1100.0]]})
    assert roll_out(scenario, PLANNERS["nearest"](scenario), [0]).landed.all()


def test_random_takes_every_action_and_repeats_itself():
    scenario = scenarios.load("three_clusters_hover")
    cells = [
        [state.cell for state, _ in rollout_steps(scenario, PLANNERS["random"](scenario), SEEDS)]
        for _ in range(2)
    ]
    np.testing.assert_array_equal(cells[0], cells[1])
    act = PLANNERS["random"](scenario)
    states = [state for state, _ in rollout_steps(scenario, act, SEEDS)]
    actions = [act(state) for state in states]
    assert set(np.concatenate(actions)) == set(Action)
    again = PLANNERS["random"](scenario)
    np.testing.assert_array_equal(again(states[7]), actions[7])  # also of a node that was restarted


def test_evaluate_compares_policies_with_planners(tmp_path, capsys):
    figures = tmp_path / "figures.json"
    arguments = [
        "--policy",
        "five_clusters_hover_dueling",
        "tour",
        "--scenario",
        "five_clusters_hover",
        "--seeds",
        "5",
    ]
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--json", str(figures)])
    assert ended.value.code == 0
    assert "tour in five_clusters_hover" in capsys.readouterr().out
    learnt, planned = json.loads(figures.read_text())["evaluations"]
    assert (learnt["policy"], planned["policy"]) == ("five_clusters_hover_dueling", "tour")
    assert len(learnt["sha256"]) == 64
    assert planned["sha256"] is None


def test_a_planner_needs_a_scenario(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--policy", "tour"])
    assert ended.value.code == 2
    assert "expected --scenario" in capsys.readouterr().err
