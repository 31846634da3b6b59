"""Fixed rules: random moves, the nearest cluster first, and a fixed tour of all clusters.

Among obstacles they fly the shortest ways around.
"""

import itertools

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.observations import cluster_means
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act, State
from uav_dc_ros.planners.routes import Routes

# Share of its users after which a cluster counts as served: the last tenth may have walked far away.
ENOUGH = 0.9
EXACT_TOUR_MAX = 8  # clusters of which every order is tried; with more, the nearest is next


def random(scenario: Scenario) -> Act:
    """Any of the seven actions with equal probability.

    The action of mission i at step t is entry `[t, i]` of one table: every mission flown alone is the same.
    """
    tables: dict[int, tuple[np.random.Generator, list[Array]]] = {}  # by the number of missions

    def act(state: State) -> Array:
        steps = np.reshape(state.step, (-1,)).tolist()
        rng, rows = tables.setdefault(len(steps), (np.random.default_rng(0), []))
        while len(rows) <= max(steps, default=-1):
            rows.append(rng.integers(len(Action), size=len(steps)))
        return np.asarray([rows[step][i] for i, step in enumerate(steps)]).reshape(state.step.shape)

    return act


def nearest(scenario: Scenario) -> Act:
    """Flies to the nearest cluster that is not served, at the lowest layer, and home in time."""
    routes = None if scenario.moves is None else Routes(scenario)
    goals = _cluster_cells(scenario)

    def act(state: State) -> Array:
        if routes is not None:
            distance = routes.steps(state.cell)[..., :-1]
        else:
            distance = np.abs(state.cell[..., None, :2] - goals).sum(axis=-1)
        distance = np.where(_served(scenario, state), np.iinfo(distance.dtype).max, distance)
        goal = np.argmin(distance, axis=-1)
        if routes is not None:
            return _around(scenario, routes, state, goal)
        return _towards(scenario, state, goals[goal])

    return act


def fixed_tour(scenario: Scenario) -> Act:
    """Flies to the clusters in the order of the shortest way from start to dock, and home in time."""
    routes = None if scenario.moves is None else Routes(scenario)
    goals = _cluster_cells(scenario)
    start, dock = np.asarray(scenario.start_cell), np.asarray(scenario.dock_cell)
    if routes is not None:
        legs = routes.steps(np.stack([*routes.cells, start]))
    else:
        legs = np.abs(np.stack([*goals, start[:2]])[:, None] - np.stack([*goals, dock])).sum(axis=-1)
    order = np.asarray(_shortest_order(legs))

    def act(state: State) -> Array:
        next_open = np.argmin(_served(scenario, state)[..., order], axis=-1)
        if routes is not None:
            return _around(scenario, routes, state, order[next_open])
        return _towards(scenario, state, goals[order[next_open]])

    return act


def _around(scenario: Scenario, routes: Routes, state: State, goal: Array) -> Array:
    """As `_towards`, among obstacles: to the cluster `goal`, integers `[...]`."""
    to_dock = routes.steps(state.cell)[..., -1]
    home = _time_to_go_home(
        scenario, state, to_dock, max(scenario.step_energies_j) if scenario.energy else 0.0
    )
    return routes.towards(state.cell, np.where(home, scenario.n_clusters, goal))


def _towards(scenario: Scenario, state: State, goal: Array) -> Array:
    """The move to `goal` `[..., 2]`; to the dock once all clusters are served, or time is running out."""
    dock = np.asarray(scenario.dock_cell)
    to_dock = np.abs(state.cell[..., :2] - dock).sum(axis=-1)
    home = _time_to_go_home(
        scenario, state, to_dock, scenario.step_energies_j.level if scenario.energy else 0.0
    )
    dx, dy = np.moveaxis(np.where(home[..., None], dock, goal) - state.cell[..., :2], -1, 0)
    # Down comes first, then the x axis.
    return np.select(
        [(state.cell[..., 2] > 0) & ~home, dx < 0, dx > 0, dy < 0, dy > 0],
        [Action.DOWNWARD, Action.LEFT, Action.RIGHT, Action.BACKWARD, Action.FORWARD],
        Action.HOVER,
    )


def _time_to_go_home(scenario: Scenario, state: State, to_dock: Array, move_j: float) -> Array:
    """Whether all clusters are served, or what is left lasts for `to_dock` moves only, bool `[...]`.

    `move_j` is the energy of one of these moves, joules.
    """
    # One step of reserve: a hover or a descent may cost a move away from the dock.
    home = (scenario.mission.max_steps - state.step <= to_dock + 1) | _served(scenario, state).all(axis=-1)
    if scenario.energy is not None and scenario.energy.ends != "steps":
        left_j = scenario.energy.battery_j - state.energy_used_j
        home = home | (left_j < to_dock * move_j + 2 * max(scenario.step_energies_j))
    return home


def _served(scenario: Scenario, state: State) -> Array:
    """Bool `[..., M]`."""
    return cluster_means(scenario, state.collected.astype(np.float64)) >= ENOUGH


def _cluster_cells(scenario: Scenario) -> Array:
    """The column of cells on the grid that is closest to each cluster's centre, integers `[M, 2]`."""
    cells = np.rint(np.asarray(scenario.cluster_centres_m) / scenario.grid.cell_m).astype(np.int64)
    return np.clip(cells, 0, np.asarray(scenario.grid.shape[:2]) - 1)


def _shortest_order(legs: Array) -> list[int]:
    """Order of the clusters on the shortest way from start past all of them to the dock.

    `legs` `[M + 1, M + 1]` are the moves from each cluster and the start to each cluster and the dock.
    """
    n = len(legs) - 1
    if n > EXACT_TOUR_MAX:
        order: list[int] = []
        open_goals, here = set(range(n)), n
        while open_goals:
            here = min(open_goals, key=lambda i: (legs[here, i], i))
            order.append(here)
            open_goals.remove(here)
        return order

    def length(order: list[int]) -> int:
        return int(legs[[n, *order], [*order, n]].sum())

    return min(map(list, itertools.permutations(range(n))), key=length)
