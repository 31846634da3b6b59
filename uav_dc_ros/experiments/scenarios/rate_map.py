"""Rates over the field: the sum-rate of the users in reach, with the UAV over each cell."""

from typing import NamedTuple

import numpy as np

from uav_dc_ros.core import radio, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.recordings.thinning import spread

CELLS_MAX = 60  # of a side; of more, evenly spread ones
LAYERS_MAX = 6
SEEDS_MAX = 20  # missions whose users' start positions are averaged
USERS_MAX = 20_000  # of all these missions
_BLOCK = 2_000_000  # users times cells at a time


class Layer(NamedTuple):
    """The rates at one altitude."""

    altitude_m: float
    reach_m: float  # radius on the ground within `mission.d_cons_m`; 0: nothing is in reach
    # Mean over the start positions of some missions, `[X, Y]`; NaN where an obstacle closes the cell
    sum_rate_bps: Array


class RateMap(NamedTuple):
    """The rates of a field."""

    east_m: Array  # of the cells, `[X]`
    north_m: Array  # `[Y]`
    layers: list[Layer]  # from the lowest to the highest
    users_m: Array  # start positions of the mission with seed 0, `[U, 2]`
    missions: int  # seeds 0 to missions - 1


def rate_map(scenario: Scenario) -> RateMap:
    """Rates with the scenario's own channel and interference, before anything is collected."""
    grid = scenario.grid
    missions = max(1, min(SEEDS_MAX, USERS_MAX // scenario.n_users))
    draws = np.stack([np.random.default_rng(seed).random(scenario.draws_shape) for seed in range(missions)])
    state = world.initial(scenario, draws)
    east, north = (np.asarray(spread(n, CELLS_MAX)) for n in grid.shape[:2])
    columns = np.stack(np.meshgrid(east, north, indexing="ij"), axis=-1).reshape(-1, 2)
    layers = []
    for up in spread(grid.n_z, LAYERS_MAX):
        cells = np.concatenate([columns, np.full((len(columns), 1), up)], axis=1)
        uav_m = grid.centre_m(cells, like=state.users_m)
        block = max(1, _BLOCK // state.collected.size)
        rates = []
        for few_m in np.array_split(uav_m, -(-len(uav_m) // block)):
            uavs_m = np.broadcast_to(few_m[:, None], (len(few_m), missions, 3))
            users_m, collected = (
                np.broadcast_to(one, (len(few_m), *one.shape)) for one in (state.users_m, state.collected)
            )
            rates.append(world.measure(scenario, uavs_m, users_m, collected).sum_rate_bps.mean(axis=-1))
        of_layer = np.concatenate(rates)
        if scenario.moves is not None:
            of_layer = np.where(scenario.moves.free[tuple(cells.T)], of_layer, np.nan)
        altitude_m = float(uav_m[0, 2])
        reach_m = radio.ground_reach_m(scenario.mission.d_cons_m, altitude_m)
        layers.append(Layer(altitude_m, reach_m, of_layer.reshape(len(east), len(north))))
    return RateMap(east * grid.cell_m, north * grid.cell_m, layers, state.users_m[0], missions)


def scale_bar_m(wide_m: float) -> float:
    """A round length, 1, 2 or 5 times a power of ten, of at most a quarter of a width."""
    power = 10.0 ** np.floor(np.log10(wide_m / 4.0))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= wide_m / 4.0))
