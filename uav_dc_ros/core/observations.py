"""Observations of an agent: encodings of the mission as a vector of numbers, mostly in [0, 1].

position   the UAV's cell (the paper's state, eq. 5), each index scaled to [0, 1]: 3 numbers
mission    position; remaining steps; for each cluster the share of users collected, and of data; the cell
           one-hot in each direction; for each cluster the UAV's closeness, and the closeness times the share
           of users collected: 4 + 4 M + n_x + n_y + n_z numbers
map        mission, and the vector from the UAV to each cluster's centre and to the dock: 2 M + 2 more
energy     mission, and the battery's state of charge: 1 more; only in a scenario with a table `energy`
entities   the clusters as a set, for policies that fly in fields they have not seen: see `core.entities`

One-hot cells and closeness add no information. They spare a small network the work of deriving "this cell
only" and "here, while users remain" from scaled indices. Closeness is a Gaussian of the horizontal distance
to a cluster's centre: 1 at the centre, a half at 1.2 `d_cons_m`.

Nodes publish all inputs of the encodings: training and flight use the same vector.
"""

from functools import cache
from typing import Literal, TypeAlias

import numpy as np

from uav_dc_ros.core import entities
from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.energy import state_of_charge
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users.clusters import cluster_means as cluster_means

Observation: TypeAlias = Literal["position", "mission", "map", "energy", "entities"]


def problem(kind: Observation, scenario: Scenario) -> str | None:
    """Why a scenario has no such observation; None: it has."""
    if kind == "energy" and scenario.energy is None:
        return f"the observation 'energy' in scenario {scenario.name!r}; expected a scenario with [energy]"
    return entities.problem(scenario) if kind == "entities" else None


def size(kind: Observation, scenario: Scenario) -> int:
    """Length D of the encoding."""
    if kind == "entities":
        return entities.size(scenario)
    n_clusters = scenario.n_clusters
    mission = 4 + 4 * n_clusters + sum(scenario.grid.shape)
    sizes = {"position": 3, "mission": mission, "map": mission + 2 * n_clusters + 2, "energy": mission + 1}
    return sizes[kind]


def bounds(kind: Observation, scenario: Scenario) -> tuple[Array, Array]:
    """Minimum and maximum of each entry of the encoding, float32 `[D]` each."""
    if kind == "entities":
        return entities.bounds(scenario)
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
    delivered_bits: Array | None = None,
    energy_used_j: Array | None = None,
    weight: Array | float | None = None,
) -> Array:
    """The observation of a mission, float32 `[..., D]` with D = `size(kind, scenario)`.

    `cell` `[..., 3]`, `step` `[...]`, `data_bits` and `collected` `[..., U]` are those of `world.State`. So
    are `delivered_bits` `[..., U]`, which `entities` reads (None: the mission begins), and `energy_used_j`
    `[...]`, which `energy` needs, and `entities` in a scenario with a battery. `weight` is w of the
    objective, a number or `[...]`, which only `entities` reads; None: `objective.DEFAULT_WEIGHT`.
    """
    if kind == "entities":
        return entities.encode(
            scenario,
            cell=cell,
            step=step,
            data_bits=data_bits,
            collected=collected,
            delivered_bits=delivered_bits,
            energy_used_j=energy_used_j,
            weight=weight,
        )
    xp = array_namespace(cell)
    cell_f = xp.astype(cell, xp.float32)
    span = constant(_spans(scenario), cell_f)
    parts = [cell_f / span]
    if kind != "position":
        max_steps = scenario.mission.max_steps
        parts.append(xp.astype(max_steps - step[..., None], xp.float32) / max_steps)
        done = cluster_means(scenario, xp.astype(collected, xp.float32))
        progress = xp.astype(data_bits, xp.float32) / scenario.user_r_min_bits(cell_f)
        data = cluster_means(scenario, xp.minimum(progress, constant((1.0,), progress)))
        direction, index = _one_hot_entries(scenario.grid.shape)
        indices = xp.take(cell_f, constant(direction, cell), axis=-1)
        one_hot = xp.astype(indices == constant(index, cell_f), xp.float32)
        to_goals_cells = constant(scenario.goals_cells, cell_f) - cell_f[..., None, :2]
        reach_cells = scenario.mission.d_cons_m / scenario.grid.cell_m
        to_clusters = to_goals_cells[..., :-1, :] / reach_cells
        closeness = xp.exp(-0.5 * (to_clusters * to_clusters).sum(axis=-1))
        parts += [done, data, one_hot, closeness, closeness * done]
    if kind == "energy":
        assert scenario.energy is not None, "checked by `problem`"
        assert energy_used_j is not None, "needed by `energy`"
        charge = state_of_charge(scenario.energy, energy_used_j)
        parts.append(xp.astype(charge[..., None], xp.float32))
    if kind == "map":
        to_goals = to_goals_cells / span[:2]
        parts.append(to_goals.reshape((*cell.shape[:-1], -1)))
    return xp.concat(parts, axis=-1)


def cell(scenario: Scenario, observation: Array) -> Array:
    """The UAV's cell in observations of any kind `[..., D]`, integers `[..., 3]`."""
    xp = array_namespace(observation)
    scaled = observation[..., :3] * constant(_spans(scenario), observation)
    return xp.astype(xp.round(scaled), xp.int64)


def _spans(scenario: Scenario) -> tuple[int, ...]:
    """Maximum index in each direction, at least 1."""
    east, north, up = scenario.grid.last_cell
    return max(east, 1), max(north, 1), max(up, 1)


@cache
def _one_hot_entries(shape: tuple[int, int, int]) -> tuple[tuple[int, ...], ...]:
    """Direction (0 east, 1 north, 2 up) and index of each one-hot entry."""
    return tuple(zip(*((i, index) for i, n in enumerate(shape) for index in range(n)), strict=True))
