"""Agent steps per second of the DQN of stable-baselines3 on this project's environment.

    python benchmarks/sb3_dqn.py [STEPS] [TORCH_THREADS]

An agent step is one environment step and one gradient step. Scenario, network and hyperparameters are
those of `benchmarks/learner.py`; the environment is the one that Gymnasium users get. Prints one line of
JSON, with the rate as stable-baselines3 comes, and the best that was found with its settings: eight
environments side by side (with as many gradient steps) and torch's fused Adam. One thread of torch is the
default: two were slower as it comes, and no faster at its best. Needs `pip install stable-baselines3`, best
in a virtual environment of its own.
"""

import json
import sys
import time

import gymnasium
import stable_baselines3
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import DummyVecEnv

import uav_dc_ros  # noqa: F401  makes the environment known

WARM_UP_STEPS = 400
LEARNING_STARTS = 100


def environment() -> gymnasium.Env:
    """One environment, without Gymnasium's checks of every step."""
    return gymnasium.make(
        "uav_dc_ros/DataCollection-v0",
        scenario="five_clusters_hover",
        observation="position",
        disable_env_checker=True,
    )


def steps_per_second(n_steps: int, n_envs: int = 1, fused_adam: bool = False) -> float:
    """Agent steps per second, after a warm-up; torch's threads are the caller's choice.

    Args:
        n_steps: agent steps, a multiple of `n_envs`.
        n_envs: environments side by side.
        fused_adam: one kernel for all of Adam's update.
    """
    # Given a VecEnv, stable-baselines3 adds no monitor; nothing is logged on the way: its best case.
    learner = DQN(
        "MlpPolicy",
        DummyVecEnv([environment] * n_envs),
        policy_kwargs={"net_arch": [64, 64], "optimizer_kwargs": {"fused": fused_adam}},
        batch_size=32,
        buffer_size=50_000,
        learning_rate=1e-3,
        learning_starts=LEARNING_STARTS,
        train_freq=1,
        gradient_steps=n_envs,
        target_update_interval=500,
        gamma=0.9,
        exploration_initial_eps=0.1,
        exploration_final_eps=0.1,
        device="cpu",
        seed=0,
    )
    learner.learn(WARM_UP_STEPS, log_interval=None)
    before = learner._n_updates
    started_s = time.perf_counter()
    learner.learn(n_steps, log_interval=None, reset_num_timesteps=False)
    took_s = time.perf_counter() - started_s
    assert learner._n_updates - before == n_steps, "one gradient step for each environment step"
    return n_steps / took_s


def environment_steps_per_second(n_steps: int) -> float:
    """Steps per second of the environment alone: what no learner around it can pass."""
    env = environment()
    env.reset(seed=0)
    started_s = time.perf_counter()
    for _ in range(n_steps):
        if any(env.step(6)[2:4]):
            env.reset()
    return n_steps / (time.perf_counter() - started_s)


def main() -> None:
    """Prints the rates as one line of JSON."""
    n_steps = int(sys.argv[1]) if len(sys.argv) > 1 else 3200
    torch.set_num_threads(int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    rates = {
        "stable_baselines3": stable_baselines3.__version__,
        "torch": torch.__version__,
        "torch_threads": torch.get_num_threads(),
        "steps": n_steps,
        "agent_steps_per_s": round(steps_per_second(n_steps), 1),
        "best_agent_steps_per_s": round(steps_per_second(n_steps, n_envs=8, fused_adam=True), 1),
        "environment_steps_per_s": round(environment_steps_per_second(n_steps), 1),
    }
    print(json.dumps(rates))


if __name__ == "__main__":
    main()
