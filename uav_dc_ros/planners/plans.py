"""Random moves, the nearest cluster first, and a fixed tour of all clusters."""

import itertools
from collections.abc import Callable

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import State

Act = Callable[[State], Array]

# A cluster is left when this share of its users is collected: the last tenth may have walked far away.
ENOUGH = 0.9
EXACT_TOUR_MAX = 8  # clusters whose every order is tried; with more, the nearest next is taken


def random(scenario: Scenario) -> Act:
    """Any of the seven actions with equal probability, the same course for every call."""
    rng = np.random.default_rng(0)
    return lambda state: rng.integers(len(Action), size=state.step.shape)


def nearest(scenario: Scenario) -> Act:
    """Fly to the nearest cluster that has not given enough, at the lowest layer; home in time."""
    goals = _cluster_cells(scenario)

    def act(state: State) -> Array:
        away = np.abs(state.cell[..., None, :2] - goals).sum(axis=-1)
        open_away = np.where(_done(scenario, state), np.iinfo(away.dtype).max, away)
        return _towards(scenario, state, goals[np.argmin(open_away, axis=-1)])

    return act


def tour(scenario: Scenario) -> Act:
    """Fly to the clusters in the order of the shortest way from start to dock; home in time."""
    goals = _cluster_cells(scenario)
    order = np.asarray(_shortest_order(scenario, goals))

    def act(state: State) -> Array:
        next_open = np.argmin(_done(scenario, state)[..., order], axis=-1)
        return _towards(scenario, state, goals[order[next_open]])

    return act


def _towards(scenario: Scenario, state: State, goal: Array) -> Array:
    """The move to `goal` `[..., 2]`; to the dock once all clusters are done, or time is running out."""
    dock = np.asarray(scenario.dock_cell)
    to_dock = np.abs(state.cell[..., :2] - dock).sum(axis=-1)
    # One step of reserve: the move away from the dock that a hover or a descent costs.
    home = (scenario.mission.max_steps - state.step <= to_dock + 1) | _done(scenario, state).all(axis=-1)
    way = np.where(home[..., None], dock, goal) - state.cell[..., :2]
    action = np.full(state.step.shape, int(Action.HOVER))
    action = np.where(way[..., 1] > 0, int(Action.FORWARD), action)
    action = np.where(way[..., 1] < 0, int(Action.BACKWARD), action)
    action = np.where(way[..., 0] > 0, int(Action.RIGHT), action)
    action = np.where(way[..., 0] < 0, int(Action.LEFT), action)
    return np.where((state.cell[..., 2] > 0) & ~home, int(Action.DOWNWARD), action)


def _done(scenario: Scenario, state: State) -> Array:
    """Has a cluster given enough? bool `[..., M]`."""
    per_cluster = state.collected.reshape(*state.collected.shape[:-1], scenario.n_clusters, -1)
    return per_cluster.mean(axis=-1) >= ENOUGH


def _cluster_cells(scenario: Scenario) -> Array:
    """The cell column closest to each cluster's centre, on the grid, integers `[M, 2]`."""
    cells = np.rint(np.asarray(scenario.users.cluster_centres_m) / scenario.grid.cell_m).astype(np.int64)
    return np.clip(cells, 0, np.asarray(scenario.grid.shape[:2]) - 1)


def _shortest_order(scenario: Scenario, goals: Array) -> list[int]:
    """Order of the clusters on the shortest way from start past all of them to the dock."""
    start, dock = np.asarray(scenario.start_cell[:2]), np.asarray(scenario.dock_cell)
    if len(goals) > EXACT_TOUR_MAX:
        order: list[int] = []
        away = np.abs(goals[:, None] - goals[None]).sum(axis=-1)
        to_next = np.abs(goals - start).sum(axis=-1)
        while len(order) < len(goals):
            order.append(
                int(np.argmin(np.where(np.isin(np.arange(len(goals)), order), away.max() * 2 + 1, to_next)))
            )
            to_next = away[order[-1]]
        return order

    def length(order: list[int]) -> int:
        stops = np.stack([start, *goals[order], dock])
        return int(np.abs(np.diff(stops, axis=0)).sum())

    return min(map(list, itertools.permutations(range(len(goals)))), key=length)
