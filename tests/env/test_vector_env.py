"""The vector environment is as many single ones."""

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.vector import AutoresetMode

from tests.support.worlds import tiny
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.env.registration import ENV_ID
from uav_dc_ros.env.vector_env import DataCollectionVectorEnv

pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.parametrize("end", ["at_time_limit", "on_arrival"])
def test_it_equals_single_environments_to_the_last_bit(end):
    """Also over the ends of missions: an environment that has ended restarts at the next step."""
    scenario = tiny(mission={"episode_end": end, "max_steps": 12})
    vector, singles = DataCollectionVectorEnv(5, scenario), [DataCollectionEnv(scenario) for _ in range(5)]
    results = [env.reset(seed=40 + i) for i, env in enumerate(singles)]
    observation, infos = vector.reset(seed=40)
    actions, over, ended = np.random.default_rng(0), np.zeros(5, bool), 0
    for _ in range(60):
        for i, result in enumerate(results):
            np.testing.assert_array_equal(observation[i], result[0])
            for key, value in result[-1].items():
                np.testing.assert_array_equal(infos[key][i], value, err_msg=key)
        action = actions.integers(0, 7, 5)
        observation, reward, terminated, truncated, infos = vector.step(action)
        results = []
        for i, env in enumerate(singles):
            first, info = env.reset() if over[i] else (None, None)
            results.append((first, 0.0, False, False, info) if over[i] else env.step(action[i]))
            assert (reward[i], terminated[i], truncated[i]) == results[-1][1:4]
        over = terminated | truncated
        ended += over.sum()
    assert ended >= 20


def test_make_vec_finds_it():
    made = gymnasium.make_vec(ENV_ID, num_envs=3, scenario="three_clusters_hover", observation="position")
    assert isinstance(made, DataCollectionVectorEnv)
    assert made.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observation, _ = made.reset(seed=[1, 2, 1])
    assert made.observation_space.contains(observation)
    np.testing.assert_array_equal(
        made.reset(seed=[1, None, 1])[1]["users_m"][0], made.reset(seed=1)[1]["users_m"][0]
    )


def test_mistakes_are_named():
    vector = DataCollectionVectorEnv(2, tiny())
    with pytest.raises(ResetNeeded):
        vector.step(np.zeros(2, np.int64))
    vector.reset(seed=0)
    with pytest.raises(InvalidAction, match="9"):
        vector.step(np.array([0, 9]))
    with pytest.raises(ValueError, match="3 entries; expected num_envs = 2"):
        vector.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="rgb_array"):
        DataCollectionVectorEnv(2, tiny(), render_mode="rgb_array")
