"""CPU time of a decision of policies and planners, milliseconds, over whole missions.

    OMP_NUM_THREADS=1 python benchmarks/decisions.py [--missions N] [--agent NAME ...] [--search N ...]
        [--scenario NAME ...]

Each line is one of them in one scenario, one mission at a time, as in the policy node: the first decision,
which prepares tables, and the median, the 99th percentile and the maximum of the others.
"""

import argparse

import numpy as np

from uav_dc_ros import scenarios
from uav_dc_ros.core.world import rollout_steps
from uav_dc_ros.experiments.evaluate.cli import candidates
from uav_dc_ros.experiments.leaderboard.decision_times import timed
from uav_dc_ros.planners import PLANNERS


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--missions", type=int, default=3)
    parser.add_argument("--agent", nargs="+", default=list(PLANNERS), metavar="NAME|DIR")
    parser.add_argument("--search", nargs="+", type=int, default=[0], metavar="N", help="of policies")
    parser.add_argument("--scenario", nargs="+", default=scenarios.names())
    options = parser.parse_args()
    print(f"{'':20} {'':36} {'first':>7} {'median':>7} {'99%':>7} {'maximum':>7}")
    for name in options.scenario:
        scenario = scenarios.load(name)
        for one in candidates(options.agent, options.search):
            times_s: list[float] = []
            act = timed(one.act_in(scenario), times_s)
            for seed in range(options.missions):
                for _ in rollout_steps(scenario, act, [seed]):
                    pass
            ms = 1e3 * np.asarray(times_s)
            figures = ms[0], *np.percentile(ms[1:], [50, 99, 100])
            print(f"{name:20} {one.name:36} " + " ".join(f"{value:7.2f}" for value in figures), flush=True)


if __name__ == "__main__":
    main()
