"""Train a policy for a world of your own, evaluate it, and fly it as a ROS 2 node.

python examples/train_and_deploy.py [EPISODES] [FOLDER]

Needs the extras ros and train. With 60 episodes, less than a minute, it lands with nine of ten users.
"""

import subprocess
import sys
from pathlib import Path

from uav_dc_ros import RunConfig, evaluate_policy, fly, load_policy, load_scenario

SCENARIO = Path(__file__).with_name("own_scenario.toml")
episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 60
folder = Path(sys.argv[2]) if len(sys.argv) > 2 else Path("own")

# 1. Train: eight runs learn side by side, and the best one is kept. A policy is never overwritten.
train = ["--scenario", SCENARIO, "--algo", "dueling_dqn", "--out", folder / "policy", "--runs", 8]
train += ["--episodes", episodes, "--gamma", 0.99, "--batch-size", 64, "--epsilon", 0.95]
subprocess.run([sys.executable, "-m", "uav_dc_ros.train", *map(str, train)], check=True)

# 2. Evaluate: the same code as on the policy's card, over missions that it has not seen.
scenario, policy = load_scenario(SCENARIO), load_policy(folder / "policy")
evaluation = evaluate_policy(policy, scenario, seeds=range(100))
print(f"in numpy: {evaluation.users_collected.mean:.1f} of {evaluation.users_total} users collected")
print(f"          {evaluation.landing_rate.mean:.0%} of the missions landed")

# 3. Fly it: world, channel monitor, policy and recorder are ROS 2 nodes, and the flight becomes a bag.
config = RunConfig(scenario=SCENARIO, policy=folder / "policy", pace="lockstep", bag=folder / "bag")
(summary,) = fly(config)
print(f"in ROS 2: {summary.users_collected} of {summary.users_total} users collected, {summary.outcome}")
print(f"bag: {summary.bag}")
