"""World steps per second on one core, without a learner, over the number of users and of buildings.

    python benchmarks/world_steps.py [REPEATS]

A world step is the users' walk, the radio, the reward and the position observation, in float32, for N
worlds side by side, as the trainer has them. Counted in: every world's own random draws, made a mission
at a time, and the start of each mission. NumPy computes all of it in one thread.

The bare limit in the same run: the same draws, and NumPy's cos, sin, sqrt and log1p once for every user,
into memory that is there already. A world in NumPy cannot do without these.
"""

import statistics
import sys
import time
import tracemalloc

import msgspec
import numpy as np

from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.core.world import BatchWorld

# Users, and worlds side by side: enough to drown the cost of a call, few enough to stay near the cache.
SIZES = ((10, 4096), (50, 1024), (100, 1024), (1000, 64), (10_000, 8))
TARGET = (50, 500_000)  # users, world steps per second
TOWNS = (
    (50, 5, 512),
    (50, 10, 512),
    (50, 100, 128),
    (1000, 100, 16),
)  # users, buildings, worlds side by side
TOWN_TARGET = (50, 100_000)


def field(n_users: int, n_buildings: int = 0) -> Scenario:
    """`five_clusters_hover` with another number of users, and buildings 20 to 60 m wide and high."""
    values = msgspec.to_builtins(scenarios.load("five_clusters_hover"))
    rng = np.random.default_rng(0)
    boxes = np.stack([rng.uniform(50, 890, n_buildings), rng.uniform(50, 890, n_buildings)], axis=-1)
    sizes = rng.uniform(20, 60, (n_buildings, 3))
    values["obstacles"] = [
        {"polygon_m": [[x, y], [x + a, y], [x + a, y + b], [x, y + b]], "height_m": height}
        for (x, y), (a, b, height) in zip(boxes.tolist(), sizes.tolist(), strict=True)
    ]
    if n_buildings:
        values["radio"]["obstruction_loss_db"] = 20.0
    values["users"]["users_per_cluster"] = n_users // len(values["users"]["cluster_centres_m"])
    return from_values(values, f"five_clusters_hover with {n_users} users")


class Bench:
    """N worlds of one scenario and the generators of their draws.

    Attributes:
        n_steps: world steps of one mission of all worlds.
    """

    def __init__(self, scenario: Scenario, n_worlds: int) -> None:
        self.scenario = scenario
        max_steps = scenario.mission.max_steps
        self.n_steps = n_worlds * max_steps
        self._rngs = [np.random.default_rng(seed) for seed in range(n_worlds)]
        self._draws = np.empty((n_worlds, max_steps + 1, scenario.n_users, 2), np.float32)
        self._actions = np.random.default_rng(0).integers(len(Action), size=(max_steps, n_worlds))
        self._bare = np.empty((n_worlds, scenario.n_users), np.float32)

    def mission(self) -> float:
        """Flies a mission in every world; seconds."""
        started_s = time.perf_counter()
        self._draw()
        worlds = BatchWorld(self.scenario, self._draws[:, 0])
        for step, action in enumerate(self._actions, start=1):
            worlds.step(action, self._draws[:, step])
            worlds.observe("position")
        return time.perf_counter() - started_s

    def bare(self) -> float:
        """The draws and the functions of as many steps; seconds."""
        numbers = np.random.default_rng(0).random(self._bare.shape, np.float32)
        started_s = time.perf_counter()
        self._draw()
        for _ in range(self.scenario.mission.max_steps):
            for function in (np.cos, np.sin, np.sqrt, np.log1p):
                function(numbers, out=self._bare)
        return time.perf_counter() - started_s

    def _draw(self) -> None:
        for rng, draws in zip(self._rngs, self._draws, strict=True):
            rng.random(out=draws, dtype=np.float32)


def main() -> None:
    """Prints a row for each number of users, and for each town: medians, and the best of all repeats."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 9
    print(f"world steps per second on one core, float32, numpy {np.__version__}, {repeats} missions each")
    print(f"{'users':>6} {'worlds':>6} {'median':>10} {'best':>10} {'users/s':>10}   time / bare limit")
    for n_users, n_worlds in SIZES:
        bench = Bench(field(n_users), n_worlds)
        bench.mission()  # the first touches the memory
        times_s = [(bench.mission(), bench.bare()) for _ in range(repeats)]
        rate = bench.n_steps / statistics.median(flown for flown, _ in times_s)
        best = bench.n_steps / min(flown for flown, _ in times_s)
        ratio = statistics.median(flown / bare for flown, bare in times_s)
        verdict = ""
        if n_users == TARGET[0]:
            verdict = f"   target {TARGET[1]:,}: {'met' if rate >= TARGET[1] else 'missed'}"
        counts = f"{n_users:6} {n_worlds:6} {rate:10,.0f} {best:10,.0f} {rate * n_users / 1e6:8.1f} M"
        print(f"{counts}   {ratio:.1f}{verdict}")
    print(f"{'users':>6} {'bldgs':>6} {'worlds':>6} {'median':>10} {'best':>10}   peak MB of a mission")
    for n_users, n_buildings, n_worlds in TOWNS:
        bench = Bench(field(n_users, n_buildings), n_worlds)
        bench.mission()
        times_s = [bench.mission() for _ in range(repeats)]
        tracemalloc.start()
        bench.mission()
        peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        rate, best = bench.n_steps / statistics.median(times_s), bench.n_steps / min(times_s)
        verdict = ""
        if n_users == TOWN_TARGET[0]:
            verdict = f"   target {TOWN_TARGET[1]:,}: {'met' if rate >= TOWN_TARGET[1] else 'missed'}"
        print(
            f"{n_users:6} {n_buildings:6} {n_worlds:6} {rate:10,.0f} {best:10,.0f}   {peak_mb:.0f}{verdict}"
        )


if __name__ == "__main__":
    main()
