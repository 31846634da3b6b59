"""One mission in the Gymnasium environment, flown by a shipped policy. Needs no ROS.

pip install -e '.[train]' && python examples/one_episode.py
"""

import uav_dc_ros  # makes the environment known to Gymnasium

import gymnasium  # isort: skip

policy = uav_dc_ros.load_policy("five_clusters_dueling")
env = gymnasium.make(
    "uav_dc_ros/DataCollection-v0",
    scenario="five_clusters",  # or the path of a TOML file
    observation=policy.config.observation,  # the policy must see what it learnt with
)

observation, info = env.reset(seed=0)  # the seed says where users start and how they walk
episode_return, over = 0.0, False
while not over:
    action = policy.act(observation)  # greedy: the action with the largest Q-value
    observation, reward, terminated, truncated, info = env.step(action)
    episode_return += float(reward)
    over = terminated or truncated

print(f"{'landed' if info['landed'] else 'did not land'} after {info['step']} steps")
print(f"{info['collected'].sum()} of {info['collected'].size} users collected, return {episode_return:.3f}")
