"""Users of a mission: the same as the environment's, whenever their next step is worked out."""

import gymnasium
import numpy as np

from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.mobility import WalkingUsers
from uav_dc_ros.env.registration import ENV_ID


def test_they_walk_as_in_the_environment() -> None:
    scenario = scenarios.load("three_clusters_hover")
    env = gymnasium.make(ENV_ID, scenario=scenario).unwrapped
    _, info = env.reset(seed=7)
    crowd = WalkingUsers(scenario, 7)
    assert np.array_equal(crowd.positions_m, info["users_m"])
    for step in range(1, 6):
        if step % 2:
            ahead_m = crowd.next_m()
            assert crowd.next_m() is ahead_m
        crowd.walk()
        _, _, _, _, info = env.step(Action.HOVER)
        assert np.array_equal(crowd.positions_m, info["users_m"])
        assert crowd.step == step
    later = WalkingUsers(scenario, 7)
    later.walk(5)
    assert np.array_equal(later.positions_m, crowd.positions_m)
