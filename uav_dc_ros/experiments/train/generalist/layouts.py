"""Random layouts to train on.

Half of them are fields of `scenario random`, of other seeds. The others are wider, and drawn in milliseconds.
What a layout leaves open to skill is drawn, too: the budget is a multiple, from too little to plenty, of the
shortest tour with the hovers that its users need. Everything else is drawn over the ranges below. A few
layouts have single users instead of clusters, no-fly zones, or a battery that ends missions.
"""

import math
from typing import Any

import numpy as np

from uav_dc_ros import scenarios
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import ScenarioError

# Ranges of seeds. Layouts that train, select and test have no seed in common: those of `random:SEED`, which
# test, are drawn by another rule besides.
TRAINING_SEEDS = range(10_000_000, 1_000_000_000)
SELECTION_SEEDS = range(1_000_000, 2_000_000)
SELECTION_LAYOUTS, SELECTION_MISSIONS = 64, 8  # the first of these seeds, and missions of each
TRIES = 100  # drafts of a layout

_RANDOM_FIELDS = 0.5  # share of the layouts
_SINGLES, _ZONES, _BATTERY, _ON_ARRIVAL = 0.2, 0.08, 0.06, 0.15  # shares of the others
_APART = 0.6  # share of those with clusters in which discs do not touch, where there is room
_MANY_BITS = 1e15  # more than any user delivers in a step
_HOVERS_MAX = 8  # steps over a cluster that the budget counts at most


def draw(seed: int) -> Scenario:
    """The layout of a seed, named `layout_SEED` or `random_SEED`."""
    rng = np.random.default_rng(seed)
    if rng.random() < _RANDOM_FIELDS:
        return scenarios.load(f"{scenarios.RANDOM}{seed}")
    for _ in range(TRIES):
        try:
            return _draft(rng, seed)
        except ScenarioError:  # such as zones that close the way to the dock
            continue
    raise AssertionError(f"layout {seed}: {TRIES} drafts are no scenario")


def _draft(rng: np.random.Generator, seed: int) -> Scenario:
    def between(low: float, high: float) -> float:
        return float(f"{rng.uniform(low, high):.4g}")

    def scaled(low: float, high: float) -> float:  # uniform in the logarithm
        return float(f"{math.exp(rng.uniform(math.log(low), math.log(high))):.4g}")

    n_x, n_y = (round(scaled(6, 20)) for _ in range(2))
    n_z = int(rng.integers(1, 6))
    cell_m, low_m, layer_m = scaled(40.0, 200.0), scaled(40.0, 150.0), between(10.0, 60.0)
    wide_m, high_m = (n_x - 1) * cell_m, (n_y - 1) * cell_m
    step_s = float(f"{cell_m / scaled(4.0, 16.0):.3g}")
    start, dock = ((int(rng.integers(n_x)), int(rng.integers(n_y))) for _ in range(2))
    start_z = int(rng.integers(n_z)) if rng.random() < 0.5 else n_z - 1
    users = _users(rng, (wide_m, high_m), cell_m)
    users["v_max_mps"] = between(0.0, 0.25) * cell_m / step_s if rng.random() < 0.8 else 0.0
    d_cons_m = math.ceil(math.hypot(low_m, scaled(0.8, 3.5) * cell_m))
    values: dict[str, Any] = {
        "name": f"layout_{seed}",
        "grid": {
            "n_x": n_x,
            "n_y": n_y,
            "n_z": n_z,
            "cell_m": cell_m,
            "altitude_min_m": low_m,
            "altitude_step_m": layer_m,
        },
        "users": users,
        "mission": {
            "start_m": (start[0] * cell_m, start[1] * cell_m, low_m + start_z * layer_m),
            "dock_m": (dock[0] * cell_m, dock[1] * cell_m),
            "step_s": step_s,
            "max_steps": 10_000,
            "d_cons_m": d_cons_m,
            "r_min_bits": _MANY_BITS,
            "episode_end": "on_arrival" if rng.random() < _ON_ARRIVAL and start != dock else "at_time_limit",
        },
        "radio": {
            "model": "free_space",
            "bandwidth_hz": 1e6,
            "tx_power_w": scaled(0.1, 5.0),
            "noise_power_dbm": -110.0,
            "ref_gain_db": -50.0,
            "path_loss_exponent": between(2.0, 2.6),
            "interference": str(rng.choice(["all", "associated", "none"], p=[0.75, 0.15, 0.1])),
        },
        "reward": {
            "beta": 1.0,
            "zeta": 1.0,
            "r_plus": "binary",
            "form": "episode",
            "data_scale_bits": 1.0,
            "data": "so_far",
        },
    }
    if rng.random() < _ZONES:
        values["obstacles"] = [_zone(rng, wide_m, high_m, cell_m) for _ in range(int(rng.integers(1, 5)))]
    needed_steps = scaled(0.3, 3.0) if rng.random() < 0.5 else between(2.0, 6.0)
    factor = between(0.7, 1.6)
    battery = between(0.7, 1.2) if rng.random() < _BATTERY else None
    draft = from_values(values, values["name"])
    # What a user of a usual cluster delivers in a step over it, bit.
    step_bits = _MANY_BITS * float(np.median(draft.entity_tables.best))
    if step_bits <= 0.0:
        raise ScenarioError("no user is in reach")
    values["mission"]["r_min_bits"] = float(f"{needed_steps * step_bits:.3g}")
    tables, start_row = draft.entity_tables, (start[0] * n_y + start[1]) * n_z + start_z
    ways = tables.of_cell[start_row, : draft.n_clusters]
    tour = float((ways[tables.first] + tables.tours[-1]).min())
    home = float(tables.of_cell[start_row, draft.n_clusters])
    best_bits = _MANY_BITS * np.maximum(tables.best, 1e-30)
    hovers = np.minimum(np.ceil(values["mission"]["r_min_bits"] / best_bits), _HOVERS_MAX)
    n_hovers = float(hovers.sum())
    if users.get("user"):  # those around one cell are collected together, or one after another
        together = 1.5 * len(tables.first)
        n_hovers = scaled(together, max(together, n_hovers))
    max_steps = max(math.ceil(factor * (tour + n_hovers)), math.ceil(home), 4)
    values["mission"]["max_steps"] = min(max_steps, 160)
    if battery is not None:
        values["energy"] = {"battery_j": 1.0, "ends": "steps"}
        energies_j = from_values(values, values["name"]).step_energies_j
        values["energy"] = {"battery_j": battery * max_steps * max(energies_j), "ends": "both"}
    return from_values(values, values["name"])


def _users(rng: np.random.Generator, size_m: tuple[float, float], cell_m: float) -> dict[str, Any]:
    """A table `users` without speed: clusters, or single users."""
    wide_m, high_m = size_m
    if rng.random() < _SINGLES:
        n = int(rng.integers(6, 41))
        places = rng.uniform(0.0, 1.0, (n, 2)) * (wide_m, high_m)
        return {"user": [{"x_m": round(x_m, 1), "y_m": round(y_m, 1)} for x_m, y_m in places.tolist()]}
    n, radius_m = int(rng.integers(1, 9)), round(float(rng.uniform(0.1, 1.5)) * cell_m, 1)
    apart_m = 2.0 * radius_m if rng.random() < _APART else 0.0
    centres_m: list[tuple[float, float]] = []
    for _ in range(10 * n):
        place = round(rng.random() * wide_m, 1), round(rng.random() * high_m, 1)
        if len(centres_m) < n and all(math.dist(place, other) >= apart_m for other in centres_m):
            centres_m.append(place)
    n = len(centres_m)
    sizes = rng.integers(2, 17, n).tolist() if rng.random() < 0.4 else int(rng.integers(3, 17))
    return {"cluster_centres_m": centres_m, "users_per_cluster": sizes, "cluster_radius_m": radius_m}


def _zone(rng: np.random.Generator, wide_m: float, high_m: float, cell_m: float) -> dict[str, Any]:
    """A rectangular no-fly zone, plain values."""
    x_m, y_m = (rng.uniform(0.0, 1.0, 2) * (wide_m, high_m)).tolist()
    a_m, b_m = (rng.uniform(0.5, 3.0, 2) * cell_m).tolist()
    corners_m = [(x_m, y_m), (x_m + a_m, y_m), (x_m + a_m, y_m + b_m), (x_m, y_m + b_m)]
    polygon_m = [(round(x, 1), round(y, 1)) for x, y in corners_m]
    return {"name": "", "kind": "no_fly", "polygon_m": polygon_m, "clearance_m": 0.0}
