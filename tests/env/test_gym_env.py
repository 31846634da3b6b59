"""The Gymnasium environment: its interface, its seeds, and that it is the core and nothing else."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env

from tests.support.worlds import changed, tiny
from uav_dc_ros.core import world
from uav_dc_ros.env import registration
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.errors import ScenarioError

# Every warning of Gymnasium about the environment is an error.
pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.parametrize("observation", ["position", "mission", "map"])
@pytest.mark.parametrize("end", ["at_time_limit", "on_arrival"])
def test_gymnasium_finds_no_fault(observation, end):
    scenario = tiny(mission={"episode_end": end})
    made = gymnasium.make(registration.ENV_ID, scenario=scenario, observation=observation)
    check_env(made.unwrapped)


@pytest.mark.parametrize("module", ["uav_dc_ros", "uav_dc_ros.env.registration"])
def test_it_can_be_made_by_name_alone(module):
    """Without an import of ours: Gymnasium itself imports what stands before the colon."""
    name = f"{module}:{registration.ENV_ID}"
    made = f"gymnasium.make({name!r}, scenario='five_clusters_hover')"
    code = f"import gymnasium; print({made}.reset(seed=0)[0].shape)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("(")


def test_registering_twice_changes_nothing():
    registration.register()
    assert registration.ENV_ID in gymnasium.registry


def test_it_is_the_core_with_the_draws_of_its_seed():
    env = DataCollectionEnv("three_clusters_hover", "map")
    scenario = env.scenario
    rng, actions = np.random.default_rng(7), np.random.default_rng(8)
    _, info = env.reset(seed=7)
    state = world.initial(scenario, rng.random((scenario.n_users, 2)))
    for step in range(scenario.mission.max_steps):
        for key in ("cell", "users_m", "data_bits", "collected", "step"):
            np.testing.assert_array_equal(info[key], getattr(state, key))
        action = actions.integers(7)
        _, reward, terminated, truncated, info = env.step(action)
        state, outcome = world.step(scenario, state, action, rng.random((scenario.n_users, 2)))
        assert reward == outcome.reward
        assert (terminated, truncated) == (step + 1 == scenario.mission.max_steps, False)
        for key in ("served", "sinr", "rate_bps", "sum_rate_bps"):
            np.testing.assert_array_equal(info[key], getattr(outcome.link, key))
        assert info["landed"] == outcome.landed


def test_one_seed_gives_one_mission_and_two_give_two():
    def layout(seed):
        return DataCollectionEnv("five_clusters_hover").reset(seed=seed)[1]["users_m"]

    np.testing.assert_array_equal(layout(1), layout(1))
    assert not np.array_equal(layout(1), layout(2))
    env = DataCollectionEnv("five_clusters_hover")
    env.reset(seed=1)
    assert not np.array_equal(env.reset()[1]["users_m"], layout(1)), "without a seed the stream goes on"


def test_distance_to_the_dock_and_landing():
    env = DataCollectionEnv(tiny(mission={"max_steps": 4}))
    assert env.reset(seed=0)[1]["dock_distance_m"] == pytest.approx(200.0 * np.sqrt(2.0))
    for action, landed in ((1, False), (1, False), (2, False), (2, True)):
        info = env.step(action)[4]
        assert info["landed"] == landed
    assert info["dock_distance_m"] == 0.0


@pytest.mark.parametrize("action", [-1, 7, 1.0, "left", None])
def test_an_action_outside_the_space_is_named(action):
    env = DataCollectionEnv(tiny())
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match=f"{action!r}.*0 left.*6 hover"):
        env.step(action)


def test_a_step_needs_a_mission():
    env = DataCollectionEnv(tiny(mission={"max_steps": 4}))
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(0)
    env.reset(seed=0)
    for _ in range(4):
        env.step(6)
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(6)


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"'radar'.*position, mission, map"):
        DataCollectionEnv(tiny(), observation="radar")
    with pytest.raises(ValueError, match=r"'human'.*rgb_array"):
        DataCollectionEnv(tiny(), render_mode="human")
    with pytest.raises(ScenarioError, match="'nowhere'"):
        DataCollectionEnv("nowhere")


def test_observations_stay_within_their_space_for_a_centre_off_the_grid():
    scenario = changed(
        "three_clusters_hover", users={"cluster_centres_m": [[-100.0, 1100.0], [0.0, 0.0], [1100.0, 5.0]]}
    )
    env = DataCollectionEnv(scenario, "map")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    for action in [0, 3, 1, 1, 1, 2, 2, 2] * 5:
        assert env.observation_space.contains(env.step(action)[0])
