"""The encoding of the observation `entities`, version `FEATURES`; docs/generalist.md explains each number.

It is a vector of `GLOBAL` numbers of the mission and then `CLUSTER` numbers of each of the M clusters; of a
listed user without a cluster, of that user. So its length names M, and a network that treats all clusters
alike reads the vector of any field. Numbers are shares, or lengths in units of the field: of `d_cons_m`, of a
move, of the steps that are left. Large ones are squashed by `x / (1 + |x|)`.

Nodes publish all inputs: training and flight use the same vector.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array, Numbers, array_namespace, constant
from uav_dc_ros.core.entities.numbers import rows, squashed
from uav_dc_ros.core.entities.plan import best_plan
from uav_dc_ros.core.entities.tables import FAR, EntityTables
from uav_dc_ros.core.grid import MOVES, Action
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.users.clusters import cluster_means

if TYPE_CHECKING:  # a scenario holds its `EntityTables`
    from uav_dc_ros.core.scenario import Scenario

FEATURES = 3  # version of the encoding, which a policy's config holds
CLUSTERS_MAX = 100
SHAPE_MAX = (40, 40, 8)  # cells east, north, up
N_ACTIONS = len(Action)

# Of the mission; the names with `_a` have a number for each action.
GLOBAL_NAMES = (
    *("steps_left_share", "steps_left", "slack", "home_share", "dock_east", "dock_north", "dock_cells_east"),
    *("dock_cells_north", "at_dock", "weight", "step_cost", "collected", "data", "altitude", "height"),
    *("layer", "cell", "speed", "clusters", "users", "plan_share", "plan_clusters", "has_battery", "charge"),
    *("steps_max", "shared", "plan_worth", "price"),
    *("allowed_a", "gain_a", "home_a", "loss_a", "lost_steps_a", "lost_users_a"),
)
CLUSTER_NAMES = (
    *("present", "east", "north", "moves", "moves_share", "detour", "visit_share", "fits", "users"),
    *("collected", "open", "data", "hovers", "worth", "planned", "radius", "closeness", "nearly"),
    *("delivered", "reached"),
    "progress_a",
)


def _by_action(names: tuple[str, ...]) -> tuple[str, ...]:
    of_each = {name: range(N_ACTIONS) if name.endswith("_a") else ("",) for name in names}
    return tuple(f"{name}{suffix}" for name, suffixes in of_each.items() for suffix in suffixes)


GLOBALS = _by_action(GLOBAL_NAMES)  # the name of every number of the mission
CLUSTERS = _by_action(CLUSTER_NAMES)  # and of a cluster
GLOBAL, CLUSTER = len(GLOBALS), len(CLUSTERS)
ALLOWED = GLOBALS.index("allowed_a0")  # the first of the actions from which the UAV can still land
WORTH, PRICE, LOSS = (GLOBALS.index(name) for name in ("plan_worth", "price", "loss_a0"))
MIN, MAX = -1.0, 2.0  # of every number
_TIE = 1e-7  # of J
# Numbers of a mission or a cluster that are squashed.
_SQUASHED = {
    *("steps_left", "slack", "dock_east", "dock_north", "dock_cells_east", "dock_cells_north", "height"),
    *("gain_a", "lost_steps_a", "lost_users_a"),
    *("east", "north", "moves", "detour", "hovers"),
}
# Minimum and maximum of others, where they are not MIN and MAX.
_LIMITS = {
    **dict.fromkeys(("home_share", "plan_share", "moves_share", "visit_share"), (0.0, MAX)),
    **dict.fromkeys(("plan_worth", "home_a"), (MIN, 1.0)),
    "delivered": (0.0, 1.5),
}
_LEAST_STEP = 0.01  # of what a user is worth in J: what a step costs at least


class _Scales(NamedTuple):
    """How the numbers of a mission or of a cluster are scaled, a number for each column."""

    squashed: Numbers  # 1: it is squashed; 0: it is not
    low: Numbers  # minimum
    high: Numbers  # maximum


def _scales(names: tuple[str, ...]) -> _Scales:
    of_columns = [name for name in names for _ in range(N_ACTIONS if name.endswith("_a") else 1)]
    low, high = zip(*(_LIMITS.get(name, (MIN, MAX)) for name in of_columns), strict=True)
    return _Scales(Numbers(float(name in _SQUASHED) for name in of_columns), Numbers(low), Numbers(high))


_OF_MISSION, _OF_CLUSTER = _scales(GLOBAL_NAMES), _scales(CLUSTER_NAMES)


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
    delivered_bits: Array | None = None,
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
    rows_after = _rows_after(xp, scenario, tables, cell)
    after = rows(xp, tables.of_cell, rows_after)
    ways_after, progress_after = after[..., :n_clusters], after[..., n_clusters + 1 : 2 * n_clusters + 1]
    home_after, valid = after[..., n_clusters], after[:, Action.HOVER, 2 * n_clusters + 1 :] > 0.5  # [N, 7]
    ways, home = ways_after[:, Action.HOVER], home_after[:, Action.HOVER]  # [N, M], [N]
    if energy_used_j is not None:
        energy_used_j = energy_used_j.reshape((-1,))
    budget = _budget(xp, scenario, step, energy_used_j, home_after, valid)
    slack, left = budget.left - home, budget.left.clip(1.0)  # steps
    one = xp.ones_like(home)

    share = xp.astype(collected, xp.float32)
    r_min_bits = scenario.user_r_min_bits(one)
    user_data = xp.astype(data_bits, xp.float32) / r_min_bits
    user_data = user_data.clip(0.0, 1.0)
    given = data_bits * 0.0 if delivered_bits is None else delivered_bits.reshape((-1, scenario.n_users))
    given = xp.astype(given, xp.float32) / r_min_bits  # in the last step
    # Users for which one more step here is enough.
    spread = xp.take(progress_after[:, Action.HOVER], tables.cluster_of, axis=-1)
    last = (user_data + spread >= 1.0) & (spread > 0.0) & ~collected
    of_users = [
        share,
        user_data,
        given,
        xp.astype((given > 0.0) & ~collected, xp.float32),
        xp.astype(last, xp.float32),
    ]
    means = cluster_means(scenario, xp.concat([each[None] for each in of_users]))  # [5, N, M]
    done, data_of_all, given_mean, reached, nearly = (means[i] for i in range(5))
    open_share = 1.0 - done
    data_of_open = (data_of_all - done) / open_share.clip(1e-3)  # those collected have all of it
    data_of_open = data_of_open.clip(0.0, 1.0)
    # Steps over the cluster that its users still need.
    hovers = ((1.0 - data_of_open) / tables.rate).clip(0.0, 100.0)
    reached = reached / open_share.clip(1e-3)  # share of the open users
    open_users = tables.sizes * open_share / scenario.n_users  # share of all users
    detour = ways + tables.home - home[:, None]
    fits = detour <= slack[:, None]
    cell_f = xp.astype(cell, xp.float32)
    to_goals = tables.goals_cells - cell_f[:, None, :2]  # cells, [N, M + 1, 2]
    to_clusters, to_dock = to_goals[:, :-1], to_goals[:, -1]
    reach = limits.d_cons_m / grid.cell_m  # cells
    weight = DEFAULT_WEIGHT if weight is None else weight
    w = one * weight if isinstance(weight, float) else xp.astype(weight.reshape((-1,)), xp.float32)
    per_user, per_step = w / scenario.n_users, (1.0 - w) / limits.max_steps  # of the objective
    # Without a price for steps any detour would do.
    price = xp.maximum(per_step, _LEAST_STEP * per_user).clip(1e-6)
    plan = best_plan(
        tables,
        rows_after=rows_after,
        after=after,
        left=budget.left,
        allowed=budget.allowed,
        data=user_data,
        collected=collected,
        delivered=given,
        done=done,
        begins=step == 0,
        per_user=per_user,
        price=price,
    )
    value = open_users * w[:, None]
    cost = (detour.clip(0.0) + hovers) * per_step[:, None]
    gain = (open_users[:, None] * progress_after).sum(axis=-1)
    limited = scenario.energy is not None and scenario.energy.ends != "steps"

    of_mission = [
        budget.left / budget.most,
        budget.left / 16.0,
        slack / 8.0,
        home / left,
        to_dock[:, 0] / reach,
        to_dock[:, 1] / reach,
        to_dock[:, 0] / 4.0,
        to_dock[:, 1] / 4.0,
        home < 0.5,
        w,
        per_step / (per_step + per_user),
        share.sum(axis=-1) / scenario.n_users,
        user_data.sum(axis=-1) / scenario.n_users,
        cell_f[:, 2] / max(grid.n_z - 1, 1),
        (grid.altitude_min_m + cell_f[:, 2] * grid.altitude_step_m) / limits.d_cons_m,
        *tables.fixed,
        plan.steps / left,
        plan.clusters.sum(axis=-1) / n_clusters,
        float(limited),
        budget.charge,
        squashed(budget.most / 32.0),
        float(tables.shared),
        plan.worth,
        price,
    ]
    of_actions = [
        budget.allowed,
        4.0 * gain,
        home_after - home[:, None],
        plan.loss,
        plan.loss / (2.0 * price)[:, None],
        plan.loss / per_user.clip(1e-6)[:, None],
    ]
    of_clusters = [
        1.0,
        to_clusters[..., 0] / reach,
        to_clusters[..., 1] / reach,
        ways / 8.0,
        ways / left[:, None],
        detour / 8.0,
        (detour + hovers) / slack.clip(1.0)[:, None],
        fits,
        tables.sizes / scenario.n_users,
        done,
        open_users,
        data_of_open,
        hovers / 4.0,
        value / (value + cost).clip(1e-9),
        plan.clusters,
        tables.radii,
        xp.exp(-0.5 * (to_clusters * to_clusters).sum(axis=-1) / (reach * reach)),
        nearly,
        given_mean,
        reached,
    ]
    by_action = progress_after.swapaxes(-2, -1)  # [N, M, 7]
    numbers = _vector(one, of_mission, of_actions, _OF_MISSION)
    clusters = _vector(ways, of_clusters, [by_action], _OF_CLUSTER)
    numbers = xp.concat([numbers, clusters.reshape((len(numbers), -1))], axis=-1)
    return numbers.reshape((*leading, size(scenario)))


def _vector(like: Array, numbers: list[Array | float], by_action: list[Array], scales: _Scales) -> Array:
    """Columns of the shape of `like` `[...]`, then others by action `[..., 7]`, scaled, `[..., D]`."""
    # Columns are set one by one: to squash each, and to stack them, takes a node longer.
    vector = like[..., None] * constant(scales.squashed, like)
    for place, column in enumerate(numbers):
        vector[..., place] = column
    for i, columns in enumerate(by_action):
        place = len(numbers) + i * N_ACTIONS
        vector[..., place : place + N_ACTIONS] = columns
    vector = vector / (1.0 + abs(vector) * constant(scales.squashed, like))
    return vector.clip(constant(scales.low, like), constant(scales.high, like))


def allowed(observation: Array) -> Array:
    """The actions in observations `[..., D]` from which the UAV can still land, bool `[..., 7]`.

    Moves without effect are not among them. Where no action is left that lands, as after moves that came too
    late, it is the shortest way home.
    """
    return observation[..., ALLOWED : ALLOWED + N_ACTIONS] > 0.5


def planned_action(observation: Array) -> Array:
    """The action of the best plan for observations `[..., D]`, integers `[...]`, numpy.

    Of actions that are worth the same it is a hover, which costs the least energy.
    """
    loss = np.where(allowed(observation), observation[..., LOSS : LOSS + N_ACTIONS], np.inf)
    loss[..., Action.HOVER] -= _TIE
    return loss.argmin(axis=-1)


def can_land(scenario: "Scenario", *, cell: Array, step: Array, energy_used_j: Array) -> Array:
    """The actions after which the UAV can still land, bool `[N, 7]`; see `allowed`, which is never none.

    `cell` is `[N, 3]`, `step` and `energy_used_j` are `[N]`, as those of `observations.encode`.
    """
    xp, n_clusters = array_namespace(cell), scenario.n_clusters
    tables = scenario.entity_tables.on(cell)
    after = rows(xp, tables.of_cell, _rows_after(xp, scenario, tables, cell))
    home_after, valid = after[..., n_clusters], after[:, Action.HOVER, 2 * n_clusters + 1 :] > 0.5
    return _budget(xp, scenario, step, energy_used_j, home_after, valid).safe


def _rows_after(xp: Any, scenario: "Scenario", tables: EntityTables, cell: Array) -> Array:
    """Rows in the tables of the cells after each action, `[N, 7]`."""
    here = (cell[:, 0] * scenario.grid.n_y + cell[:, 1]) * scenario.grid.n_z + cell[:, 2]
    return rows(xp, tables.after, here)


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
        charge = (left_j / settings.battery_j).clip(0.0, 1.0)
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
    nearest = xp.min(xp.where(valid, home_after, constant((2.0 * FAR,), left)), axis=-1, keepdims=True)
    any_safe = xp.any(safe, axis=-1, keepdims=True)
    return _Budget(left, most, charge, safe, xp.where(any_safe, safe, valid & (home_after <= nearest)))
