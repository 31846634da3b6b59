"""Time of a decision of a policy, as the policy node takes it: observation and network, one at a time.

It is the CPU's time of the thread, which other programs do not lengthen much.

    python benchmarks/decisions.py --policy generalist --scenario five_clusters farm
"""

import argparse
import time

import numpy as np

from uav_dc_ros import load_policy, load_scenario
from uav_dc_ros.core import world
from uav_dc_ros.core.world import initial, step


def main() -> None:
    """Print the median and the 99th percentile in each scenario."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", default="generalist", metavar="NAME|DIR")
    parser.add_argument("--scenario", nargs="+", default=["five_clusters", "town", "farm"])
    parser.add_argument("--missions", type=int, default=40)
    options = parser.parse_args()
    policy = load_policy(options.policy)
    for name in options.scenario:
        scenario = load_scenario(name)
        policy.check(scenario)
        started = time.perf_counter()
        times_s = []
        for seed in range(options.missions):
            rng = np.random.default_rng(seed)
            state, over = initial(scenario, rng.random(scenario.draws_shape)), False
            while not over:
                before = time.thread_time()
                observation = policy.observe(
                    scenario,
                    cell=state.cell,
                    step=state.step,
                    data_bits=state.data_bits,
                    collected=state.collected,
                    energy_used_j=state.energy_used_j,
                )
                action = policy.act(observation, world.action_mask(scenario, state.cell))
                times_s.append(time.thread_time() - before)
                state, outcome = step(scenario, state, action, rng.random(scenario.draws_shape))
                over = bool(outcome.terminated | outcome.truncated)
        first_ms, rest = times_s[0] * 1e3, np.asarray(times_s[1:]) * 1e3
        print(
            f"{name}: first {first_ms:.1f} ms; then median {np.median(rest):.3f}, 99th percentile "
            f"{np.quantile(rest, 0.99):.3f}, maximum {rest.max():.3f} ms over {len(rest)} decisions "
            f"({time.perf_counter() - started:.1f} s)"
        )


if __name__ == "__main__":
    main()
