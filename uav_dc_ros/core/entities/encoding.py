"""The encoding of the observation `entities`, version `FEATURES`; docs/generalist.md explains each number.

It is a vector of `GLOBAL` numbers of the mission and then `CLUSTER` numbers of each of the M clusters; of a
listed user without a cluster, of that user. So its length names M, and a network that treats all clusters
alike reads the vector of any field. Numbers are shares, or lengths in units of the field: of `d_cons_m`, of a
move, of the steps that are left. Large ones are squashed by `x / (1 + |x|)`.

Nodes publish all inputs: training and flight use the same vector.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.entities.tables import FAR, EntityTables
from uav_dc_ros.core.grid import MOVES, Action
from uav_dc_ros.core.mobility import GaussMarkov, RandomWaypoint
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.users.clusters import cluster_means

if TYPE_CHECKING:  # a scenario holds its `EntityTables`
    from uav_dc_ros.core.scenario import Scenario

FEATURES = 1  # version of the encoding, which a policy's config holds
CLUSTERS_MAX = 100
SHAPE_MAX = (40, 40, 8)  # cells east, north, up
N_ACTIONS = len(Action)

# Of the mission; the names with `_a` have a number for each action.
GLOBAL_NAMES = (
    *("steps_left_share", "steps_left", "slack", "home_share", "dock_east", "dock_north", "dock_cells_east"),
    *("dock_cells_north", "at_dock", "weight", "step_cost", "collected", "data", "altitude", "height"),
    *("layer", "cell", "speed", "clusters", "users", "tour_share", "tour_clusters", "has_battery", "charge"),
    "steps_max",
    *("allowed_a", "gain_a", "tour_a", "home_a"),
)
_GLOBALS = tuple(
    name if not n else f"{name}{n - 1}"
    for name in GLOBAL_NAMES
    for n in (range(1, N_ACTIONS + 1) if name.endswith("_a") else (0,))
)
CLUSTER_NAMES = (
    *("present", "east", "north", "moves", "moves_share", "detour", "visit_share", "fits", "users"),
    *("collected", "open", "data", "hovers", "worth", "regret", "in_tour", "radius", "closeness", "nearly"),
    "progress_a",
)
GLOBAL = len(_GLOBALS)  # numbers of the mission
CLUSTER = len(CLUSTER_NAMES) - 1 + N_ACTIONS  # numbers of a cluster
ALLOWED = _GLOBALS.index("allowed_a0")  # the first of the actions from which the UAV can still land
MIN, MAX = -1.0, 2.0  # of every number
SERVED = 0.9  # share of its users after which a cluster is in no tour, as in `planners`


def problem(scenario: "Scenario") -> str | None:
    """Why a scenario has no such observation; None: it has."""
    title = f"the observation 'entities' in scenario {scenario.name!r}"
    if scenario.n_clusters > CLUSTERS_MAX:
        return f"{title} with {scenario.n_clusters} clusters; expected at most {CLUSTERS_MAX}"
    if any(n > n_max for n, n_max in zip(scenario.grid.shape, SHAPE_MAX, strict=True)):
        shape = " x ".join(map(str, scenario.grid.shape))
        return f"{title} with a grid of {shape} cells; expected at most {' x '.join(map(str, SHAPE_MAX))}"
    return None


def size(scenario: "Scenario") -> int:
    """Length D of the encoding."""
    return GLOBAL + CLUSTER * scenario.n_clusters


def bounds(scenario: "Scenario") -> tuple[Array, Array]:
    """Minimum and maximum of each entry of the encoding, float32 `[D]` each."""
    return np.full(size(scenario), MIN, np.float32), np.full(size(scenario), MAX, np.float32)


def encode(
    scenario: "Scenario",
    *,
    cell: Array,
    step: Array,
    data_bits: Array,
    collected: Array,
    energy_used_j: Array | None = None,
    weight: Array | float | None = None,
) -> Array:
    """The observation of a mission, float32 `[..., D]` with D = `size(scenario)`.

    `weight` is w of the objective, a number or `[...]`, by default `objective.DEFAULT_WEIGHT`; the other
    arguments are as in `observations.encode`.
    """
    xp, leading = array_namespace(cell), cell.shape[:-1]
    cell, step = cell.reshape((-1, 3)), step.reshape((-1,))
    data_bits, collected = (values.reshape((-1, scenario.n_users)) for values in (data_bits, collected))
    tables = scenario.entity_tables.on(cell)
    grid, limits, n_clusters = scenario.grid, scenario.mission, scenario.n_clusters
    after = _after(xp, scenario, tables, cell)
    ways_after, progress_after = after[..., :n_clusters], after[..., n_clusters + 1 : 2 * n_clusters + 1]
    home_after, valid = after[..., n_clusters], after[:, Action.HOVER, 2 * n_clusters + 1 :] > 0.5  # [N, 7]
    ways, home = ways_after[:, Action.HOVER], home_after[:, Action.HOVER]  # [N, M], [N]
    if energy_used_j is not None:
        energy_used_j = energy_used_j.reshape((-1,))
    budget = _budget(xp, scenario, step, energy_used_j, home_after, valid)
    slack = budget.left - home  # steps
    one = xp.ones_like(home)

    share = xp.astype(collected, xp.float32)
    user_data = xp.astype(data_bits, xp.float32) / scenario.user_r_min_bits(one)
    user_data = _clipped(xp, user_data, 0.0, 1.0)
    done, data_of_all = (cluster_means(scenario, values) for values in (share, user_data))  # [N, M]
    open_share = 1.0 - done
    data_of_open = (data_of_all - done) / _at_least(xp, open_share, 1e-3)  # those collected have all of it
    data_of_open = _clipped(xp, data_of_open, 0.0, 1.0)
    # Steps over the cluster that its users still need.
    hovers = _clipped(xp, (1.0 - data_of_open) / _at_least(xp, tables.best, 1e-2), 0.0, 100.0)
    # Users for which one more step here is enough.
    spread = xp.take(progress_after[:, Action.HOVER], tables.cluster_of, axis=-1)
    last = (user_data + spread >= 1.0) & (spread > 0.0) & ~collected
    nearly = cluster_means(scenario, xp.astype(last, xp.float32))
    open_users = tables.sizes * open_share / scenario.n_users  # share of all users
    detour = ways + tables.home - home[:, None]
    fits = detour <= slack[:, None]
    in_tour = fits & (done < SERVED)
    tour = _tour(xp, tables, in_tour, ways, ways_after, home, home_after)
    tour_steps = tour.moves + (xp.ceil(hovers) * in_tour).sum(axis=-1)

    cell_f = xp.astype(cell, xp.float32)
    to_goals = tables.goals_cells - cell_f[:, None, :2]  # cells, [N, M + 1, 2]
    to_clusters, to_dock = to_goals[:, :-1], to_goals[:, -1]
    reach = limits.d_cons_m / grid.cell_m  # cells
    given = DEFAULT_WEIGHT if weight is None else weight
    w = one * given if isinstance(given, float) else xp.astype(given.reshape((-1,)), xp.float32)
    per_user, per_step = w / scenario.n_users, (1.0 - w) / limits.max_steps  # of the objective
    value = open_users * w[:, None]
    cost = (_at_least(xp, detour, 0.0) + hovers) * per_step[:, None]
    gain = (open_users[:, None] * _clipped(xp, progress_after, 0.0, 1.0)).sum(axis=-1)
    limited = scenario.energy is not None and scenario.energy.ends != "steps"

    of_mission = [
        budget.left / budget.most,
        _squashed(budget.left / 16.0),
        _squashed(slack / 8.0),
        _clipped(xp, home / _at_least(xp, budget.left, 1.0), 0.0, MAX),
        _squashed(to_dock[:, 0] / reach),
        _squashed(to_dock[:, 1] / reach),
        _squashed(to_dock[:, 0] / 4.0),
        _squashed(to_dock[:, 1] / 4.0),
        xp.astype(home < 0.5, xp.float32),
        w,
        per_step / (per_step + per_user),
        share.sum(axis=-1) / scenario.n_users,
        user_data.sum(axis=-1) / scenario.n_users,
        cell_f[:, 2] / max(grid.n_z - 1, 1),
        _squashed((grid.altitude_min_m + cell_f[:, 2] * grid.altitude_step_m) / limits.d_cons_m),
        one * _squashed(grid.altitude_step_m / limits.d_cons_m),
        one * _squashed(1.0 / reach),
        one * _squashed(4.0 * _speed_mps(scenario) * limits.step_s / limits.d_cons_m),
        one * _squashed(n_clusters / 4.0),
        one * _squashed(scenario.n_users / 32.0),
        _clipped(xp, tour_steps / _at_least(xp, budget.left, 1.0), 0.0, MAX),
        xp.astype(in_tour, xp.float32).sum(axis=-1) / n_clusters,
        one * float(limited),
        budget.charge,
        one * _squashed(budget.most / 32.0),
    ]
    of_actions = [
        xp.astype(budget.allowed, xp.float32),
        _squashed(4.0 * gain),
        _clipped(xp, tour.moves_after - tour.moves[:, None], MIN, 1.0),
        _clipped(xp, home_after - home[:, None], MIN, 1.0),
    ]
    ones = xp.ones_like(ways)
    of_clusters = [
        ones,
        _squashed(to_clusters[..., 0] / reach),
        _squashed(to_clusters[..., 1] / reach),
        _squashed(ways / 8.0),
        _clipped(xp, ways / _at_least(xp, budget.left, 1.0)[:, None], 0.0, MAX),
        _squashed(detour / 8.0),
        _clipped(xp, (detour + hovers) / _at_least(xp, slack, 1.0)[:, None], 0.0, MAX),
        xp.astype(fits, xp.float32),
        ones * (tables.sizes / scenario.n_users),
        done,
        open_users,
        data_of_open,
        _squashed(hovers / 4.0),
        value / _at_least(xp, value + cost, 1e-9),
        tour.regret,
        xp.astype(in_tour, xp.float32),
        ones * _squashed(tables.radii),
        xp.exp(-0.5 * (to_clusters * to_clusters).sum(axis=-1) / (reach * reach)),
        nearly,
    ]
    by_action = _clipped(xp, xp.moveaxis(progress_after, -2, -1), 0.0, 1.5)  # [N, M, 7]
    clusters = xp.concat([xp.stack(of_clusters, axis=-1), by_action], axis=-1)
    parts = [xp.stack(of_mission, axis=-1), *of_actions, clusters.reshape((clusters.shape[0], -1))]
    return xp.concat(parts, axis=-1).reshape((*leading, size(scenario)))


def allowed(observation: Array) -> Array:
    """The actions in observations `[..., D]` from which the UAV can still land, bool `[..., 7]`.

    Moves without effect are not among them. Where no action is left that lands, as after moves that came too
    late, it is the shortest way home.
    """
    return observation[..., ALLOWED : ALLOWED + N_ACTIONS] > 0.5


def can_land(scenario: "Scenario", *, cell: Array, step: Array, energy_used_j: Array) -> Array:
    """The actions after which the UAV can still land, bool `[N, 7]`; see `allowed`, which is never none.

    `cell` is `[N, 3]`, `step` and `energy_used_j` are `[N]`, as those of `observations.encode`.
    """
    xp, n_clusters = array_namespace(cell), scenario.n_clusters
    after = _after(xp, scenario, scenario.entity_tables.on(cell), cell)
    home_after, valid = after[..., n_clusters], after[:, Action.HOVER, 2 * n_clusters + 1 :] > 0.5
    return _budget(xp, scenario, step, energy_used_j, home_after, valid).safe


def _after(xp: Any, scenario: "Scenario", tables: EntityTables, cell: Array) -> Array:
    """`EntityTables.of_cell` of the cells after each action, `[N, 7, 2 M + 8]`."""
    here = (cell[:, 0] * scenario.grid.n_y + cell[:, 1]) * scenario.grid.n_z + cell[:, 2]
    return _rows(xp, tables.of_cell, _rows(xp, tables.after, here))


class _Budget(NamedTuple):
    """What a mission has left, `[N]` each."""

    left: Array  # steps
    most: float  # steps at its start
    charge: Array  # of the battery, 0 to 1; 1 without one
    safe: Array  # bool `[N, 7]`, see `can_land`
    allowed: Array  # bool `[N, 7]`, see `allowed`


def _budget(
    xp: Any, scenario: "Scenario", step: Array, energy_used_j: Array | None, home_after: Array, valid: Array
) -> _Budget:
    left, most = xp.astype(scenario.mission.max_steps - step, xp.float32), float(scenario.mission.max_steps)
    safe, charge, settings = valid & (home_after <= left[:, None] - 1.0), xp.ones_like(left), scenario.energy
    if settings is not None:
        assert energy_used_j is not None, "needed in a scenario with a battery"
        left_j = xp.astype(settings.battery_j - energy_used_j, xp.float32)
        charge = _clipped(xp, left_j / settings.battery_j, 0.0, 1.0)
        if settings.ends != "steps":
            energies_j = scenario.step_energies_j
            vertical_j = {0: energies_j.hover, 1: energies_j.climb, -1: energies_j.descent}
            action_j = tuple(
                energies_j.level if east or north else vertical_j[up] for east, north, up in MOVES
            )
            home_j = max(energies_j) if scenario.obstacles else energies_j.level  # of a move on the way home
            safe = safe & (left_j[:, None] - constant(action_j, left_j) >= home_after * home_j)
            left = xp.minimum(left, xp.floor(left_j / max(energies_j)))
            most = min(most, settings.battery_j / max(energies_j))
    nearest = xp.min(xp.where(valid, home_after, 0.0 * home_after + 2.0 * FAR), axis=-1, keepdims=True)
    any_safe = xp.any(safe, axis=-1, keepdims=True)
    return _Budget(left, most, charge, safe, xp.where(any_safe, safe, valid & (home_after <= nearest)))


class _Tour(NamedTuple):
    """The shortest tour of the clusters that are open and can still be visited, then to the dock."""

    moves: Array  # `[N]`
    moves_after: Array  # of that tour after each action, `[N, 7]`
    regret: Array  # how much longer it is when it begins with a cluster, squashed; 1 for others; `[N, M]`


def _tour(
    xp: Any,
    tables: EntityTables,
    in_tour: Array,
    ways: Array,
    ways_after: Array,
    home: Array,
    home_after: Array,
) -> _Tour:
    shared = tables.members.shape[0] > tables.members.shape[1]  # stops, by several clusters
    in_stop = (xp.astype(in_tour, xp.float32) @ tables.members) > 0.5 if shared else in_tour
    bits = constant(tuple(1 << i for i in range(tables.members.shape[1])), tables.after)
    rest = _rows(xp, tables.tours, (in_stop * bits).sum(axis=-1))  # [N, S]
    if shared:
        ways, ways_after = (xp.take(values, tables.first, axis=-1) for values in (ways, ways_after))
    by_first, any_stop = ways + rest, xp.any(in_stop, axis=-1)
    moves = xp.where(any_stop, xp.min(by_first, axis=-1), home)
    moves_after = xp.min(ways_after + rest[:, None], axis=-1)
    regret = by_first - moves[:, None]
    if shared:
        regret = xp.take(regret, tables.stop_of, axis=-1)
    return _Tour(
        moves=moves,
        moves_after=xp.where(any_stop[:, None], moves_after, home_after),
        regret=xp.where(in_tour, _squashed(regret / 4.0), xp.ones_like(regret)),
    )


def _rows(xp: Any, table: Array, rows: Array) -> Array:
    return xp.take(table, rows.reshape((-1,)), axis=0).reshape((*rows.shape, *table.shape[1:]))


def _squashed(values: Any) -> Any:
    return values / (1.0 + abs(values))


def _clipped(xp: Any, values: Array, low: float, high: float) -> Array:
    return xp.minimum(xp.maximum(values, constant((low,), values)), constant((high,), values))


def _at_least(xp: Any, values: Array, low: float) -> Array:
    return xp.maximum(values, constant((low,), values))


def _speed_mps(scenario: "Scenario") -> float:
    """Mean speed of a user, m/s."""
    model = scenario.users.moves
    if isinstance(model, GaussMarkov):
        return model.mean_speed_mps
    if isinstance(model, RandomWaypoint):
        return (model.v_min_mps + model.v_max_mps) / 2.0
    return (scenario.users.v_max_mps or 0.0) / 2.0
