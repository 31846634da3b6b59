"""CPU time of a planner's decision, milliseconds: median, 99th percentile and maximum over whole missions.

    OMP_NUM_THREADS=1 python benchmarks/planners.py [--missions N] [--planner NAME ...] [--scenario NAME ...]

Each line is one planner in one scenario, one mission at a time, as in the policy node.
"""

import argparse
import time

import numpy as np

from uav_dc_ros import scenarios
from uav_dc_ros.core.world import Act, State, rollout_steps
from uav_dc_ros.planners import PLANNERS


def timed(act: Act, times_s: list[float]) -> Act:
    """The actions of `act`; adds the CPU time of each decision to `times_s`."""

    def measured(state: State) -> np.ndarray:
        begun_s = time.process_time()
        action = act(state)
        times_s.append(time.process_time() - begun_s)
        return action

    return measured


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--missions", type=int, default=3)
    parser.add_argument("--planner", nargs="+", choices=PLANNERS, default=list(PLANNERS))
    parser.add_argument("--scenario", nargs="+", default=scenarios.names())
    options = parser.parse_args()
    for name in options.scenario:
        scenario = scenarios.load(name)
        for planner in options.planner:
            times_s: list[float] = []
            act = timed(PLANNERS[planner](scenario), times_s)
            for seed in range(options.missions):
                for _ in rollout_steps(scenario, act, [seed]):
                    pass
            median, high, most = 1e3 * np.percentile(times_s, [50, 99, 100])
            print(f"{name:22} {planner:11} {median:7.2f} {high:7.2f} {most:7.2f}", flush=True)


if __name__ == "__main__":
    main()
