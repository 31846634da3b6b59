"""What the observation `entities` looks up: of each cell, the ways from it and the data that it gives.

Everything here follows from the scenario alone, and is computed once. Users are taken to be where they start:
those of a disc evenly spread, see `expected_users_m`.
"""

import math
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from uav_dc_ros.core import mobility
from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.obstacles.moves import UNREACHABLE
from uav_dc_ros.core.users.clusters import cluster_means

if TYPE_CHECKING:  # a scenario holds its `EntityTables`
    from uav_dc_ros.core.scenario import Scenario

STOPS_MAX = 8  # of which every order is known; more clusters share stops
FAR = 10_000.0  # moves to where no way leads, and the way of an order that visits what it need not
GOOD = 0.8  # share of the progress in a cluster's best cell that a cell has in which the cluster is served
_BLOCK = 200_000  # links of users that are measured at a time
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


class EntityTables:
    """Tables of one scenario with C cells and M clusters; cell (x, y, z) is row `(x n_y + y) n_z + z`."""

    def __init__(self, scenario: "Scenario") -> None:
        grid, moves, n_clusters = scenario.grid, scenario.moves, scenario.n_clusters
        cells = np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3)  # [C, 3]
        free = np.ones(len(cells), bool)
        targets = [grid.move(cells, np.full(len(cells), action)) for action in Action]
        if moves is not None:
            targets = [moves.apply(cells, np.asarray(i), after) for i, after in enumerate(targets)]
            free = moves.steps_from(np.asarray([scenario.start_cell])).reshape(-1) != UNREACHABLE
        strides = np.asarray((grid.n_y * grid.n_z, grid.n_z, 1))
        # Row of the cell after each action, int64 [C, 7]; that of the cell itself for a move without effect.
        self.after: Array = np.stack([target @ strides for target in targets], axis=-1)
        valid = self.after != np.arange(len(cells))[:, None]
        valid[:, Action.HOVER] = True

        progress = _progress(scenario, cells)  # [C, M]
        served = np.minimum(progress, 1.0)
        best = np.where(free[:, None], progress, 0.0).max(axis=0)
        self.best: Array = best.astype(np.float32)  # progress of each cluster in its best cell, [M]
        good = free[:, None] & (served >= GOOD * np.where(free[:, None], served, 0.0).max(axis=0))
        columns = [_moves_to(scenario, mask.reshape(grid.shape)) for mask in good.T]
        dock = np.zeros(grid.shape, bool)
        dock[scenario.dock_cell] = True
        columns.append(_moves_to(scenario, dock))
        ways = np.stack(columns, axis=-1)  # [C, M + 1]
        # Moves to each cluster and to the dock, then the progress of each cluster, then whether each action
        # has an effect, float32 [C, 2 M + 8].
        self.of_cell: Array = np.concatenate([ways, progress, valid], axis=-1).astype(np.float32)

        centres_m = np.asarray(scenario.cluster_centres_m)
        away_m = np.linalg.norm((cells[:, :2] * grid.cell_m)[:, None] - centres_m, axis=-1)
        # Rows of the cells that stand for the clusters: the nearest good one, the lowest of them, [M].
        places = np.where(good, away_m + 1e-3 * cells[:, 2:], np.inf).argmin(axis=0)
        self.home: Array = ways[places, n_clusters].astype(np.float32)  # moves from there to the dock, [M]
        self.stop_of = _stops(centres_m, np.asarray(scenario.users.sizes))  # of each cluster, [M]
        # The cluster that stands for each stop, [S].
        self.first: Array = np.unique(self.stop_of, return_index=True)[1]
        legs = ways[places[self.first]][:, [*self.first, n_clusters]]
        # Moves of the shortest way from each stop past all others of a set to the dock, by the number of the
        # set (bit i: stop i), float32 [2^S, S]; FAR for a stop that is not in the set.
        self.tours: Array = _tours(legs).astype(np.float32)
        # Stop of each cluster one-hot, float32 [M, S].
        self.members: Array = (self.stop_of[:, None] == np.arange(len(self.first))).astype(np.float32)
        self.cluster_of = np.asarray(scenario.user_cluster)  # of each user, [U]
        self.sizes: Array = np.asarray(scenario.users.sizes, np.float32)  # users of each cluster, [M]
        radii_m = np.asarray([disc.radius_m for disc in scenario.users.clusters])
        self.radii: Array = (radii_m / scenario.mission.d_cons_m).astype(
            np.float32
        )  # in units of d_cons, [M]
        self.goals_cells: Array = np.asarray(scenario.goals_cells, np.float32)  # [M + 1, 2]
        self._on_device: dict[Any, EntityTables] = {}

    def on(self, like: Array) -> "EntityTables":
        """The same tables in the library and on the device of `like`."""
        if isinstance(like, np.ndarray):
            return self
        if like.device not in self._on_device:
            made, xp = copy(self), array_namespace(like)
            for name, values in vars(self).items():
                if isinstance(values, np.ndarray):
                    setattr(made, name, xp.asarray(values, device=like.device))
            self._on_device[like.device] = made
        return self._on_device[like.device]


def expected_users_m(scenario: "Scenario") -> Array:
    """Where users are expected, metres, `[U, 2]`: spread evenly over their cluster's disc, or as listed."""
    turn = np.concatenate([np.arange(n) for n in scenario.users.sizes])
    of_size = np.repeat(scenario.users.sizes, scenario.users.sizes)
    area = np.zeros(len(turn)) if scenario.users.user else (turn + 0.5) / of_size
    draws = np.stack([area, turn * _GOLDEN % 1.0], axis=-1)
    centres_m = np.asarray(scenario.user_centres_m)
    return mobility.scatter(centres_m, scenario.user_radii_m(draws), draws)


def _progress(scenario: "Scenario", cells: Array) -> Array:
    """Share of what a user needs that it delivers in a step, mean over each cluster's users, `[C, M]`."""
    from uav_dc_ros.core.world import measure  # which imports this package

    users_m, step_s = expected_users_m(scenario), scenario.mission.step_s
    uav_m = scenario.grid.centre_m(cells, like=users_m)
    collected = np.zeros(scenario.n_users, bool)
    blocks = []
    for block_m in np.array_split(uav_m, max(1, len(cells) * scenario.n_users // _BLOCK)):
        all_m = np.broadcast_to(users_m, (len(block_m), *users_m.shape))
        link = measure(scenario, block_m, all_m, collected)
        share = link.rate_bps * link.served * step_s / scenario.user_r_min_bits(users_m)
        blocks.append(cluster_means(scenario, share))
    return np.concatenate(blocks)


def _moves_to(scenario: "Scenario", goal: Array) -> Array:
    """Moves from each cell to the nearest one in `goal`, bool `[n_x, n_y, n_z]`; `[C]`."""
    if scenario.moves is not None:
        steps = scenario.moves.steps_from(np.argwhere(goal)).reshape(-1)
        return np.where(steps == UNREACHABLE, FAR, steps)
    # Without obstacles it is the distance along the axes: one pass in each direction of each axis.
    steps = np.where(goal, 0.0, FAR)
    for axis in range(3):
        line = np.moveaxis(steps, axis, 0)
        for i in range(1, len(line)):
            line[i] = np.minimum(line[i], line[i - 1] + 1.0)
        for i in reversed(range(len(line) - 1)):
            line[i] = np.minimum(line[i], line[i + 1] + 1.0)
    return steps.reshape(-1)


def _stops(centres_m: Array, sizes: Array) -> Array:
    """Stop of each cluster, `[M]`: one each, or for more than `STOPS_MAX` the nearest of as many places.

    The places are cluster centres, each farthest from those before; the first is that of most users.
    """
    if len(centres_m) <= STOPS_MAX:
        return np.arange(len(centres_m))
    chosen = [int(sizes.argmax())]
    while len(chosen) < STOPS_MAX:
        away_m = np.linalg.norm(centres_m[:, None] - centres_m[chosen], axis=-1).min(axis=-1)
        chosen.append(int(away_m.argmax()))
    nearest = np.linalg.norm(centres_m[:, None] - centres_m[chosen], axis=-1).argmin(axis=-1)
    # Clusters at one place share a stop, so that a place may be empty: stops are numbered without gaps.
    return np.unique(nearest, return_inverse=True)[1].reshape(-1)


def _tours(legs: Array) -> Array:
    """Shortest ways past sets of S stops to the dock (Held and Karp, 1962), `[2^S, S]`; see the class.

    `legs` `[S, S + 1]` are the moves from each stop to each stop and to the dock.
    """
    n = len(legs)
    tours = np.full((2**n, n), FAR)
    for number in range(1, 2**n):
        stops = [i for i in range(n) if number >> i & 1]
        for i in stops:
            rest = number & ~(1 << i)
            tours[number, i] = (legs[i, :n] + tours[rest]).min() if rest else legs[i, n]
    return tours
