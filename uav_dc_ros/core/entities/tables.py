"""What the observation `entities` looks up: of each cell, the ways from it and the data that it gives.

Everything here follows from the scenario alone, and is computed once. Users are taken to be spread evenly
over their discs, and as far as they walk beyond, see `expected_users_m`.
"""

import math
from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from uav_dc_ros.core import mobility
from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.entities.numbers import squashed
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.obstacles.moves import UNREACHABLE
from uav_dc_ros.core.users.clusters import cluster_means

if TYPE_CHECKING:  # a scenario holds its `EntityTables`
    from uav_dc_ros.core.scenario import Scenario

STOPS_MAX = 8  # of which every order is known; more clusters share stops
FAR = 10_000.0  # moves to where no way leads, and the way of an order that visits what it need not
GOOD = 0.8  # share of the progress in a cluster's best cell that a cell has in which the cluster is served
OVER = 0.9  # share of the users in reach from the best cell from which the UAV is over a cluster
_SETS = 4  # sets of places in which users are expected: a small cluster is not judged by two or three
_WALK = 0.3  # share of the mission after which it is expected that users are where they have walked to
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

        progress, reached = _progress(scenario, cells)  # [C, M] each
        # Whether the UAV is over each cluster: about as many of its users are in reach as from any cell, bool
        # [C, M].
        self.over: Array = reached >= OVER * np.where(free[:, None], reached, 0.0).max(axis=0)
        best = np.where(free[:, None], progress, 0.0).max(axis=0)
        self.best: Array = best.astype(np.float32)  # progress of each cluster in its best cell, [M]
        # The same, but not zero: of each cluster, [M], and of each user's cluster, [U].
        self.rate: Array = self.best.clip(1e-2)
        self.rate_of_user: Array = self.rate[np.asarray(scenario.user_cluster)]
        good = free[:, None] & (progress >= GOOD * best)
        centres_m = np.asarray(scenario.cluster_centres_m)
        away_m = np.linalg.norm((cells[:, :2] * grid.cell_m)[:, None] - centres_m, axis=-1)
        # Rows of the cells where the clusters are served: the nearest good one, the lowest of them, [M]. One
        # cell each: if any good one would do, a way could end at one cell and go on from another.
        places = self.places = np.where(good, away_m + 1e-3 * cells[:, 2:], np.inf).argmin(axis=0)
        ways = _moves_to_each(scenario, cells, [*cells[places], (*scenario.dock_cell, -1)])  # [C, M + 1]
        # Moves to each cluster and to the dock, then the progress of each cluster, then whether each action
        # has an effect, float32 [C, 2 M + 8].
        self.of_cell: Array = np.concatenate([ways, progress, valid], axis=-1).astype(np.float32)

        self.home: Array = ways[places, n_clusters].astype(np.float32)  # moves from there to the dock, [M]
        self.stop_of = _stops(centres_m, np.asarray(scenario.users.sizes))  # of each cluster, [M]
        # The cluster that stands for each stop, [S].
        self.first: Array = np.unique(self.stop_of, return_index=True)[1]
        n_stops = len(self.first)
        legs = ways[places[self.first]][:, [*self.first, n_clusters]]
        # Moves of the shortest way from each stop past all others of a set to the dock, by the number of the
        # set (bit i: stop i), float32 [2^S, S]; FAR for a stop that is not in the set.
        self.tours: Array = _tours(legs).astype(np.float32)
        # Stop of each cluster one-hot, float32 [M, S].
        self.members: Array = (self.stop_of[:, None] == np.arange(n_stops)).astype(np.float32)
        # Stops of each set, numbers 0 and 1, float32 [S, 2^S].
        self.sets: Array = ((np.arange(2**n_stops) >> np.arange(n_stops)[:, None]) & 1).astype(np.float32)
        # 0 for the empty set, FAR for others, float32 [2^S].
        self.none: Array = np.where(self.sets.any(axis=0), FAR, 0.0).astype(np.float32)
        # Clusters of each set of stops, numbers 0 and 1, float32 [2^S, M].
        self.clusters: Array = np.ascontiguousarray((self.members @ self.sets).T)
        self.shared: bool = n_stops < n_clusters  # whether clusters share stops
        # Clusters of each stop, [S, most of a stop]; M where a stop has fewer.
        self.of_stop: Array = _padded(np.bincount(self.stop_of), np.argsort(self.stop_of, kind="stable"))
        # Moves from each cell past the stops of each set to the dock, float32 [C, 2^S]; none if stops are
        # shared: then they begin at different clusters.
        self.rounds: Array | None = None if self.shared else _rounds(ways, self.tours).astype(np.float32)
        # Moves to each cluster from the nearest other one of its stop, float32 [M].
        self.apart: Array = _apart(ways[places][:, :n_clusters], self.stop_of).astype(np.float32)
        self.cluster_of = np.asarray(scenario.user_cluster)  # of each user, [U]
        self.sizes: Array = np.asarray(scenario.users.sizes, np.float32)  # users of each cluster, [M]
        # Users of each cluster, [M, largest size]; the number of all users where a cluster has fewer.
        self.users: Array = _padded(np.asarray(scenario.users.sizes), np.arange(scenario.n_users))
        radii_m = np.asarray([disc.radius_m for disc in scenario.users.clusters])
        # Radius of each cluster in units of d_cons, squashed, [M].
        self.radii: Array = squashed((radii_m / scenario.mission.d_cons_m).astype(np.float32))
        self.fixed = _fixed(scenario)  # numbers of the observation that a scenario always has
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


def _fixed(scenario: "Scenario") -> tuple[float, ...]:
    """The observation's `layer`, `cell`, `speed`, `clusters` and `users`."""
    limits, grid, model = scenario.mission, scenario.grid, scenario.users.moves
    speed_mps = (scenario.users.v_max_mps or 0.0) / 2.0  # mean
    if isinstance(model, mobility.GaussMarkov):
        speed_mps = model.mean_speed_mps
    elif isinstance(model, mobility.RandomWaypoint):
        speed_mps = (model.v_min_mps + model.v_max_mps) / 2.0
    numbers = (
        grid.altitude_step_m / limits.d_cons_m,
        1.0 / (limits.d_cons_m / grid.cell_m),
        4.0 * speed_mps * limits.step_s / limits.d_cons_m,
        scenario.n_clusters / 4.0,
        scenario.n_users / 32.0,
    )
    return tuple(map(squashed, numbers))


def expected_users_m(scenario: "Scenario") -> Array:
    """Where users are expected, metres: sets of places with a place for each user, `[_SETS, U, 2]`.

    The places of a cluster, or of a listed user, are spread evenly over a disc around its centre. Its
    variance is that of the disc in which the users start and of the random walk until a cluster is usually
    visited.
    """
    users, step_s = scenario.users, scenario.mission.step_s
    turn = np.concatenate([np.arange(n) for n in users.sizes])
    turn = np.arange(_SETS)[:, None] + _SETS * turn  # [_SETS, U]
    share = turn % _SETS if users.user else turn
    share = (share + 0.5) / (_SETS if users.user else _SETS * np.repeat(users.sizes, users.sizes))
    draws = np.stack([share, turn * _GOLDEN % 1.0], axis=-1)
    # A step of the walk is uniform in length and direction: the mean of its square is (v step_s)^2 / 3. That
    # of a place in a disc, from its centre, is half of the squared radius.
    walked_m = (users.v_max_mps or 0.0) * step_s * math.sqrt(2.0 / 3.0 * _WALK * scenario.mission.max_steps)
    radii_m = np.hypot(scenario.user_radii_m(draws), walked_m)
    return mobility.scatter(np.asarray(scenario.user_centres_m), radii_m, draws)


def _progress(scenario: "Scenario", cells: Array) -> tuple[Array, Array]:
    """Share of what a user needs that it delivers in a step, and share in reach, of each cluster, `[C, M]`.

    A user counts up to 1: one that delivers many times as much does not make up for others out of reach.
    """
    from uav_dc_ros.core.world import measure  # which imports this package

    users_m, step_s = expected_users_m(scenario), scenario.mission.step_s
    uav_m = scenario.grid.centre_m(cells, like=users_m)[:, None]
    collected = np.zeros(scenario.n_users, bool)
    blocks, reached = [], []
    for block_m in np.array_split(uav_m, max(1, len(cells) * _SETS * scenario.n_users // _BLOCK)):
        all_m = np.broadcast_to(users_m, (len(block_m), *users_m.shape))
        link = measure(scenario, block_m, all_m, collected)
        share = link.rate_bps * link.served * step_s / scenario.user_r_min_bits(users_m)
        blocks.append(cluster_means(scenario, np.minimum(share, 1.0)).mean(axis=1))
        reached.append(cluster_means(scenario, link.served.astype(np.float64)).mean(axis=1))
    return np.concatenate(blocks), np.concatenate(reached)


def _moves_to_each(scenario: "Scenario", cells: Array, goals: Sequence[Array | tuple[int, ...]]) -> Array:
    """Moves from each cell to each goal, `[C, N]`; a goal is a cell, of which layer -1 is all layers."""
    columns = []
    for goal in np.asarray(goals):
        if scenario.moves is None:
            n = 3 if goal[2] >= 0 else 2
            columns.append(abs(cells[:, :n] - goal[:n]).sum(axis=-1))
        else:
            to = goal[None] if goal[2] >= 0 else cells[(cells[:, :2] == goal[:2]).all(axis=-1)]
            steps = scenario.moves.steps_from(to).reshape(-1)
            columns.append(np.where(steps == UNREACHABLE, FAR, steps))
    return np.stack(columns, axis=-1)


def _rounds(ways: Array, tours: Array) -> Array:
    """Shortest ways from each cell past sets of S stops to the dock, `[C, 2^S]`; `ways` is `[C, S + 1]`."""
    n, numbers = tours.shape[1], np.arange(len(tours))
    rounds = np.full((len(ways), len(tours)), FAR)
    rounds[:, 0] = ways[:, n]
    for i in range(n):
        sets = numbers[numbers >> i & 1 == 1]
        rounds[:, sets] = np.minimum(rounds[:, sets], ways[:, i, None] + tours[sets, i])
    return rounds


def _apart(legs: Array, stop_of: Array) -> Array:
    """Moves to each cluster from the nearest other one of its stop, `[M]`; 0 for one that is alone there."""
    others = (stop_of[:, None] == stop_of) & ~np.eye(len(stop_of), dtype=bool)
    nearest = np.where(others, legs, np.inf).min(axis=0)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def _padded(sizes: Array, members: Array) -> Array:
    """Members of sets of given sizes one after another, `[N, largest size]`, padded with their number."""
    turn, firsts = np.arange(sizes.max()), np.cumsum(sizes) - sizes
    padded = np.append(members, len(members))
    return padded[np.where(turn < sizes[:, None], firsts[:, None] + turn, len(members))]


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
