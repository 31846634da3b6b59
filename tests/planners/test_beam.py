"""Beam search: its plans are flown as computed, and are better than every other planner's."""

import numpy as np
import pytest

from tests.support.worlds import changed
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.world import State
from uav_dc_ros.experiments.evaluate.rollout import roll_out, rollout_steps
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.planners.beam import search
from uav_dc_ros.planners.model import MissionModel, Walks, known_walks


def flown(scenario, plan, seed):
    """The mission of a seed with the actions of a plan, and hovering behind them."""
    actions = plan.actions

    def act(state):
        step = int(state.step[0])
        return np.full(1, actions[step] if step < len(actions) else Action.HOVER)

    return roll_out(scenario, act, [seed]), [state for state, _ in rollout_steps(scenario, act, [seed])]


def one(state):
    """A state of one mission without its batch dimension."""
    return State(**{name: getattr(state, name)[0] for name in State.__dataclass_fields__})


FADING = {"shadowing": {"sigma_db": 6.0, "correlation_m": 60.0}, "fading": {"model": "rician", "k_db": 6.0}}
WORLDS = {
    "as it is": {},
    "associated": {"radio": {"interference": "associated"}},
    "random channel": {"radio": FADING},
    "ends on arrival": {"mission": {"episode_end": "on_arrival"}},
    "battery": {"energy": {"battery_j": 90e3, "ends": "both"}},
}


@pytest.mark.parametrize("world", WORLDS)
def test_a_plan_is_flown_as_it_promises(world):
    scenario = changed("five_clusters_hover", **WORLDS[world])
    for seed in (0, 1):
        start, walks = known_walks(scenario, seed)
        plan = search(MissionModel(scenario, walks), start, width=12)
        missions, _ = flown(scenario, plan, seed)
        assert missions.landed[0]
        assert missions.users_collected[0] == plan.users_collected
        assert missions.arrival_step[0] == plan.arrival_step == len(plan.actions)
        assert missions.objective(scenario)[0] == plan.objective


@pytest.mark.parametrize("name", ["five_clusters", "farm", "town"])
def test_it_beats_the_planners_that_know_the_clusters(name):
    scenario = scenarios.load(name)
    tours = roll_out(scenario, PLANNERS["tour"](scenario), range(2)).objective(scenario)
    for seed, tour in enumerate(tours):
        start, walks = known_walks(scenario, seed)
        assert search(MissionModel(scenario, walks), start, width=8).objective > tour


def test_the_weight_decides_between_users_and_time():
    scenario = scenarios.load("five_clusters_hover")
    start, walks = known_walks(scenario, 3)
    model = MissionModel(scenario, walks)
    plans = [search(model, start, width=12, weight=weight) for weight in (0.0, 0.5, 1.0)]
    users, arrivals = [plan.users_collected for plan in plans], [plan.arrival_step for plan in plans]
    assert arrivals[0] == 20, "the way to the dock"
    assert users[0] < users[1] <= users[2] == 50
    assert arrivals[0] < arrivals[1] <= arrivals[2]


def test_it_plans_from_any_state_of_a_mission():
    """The rest of the best plan is a plan from its midst; from elsewhere there is one that lands."""
    scenario = scenarios.load("three_clusters_hover")
    start, walks = known_walks(scenario, 0)
    plan = search(MissionModel(scenario, walks), start, width=32)
    _, states = flown(scenario, plan, 0)
    for step in (1, 9, 25):
        rest = Walks(users_m=walks.users_m[step:])
        again = search(MissionModel(scenario, rest), one(states[step]), width=32)
        assert again.objective == plan.objective
        assert len(again.actions) == len(plan.actions) - step
    late = one(list(rollout_steps(scenario, lambda state: np.full(1, Action.HOVER), [0]))[30][0])
    assert search(MissionModel(scenario, Walks(users_m=walks.users_m[30:])), late, width=4).objective == 0.0


def test_over_the_dock_with_all_users_collected_it_stays():
    scenario = scenarios.load("three_clusters_hover")
    start, walks = known_walks(scenario, 0)
    plan = search(MissionModel(scenario, walks), start, width=8)
    _, states = flown(scenario, plan, 0)
    step = plan.arrival_step + 2
    again = search(MissionModel(scenario, Walks(users_m=walks.users_m[step:])), one(states[step]), width=8)
    assert (again.users_collected, again.arrival_step) == (plan.users_collected, step)
