"""What an agent sees: encodings of the mission as a vector of numbers, mostly in [0, 1].

position   the UAV's cell (the paper's state, eq. 5), each index scaled to [0, 1]: 3 numbers
mission    position; steps that remain; for each cluster the share of users collected, and of data; the
           cell once more as one switch per index in each direction; for each cluster how close the UAV
           is, and the same times the share of users collected: 4 + 4 M + n_x + n_y + n_z numbers
map        mission, and the way from the UAV to each cluster's centre and to the dock: 2 M + 2 more

Switches and closeness say nothing new. They spare a small network the work of carving "here, and not
one cell further" and "here, while there is something left" out of scaled indices.
Closeness is 1 over a cluster's centre and falls like a bell with the horizontal distance, to a half
at 1.2 `d_cons_m`.

The encodings are made from what the nodes know, so that training and flying see the same vector.
"""

from functools import cache
from typing import Literal, TypeAlias

import numpy as np

from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.scenario import Scenario

Observation: TypeAlias = Literal["position", "mission", "map"]


def size(kind: Observation, scenario: Scenario) -> int:
    """Length D of the encoding."""
    n_clusters = scenario.n_clusters
    mission = 4 + 4 * n_clusters + sum(scenario.grid.shape)
    return {"position": 3, "mission": mission, "map": mission + 2 * n_clusters + 2}[kind]


def bounds(kind: Observation, scenario: Scenario) -> tuple[Array, Array]:
    """Lowest and highest value of each entry of the encoding, float32 `[D]` each."""
    low, high = np.zeros(size(kind, scenario), np.float32), np.ones(size(kind, scenario), np.float32)
    if kind == "map":
        goals = np.asarray(scenario.goals_cells, np.float32)
        span = np.asarray(_spans(scenario)[:2], np.float32)
        start = size("mission", scenario)
        low[start:] = ((goals - span) / span).reshape(-1)
        high[start:] = (goals / span).reshape(-1)
    return low, high


def encode(
    kind: Observation,
    scenario: Scenario,
    *,
    cell: Array,
    step: Array,
    data_bits: Array,
    collected: Array,
) -> Array:
    """The observation of a mission.

    Args:
        kind: which encoding.
        scenario: the world's values.
        cell: the UAV's cell, integers `[..., 3]`.
        step: steps flown, integers `[...]`.
        data_bits: data collected from each user, bit, `[..., U]`.
        collected: bool `[..., U]`.

    Returns:
        float32 `[..., D]` with D = `size(kind, scenario)`.
    """
    xp = array_namespace(cell)
    cell_f = xp.astype(cell, xp.float32)
    span = constant(_spans(scenario), cell_f)
    parts = [cell_f / span]
    if kind != "position":
        max_steps = scenario.mission.max_steps
        parts.append(xp.astype(max_steps - step[..., None], xp.float32) / max_steps)
        done = _cluster_means(scenario, xp.astype(collected, xp.float32))
        progress = xp.astype(data_bits, xp.float32) / scenario.mission.r_min_bits
        data = _cluster_means(scenario, xp.minimum(progress, constant((1.0,), progress)))
        direction, index = _switches(scenario.grid.shape)
        here = xp.take(cell_f, constant(direction, cell), axis=-1)
        switches = xp.astype(here == constant(index, cell_f), xp.float32)
        ways_cells = constant(scenario.goals_cells, cell_f) - cell_f[..., None, :2]
        reach_cells = scenario.mission.d_cons_m / scenario.grid.cell_m
        ways_reach = ways_cells[..., :-1, :] / reach_cells
        closeness = xp.exp(-0.5 * (ways_reach * ways_reach).sum(axis=-1))
        parts += [done, data, switches, closeness, closeness * done]
    if kind == "map":
        way = ways_cells / span[:2]
        parts.append(way.reshape((*cell.shape[:-1], -1)))
    return xp.concat(parts, axis=-1)


def _spans(scenario: Scenario) -> tuple[int, ...]:
    """Highest index in each direction, at least 1."""
    east, north, up = scenario.grid.last_cell
    return max(east, 1), max(north, 1), max(up, 1)


@cache
def _switches(shape: tuple[int, int, int]) -> tuple[tuple[int, ...], ...]:
    """Direction (0 east, 1 north, 2 up) and index that each switch stands for."""
    return tuple(zip(*((i, index) for i, n in enumerate(shape) for index in range(n)), strict=True))


def _cluster_means(scenario: Scenario, per_user: Array) -> Array:
    """Mean over the users of each cluster: `[..., U]` to `[..., M]`."""
    n_users = scenario.users.users_per_cluster
    shape = (*per_user.shape[:-1], scenario.n_clusters, n_users)
    return per_user.reshape(shape).sum(axis=-1) / n_users
