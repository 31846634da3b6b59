"""Worlds drawn by a scrambled Sobol sequence over the choices.

Point p of the sequence is one candidate. A candidate that cannot exist is rejected, and the next point takes
its place: world n is the n-th candidate that can. So the first worlds of any N are the same. Needs torch.
"""

from collections import Counter
from collections.abc import Sequence
from itertools import permutations
from typing import Any, TypeAlias

import msgspec
import numpy as np
import torch

from uav_dc_ros.core import mobility
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.core.world import measure
from uav_dc_ros.experiments.paper.worlds.choices import (
    ALTITUDE_STEP_M,
    CHOICES,
    GIVEN,
    PLACES,
    Value,
)

Point: TypeAlias = tuple[float, float]

_SEED = 0  # of the scrambling
_RASTER_M = 10.0  # of the clusters' centres
_SCENARIOS = {"five_clusters": "five_clusters_m", "three_clusters": "three_clusters_m"}


class World(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A world of the multiverse: both settings of the paper, with equal values except for the layout.

    The fields are `choices.CHOICES` and `PLACES`, and what follows from them.
    """

    number: int  # in the multiverse, from 0
    point: int  # of the Sobol sequence
    cells: int
    cell_m: float
    speed_mps: float
    altitude_min_m: float
    altitude_max_m: float
    cluster_radius_m: float
    v_max_mps: float
    tx_power_w: float
    d_cons_m: float
    r_min_steps: float
    time_per_tour: float
    data_scale: float
    data: str
    interference: str
    episode_end: str
    hidden: str
    target_every: int
    buffer_size: int
    dock_m: Point
    five_clusters_m: tuple[Point, ...]
    three_clusters_m: tuple[Point, ...]
    max_steps: int
    r_min_bits: float = 1.0
    data_scale_bits: float = 1.0

    @property
    def step_s(self) -> float:
        """Duration of a step, seconds."""
        return float(f"{self.cell_m / self.speed_mps:.3g}")

    @property
    def mission_s(self) -> float:
        """Duration of a mission, seconds."""
        return self.max_steps * self.step_s

    @property
    def layers(self) -> tuple[int, ...]:
        """Units of the hidden layers."""
        return tuple(map(int, self.hidden.split("-")))

    def scenario(self, name: str) -> Scenario:
        """Its scenario `five_clusters` or `three_clusters`."""
        n_z = 1 + round((self.altitude_max_m - self.altitude_min_m) / ALTITUDE_STEP_M)
        values: dict[str, Any] = {
            "name": name,
            "grid": {
                "n_x": self.cells,
                "n_y": self.cells,
                "n_z": n_z,
                "cell_m": self.cell_m,
                "altitude_min_m": self.altitude_min_m,
                "altitude_step_m": ALTITUDE_STEP_M,
            },
            "users": {
                "cluster_centres_m": getattr(self, _SCENARIOS[name]),
                "users_per_cluster": GIVEN["users_per_cluster"],
                "cluster_radius_m": self.cluster_radius_m,
                "v_max_mps": self.v_max_mps,
            },
            "mission": {
                "start_m": GIVEN["start_m"],
                "dock_m": self.dock_m,
                "step_s": self.step_s,
                "max_steps": self.max_steps,
                "d_cons_m": self.d_cons_m,
                "r_min_bits": self.r_min_bits,
                "episode_end": self.episode_end,
            },
            "radio": {
                **GIVEN["radio"],  # type: ignore[dict-item]
                "tx_power_w": self.tx_power_w,
                "interference": self.interference,
            },
            "reward": {
                "beta": 1.0,
                "zeta": 1.0,
                "r_plus": "exponential",
                "form": "episode",
                "data_scale_bits": self.data_scale_bits,
                "data": self.data,
            },
        }
        return from_values(values, f"world {self.number}")

    def features(self) -> dict[str, Value]:
        """A value for each choice; a layout is the length of its shortest tour over that of the direct way.

        The dock is its way from the start in widths of the field.
        """
        width_m = (self.cells - 1) * self.cell_m
        features = {choice.name: getattr(self, choice.name) for choice in CHOICES}
        direct_m = sum(self.dock_m)
        features["dock_m"] = direct_m / width_m
        for name in _SCENARIOS.values():
            features[name] = tour_m(getattr(self, name), self.dock_m) / direct_m
        return features


def worlds(n: int) -> tuple[list[World], dict[str, int]]:
    """The first n worlds, and the number of candidates rejected before the last of them, by reason."""
    engine = torch.quasirandom.SobolEngine(  # type: ignore[no-untyped-call]
        len(CHOICES) + sum(place.n for place in PLACES), scramble=True, seed=_SEED
    )
    found: list[World] = []
    rejected: Counter[str] = Counter()
    point = 0
    while len(found) < n:
        for u in engine.draw(n, dtype=torch.float64).tolist():
            made = _candidate(u, len(found), point)
            point += 1
            if isinstance(made, str):
                rejected[made] += 1
                continue
            found.append(made)
            if len(found) == n:
                break
    return found, dict(sorted(rejected.items()))


def tour_m(centres_m: Sequence[Point], dock_m: Point) -> float:
    """Length of the shortest way along the axes, from the start past all centres to the dock, metres."""
    stops = np.array([(0.0, 0.0), *centres_m, dock_m])
    way_m = np.abs(stops[:, None] - stops).sum(axis=-1)
    last = len(stops) - 1
    orders = np.array([(0, *order, last) for order in permutations(range(1, last))])
    return float(way_m[orders[:, :-1], orders[:, 1:]].sum(axis=1).min())


def _candidate(u: Sequence[float], number: int, point: int) -> World | str:
    """The world at a point of the unit cube, or the reason why it cannot exist."""
    own = iter(u)
    values: dict[str, Any] = {choice.name: choice.values.at(next(own)) for choice in CHOICES}
    cell_m, n, radius_m = values["cell_m"], values["cells"], values["cluster_radius_m"]
    width_m = (n - 1) * cell_m
    cells_m = _raster(np.arange(n) * cell_m)
    far = np.hypot(*cells_m.T) >= width_m / 2
    dock_m = _place([next(own)], cells_m[far], 0.0)
    inside = np.arange(np.ceil(radius_m / _RASTER_M), (width_m - radius_m) // _RASTER_M + 1) * _RASTER_M
    five_m, three_m = (
        _place([next(own) for _ in range(place.n)], _raster(inside), 2 * radius_m) for place in PLACES[1:]
    )
    if five_m is None or three_m is None or dock_m is None:
        return "no place is left for a cluster at least 2 C from the others"
    moves = tour_m(five_m, dock_m[0]) / cell_m
    max_steps = round(values["time_per_tour"] * moves)
    if max_steps < round(sum(dock_m[0]) / cell_m):
        return "the dock is more than T_cons moves from the start"
    world = World(
        number=number,
        point=point,
        **values,
        dock_m=dock_m[0],
        five_clusters_m=five_m,
        three_clusters_m=three_m,
        max_steps=max_steps,
    )
    return _scaled(world)


def _scaled(world: World) -> World:
    """The world with r_min and the scale of the data in bits."""
    scenario = world.scenario("five_clusters")
    step_bits = _hover_bits(scenario)
    r_min_bits = world.r_min_steps * step_bits
    # A usual mission serves one cluster of five at a time (`step`), or collects all users (`so_far`).
    usual_bits = step_bits / scenario.n_clusters if world.data == "step" else max(r_min_bits, step_bits)
    return msgspec.structs.replace(
        world,
        r_min_bits=float(f"{r_min_bits:.3g}"),
        data_scale_bits=float(f"{world.data_scale * usual_bits:.3g}"),
    )


def _hover_bits(scenario: Scenario) -> float:
    """What a user delivers in a step with the UAV over its cluster's centre, in the lowest layer, bit.

    It is the mean over all users, who stand around their centre at the distance that half of them exceed.
    """
    per_cluster = scenario.users.sizes[0]
    turn = np.tile(np.arange(per_cluster) / per_cluster, scenario.n_clusters)
    draws = np.stack([np.full_like(turn, 0.5), turn], axis=-1)
    centres_m = np.array(scenario.user_centres_m)
    users_m = mobility.scatter(centres_m, scenario.user_radii_m(draws), draws)
    over_m = np.array(scenario.cluster_centres_m)
    uav_m = np.column_stack([over_m, np.full(len(over_m), scenario.grid.altitude_min_m)])
    link = measure(scenario, uav_m, np.broadcast_to(users_m, (len(uav_m), *users_m.shape)), np.False_)
    below = scenario.user_cluster == np.arange(len(uav_m))[:, None]
    return float(link.rate_bps[below].mean() * scenario.mission.step_s)


def _raster(axis_m: Array) -> Array:
    """All positions with both coordinates on an axis, `[n, 2]`."""
    return np.stack(np.meshgrid(axis_m, axis_m, indexing="ij"), axis=-1).reshape(-1, 2)


def _place(u: Sequence[float], raster_m: Array, apart_m: float) -> tuple[Point, ...] | None:
    """Positions on a raster `[n, 2]`, each the u-th of those far enough from the ones before."""
    placed: list[Point] = []
    for one in u:
        if not len(raster_m):
            return None
        x_m, y_m = raster_m[int(one * len(raster_m))].tolist()
        placed.append((x_m, y_m))
        raster_m = raster_m[np.hypot(*(raster_m - (x_m, y_m)).T) >= apart_m]
    return tuple(placed)
