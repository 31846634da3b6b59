"""Fields made from a few numbers: laid out evenly, or at random.

What the numbers leave open is as in the shipped scenario `five_clusters_hover`: layers, speed, channel and
reward.
The rest follows by rule:

- A cell is about a tenth of the longer side, and the sides are whole cells.
- `r_min_bits` takes a user of a cluster of K about as many steps as there: with K - 1 others as near as the
  user, its SINR is 1 / (K - 1). K of listed users is the number that share a cell's reach, if that is more.
  Where a tour cannot collect so much, it is halved until one can.
- `d_cons_m` has whole discs in reach of a cell, and of the UAV above their centres in every layer, with room
  for the way that a user walks.
- `max_steps` is a fifth more than a tour without a limit takes (`flyable.steps_of_tour`).
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import msgspec
import numpy as np

from uav_dc_ros import scenarios
from uav_dc_ros.core.obstacles import Obstacle
from uav_dc_ros.core.obstacles.prisms import blocks
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.scenarios.generation import flyable

SHIPPED = "five_clusters_hover"
CLUSTERS_MAX, USERS_MAX = 50, 1000  # clusters, and users of one
SIDE_MIN_M, SIDE_MAX_M = 100.0, 100_000.0
CELLS = 10  # along the longer side, about
SPEED_MPS = 100.0 / 15.0
COLLECT_STEPS = 2.6  # that a user needs
HALVINGS = 6  # of the data of a user, until a tour can collect it
DRIFT_STEPS = 4.5  # root mean square of a user's way after 60 steps, in steps at its maximum speed
COLLECTED_MIN = 0.8  # share of the users that a tour of a random field collects
RESERVE = 1.2  # times the steps of a tour
OBSTRUCTION_LOSS_DB = 20.0  # excess loss without line of sight in an urban environment, see `channel`
RADIUS_CELLS = 1.2  # of a disc, if there is room
RADIUS_MIN_CELLS = 0.2
APART_RADII = 3.0  # between the centres of two discs
DARTS = 100  # positions that are tried for a disc, before all discs become smaller
TRIES = 20  # layouts that are tried for a seed

Point: TypeAlias = tuple[float, float]


class Layout(NamedTuple):
    """The grid, and where a mission starts and ends, metres."""

    cell_m: float
    n_cells: tuple[int, int]  # between the edges of the grid, east and north
    start_m: Point
    dock_m: Point


def even(name: str, n_clusters: int, users_per_cluster: int, size_m: Point) -> Scenario:
    """A field with its clusters in rows, a start in the south-west and a dock in the north-east.

    Raises:
        ParameterError: more clusters than the field has room for.
    """
    cell_m, (n_x, n_y) = cells = _cells(size_m)
    wide_m, high_m = _metres(cell_m, n_x), _metres(cell_m, n_y)
    n_rows = max(1, min(n_clusters, round(math.sqrt(n_clusters * high_m / wide_m))))
    in_row = [n_clusters // n_rows + (row < n_clusters % n_rows) for row in range(n_rows)]
    centres_m = [
        (_metres(cell_m, (i + 0.5) / n * n_x), _metres(cell_m, (row + 0.5) / n_rows * n_y))
        for row, n in enumerate(in_row)
        for i in range(n)
    ]
    apart_m = min((math.dist(a, b) for a, b in itertools.combinations(centres_m, 2)), default=math.inf)
    radius_m = round(min(RADIUS_CELLS * cell_m, apart_m / APART_RADII), 1)
    if radius_m < RADIUS_MIN_CELLS * cell_m:
        raise _too_many(n_clusters, size_m)
    users = _clusters(centres_m, users_per_cluster, radius_m, 1.0)
    made = _complete(name, users, Layout(*cells, (0.0, 0.0), (wide_m, high_m)))
    if made is None:
        raise ParameterError(
            f"{users_per_cluster} users a cluster: a tour cannot collect them; expected fewer"
        )
    return made


def at_random(
    seed: int,
    *,
    name: str = "",
    n_clusters: int | None = None,
    users_per_cluster: int | None = None,
    size_m: Point | None = None,
) -> Scenario:
    """The random field of a seed, named `random_SEED`; what is given is not drawn.

    Drawn are 2 to 7 clusters of 4 to 15 users, sides of 600 to 1400 m, discs of 0.6 to 1.4 cells that do not
    touch, users' speeds up to 1 m/s, and a start and a dock on the edge, far from one another.

    Raises:
        ParameterError: more clusters than the field has room for.
    """
    rng = np.random.default_rng(seed)
    for _ in range(TRIES):
        drawn_m = rng.integers(6, 15, 2) * 100.0
        clusters, users = int(rng.integers(2, 8)), int(rng.integers(4, 16))
        sides_m = size_m or (float(drawn_m[0]), float(drawn_m[1]))
        cell_m, n_cells = _cells(sides_m)
        radius_m = round(float(rng.uniform(0.6, 1.4)) * cell_m, 1)
        n = n_clusters or clusters
        while (centres_m := _scattered(rng, n, cell_m, n_cells, radius_m)) is None:
            radius_m = round(0.8 * radius_m, 1)
            if radius_m < RADIUS_MIN_CELLS * cell_m:
                raise _too_many(n, sides_m)
        speed_mps = round(float(rng.uniform(0.0, 1.0)), 1)
        table = _clusters(centres_m, users_per_cluster or users, radius_m, speed_mps)
        start_m, dock_m = _far_apart(rng, cell_m, n_cells)
        made = _complete(name or f"random_{seed}", table, Layout(cell_m, n_cells, start_m, dock_m))
        if made is None:
            continue
        found = flyable.examine(made)
        if not found.problems and found.tour.collected >= COLLECTED_MIN * made.n_users:
            return made
    raise ParameterError(
        f"seed {seed}, {n_clusters or 'any'} clusters, {users_per_cluster or 'any'} users a cluster: none of "
        f"{TRIES} fields can be flown; expected fewer of them, or a larger field"
    )


def _clusters(centres_m: list[Point], users: int, radius_m: float, v_max_mps: float) -> dict[str, Any]:
    """A table `users` of equal clusters."""
    return {
        "cluster_centres_m": centres_m,
        "users_per_cluster": users,
        "cluster_radius_m": radius_m,
        "v_max_mps": v_max_mps,
    }


def _far_apart(rng: np.random.Generator, cell_m: float, n_cells: tuple[int, int]) -> tuple[Point, Point]:
    """A start and a dock on the edge of the grid, metres."""
    n_x, n_y = n_cells
    edge = np.asarray(
        [(i, j) for i in range(n_x + 1) for j in range(n_y + 1) if i in (0, n_x) or j in (0, n_y)]
    )
    start = edge[rng.integers(len(edge))]
    moves = np.abs(edge - start).sum(axis=1)
    far = edge[moves >= 0.75 * moves.max()]
    (start_x, start_y), (dock_x, dock_y) = start.tolist(), far[rng.integers(len(far))].tolist()
    return (
        (_metres(cell_m, start_x), _metres(cell_m, start_y)),
        (_metres(cell_m, dock_x), _metres(cell_m, dock_y)),
    )


def _scattered(
    rng: np.random.Generator, n: int, cell_m: float, n_cells: tuple[int, int], radius_m: float
) -> list[Point] | None:
    """Centres of discs that are within the grid and apart, in tenths of a cell; None: no room was found."""
    margin = [min(math.ceil(10.0 * radius_m / cell_m), 5 * side) for side in n_cells]
    centres_m: list[Point] = []
    for _ in range(n):
        for _ in range(DARTS):
            x, y = (
                int(rng.integers(low, 10 * side - low + 1)) for low, side in zip(margin, n_cells, strict=True)
            )
            here = _metres(cell_m, x / 10), _metres(cell_m, y / 10)
            if all(math.dist(here, other) >= APART_RADII * radius_m for other in centres_m):
                centres_m.append(here)
                break
        else:
            return None
    return centres_m


def around(
    name: str,
    users: list[dict[str, Any]],
    datum_deg: Point | None,
    obstacles: Sequence[dict[str, Any]] = (),
) -> Scenario:
    """A field around users that stay where they are: plain values of `core.users.settings.User`.

    The grid begins at x = 0, y = 0, where the mission starts, and the dock is at its opposite corner; or, of
    both, at the nearest place that is free of `obstacles`, plain values of `core.obstacles.Obstacle`.

    Raises:
        ParameterError: users west or south of the grid's corner, or too far apart; users that a tour cannot
            collect.
    """
    for key, side in (("x_m", "west"), ("y_m", "south")):
        low_m, high_m = min(user[key] for user in users), max(user[key] for user in users)
        if low_m < 0.0 or high_m > SIDE_MAX_M:
            raise ParameterError(
                f"{key} from {low_m:g} to {high_m:g}; expected 0 to {SIDE_MAX_M:g} m from the {side} edge"
            )
    size_m = [max(SIDE_MIN_M, *(user[key] for user in users)) for key in ("x_m", "y_m")]
    cell_m, (n_x, n_y) = _cells((size_m[0], size_m[1]))
    corners = [(0, 0), (n_x, n_y)]
    start_m, dock_m = (_free_m(cell_m, (n_x, n_y), corner, obstacles) for corner in corners)
    table = {"user": users, "mobility": {"model": "static"}}
    more: dict[str, Any] = {"datum_deg": datum_deg} if datum_deg else {}
    more |= {"obstacles": list(obstacles)} if obstacles else {}
    made = _complete(name, table, Layout(cell_m, (n_x, n_y), start_m, dock_m), more)
    if made is None:
        raise ParameterError(
            "a tour cannot collect these users; expected fewer, less data_bits of each, or none in a building"
        )
    return made


def _free_m(
    cell_m: float, n_cells: tuple[int, int], corner: tuple[int, int], obstacles: Sequence[dict[str, Any]]
) -> Point:
    """The place nearest to a corner of the grid over which the UAV can climb to every layer, metres."""
    solid = msgspec.convert(obstacles, tuple[Obstacle, ...])
    grid = scenarios.load(SHIPPED).grid
    top_m = grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m
    columns = itertools.product(range(n_cells[0] + 1), range(n_cells[1] + 1))
    for x, y in sorted(columns, key=lambda at: abs(at[0] - corner[0]) + abs(at[1] - corner[1])):
        place_m = _metres(cell_m, x), _metres(cell_m, y)
        if blocks(solid, (*place_m, 0.0), (*place_m, top_m)) is None:
            return place_m
    raise ParameterError("the obstacles close the whole field; expected a place for the start and the dock")


def _complete(
    name: str, users: dict[str, Any], layout: Layout, more: dict[str, Any] | None = None
) -> Scenario | None:
    """The scenario of a table `users` in a layout; None: a tour cannot collect its users."""
    values = msgspec.to_builtins(scenarios.load(SHIPPED)) | {"name": name, "users": users} | (more or {})
    grid, limits, radio = values["grid"], values["mission"], values["radio"]
    cell_m, (n_x, n_y) = layout.cell_m, layout.n_cells
    low_m = grid["altitude_min_m"]
    top_m = low_m + (grid["n_z"] - 1) * grid["altitude_step_m"]
    grid |= {"n_x": n_x + 1, "n_y": n_y + 1, "cell_m": cell_m}
    step_s = round(cell_m / SPEED_MPS, 2)
    limits |= {"start_m": (*layout.start_m, top_m), "dock_m": layout.dock_m, "step_s": step_s}
    limits |= {"max_steps": 1_000_000, "d_cons_m": 1e6}
    if any(one.get("kind", "building") == "building" for one in values.get("obstacles", ())):
        radio["obstruction_loss_db"] = OBSTRUCTION_LOSS_DB
    draft = from_values(values, name)
    placed = draft.users
    discs = list(placed.start_discs())
    farthest_m = max(flyable.reach(draft, disc.centre_m, disc.radius_m)[1] for disc in discs)
    ground_m = math.sqrt(farthest_m**2 - low_m**2) + DRIFT_STEPS * (placed.v_max_mps or 0.0) * step_s
    above_m = math.hypot(max(disc.radius_m for disc in discs), top_m)
    limits["d_cons_m"] = 10.0 * math.ceil(max(math.hypot(ground_m, low_m), above_m) / 10.0)
    together = max(placed.sizes)
    if placed.user:
        together = max(together, _in_reach(draft, limits["d_cons_m"]))
    step_bits = step_s * radio["bandwidth_hz"] * math.log2(1.0 + 1.0 / max(together - 1, 1))
    r_min_bits = float(f"{COLLECT_STEPS * step_bits:.1e}")
    limits["r_min_bits"] = values["reward"]["data_scale_bits"] = r_min_bits
    for _ in range(HALVINGS):
        steps = flyable.steps_of_tour(from_values(values, name))
        if steps is not None:
            limits["max_steps"] = math.ceil(RESERVE * steps)
            return from_values(values, name)
        r_min_bits = float(f"{r_min_bits / 2.0:.1e}")
        limits["r_min_bits"] = values["reward"]["data_scale_bits"] = r_min_bits
    return None


def _in_reach(scenario: Scenario, d_cons_m: float) -> int:
    """Users within a distance of the cell nearest to a user, itself among them: the median over the users."""
    users_m = np.asarray(scenario.user_centres_m)
    cells_m = flyable.nearest_cells_m(scenario, users_m)
    away_m = np.linalg.norm(cells_m[:, None, :2] - users_m, axis=-1)
    return int(np.median((np.hypot(away_m, cells_m[:, 2:]) <= d_cons_m).sum(axis=1)))


def _cells(size_m: Point) -> tuple[float, tuple[int, int]]:
    """Length of a cell, and cells along each side: both sides as exact as possible, with about `CELLS`."""
    choices = [round(max(size_m) / n, 1) for n in range(CELLS // 2, 2 * CELLS + 1)]

    def cost(cell_m: float) -> float:
        errors = [abs(side_m / cell_m - max(1, round(side_m / cell_m))) for side_m in size_m]
        return max(errors) + 0.1 * abs(math.log(max(size_m) / cell_m / CELLS))

    cell_m = min(choices, key=cost)
    n_x, n_y = (max(1, round(side_m / cell_m)) for side_m in size_m)
    return cell_m, (n_x, n_y)


def _metres(cell_m: float, cells: float) -> float:
    return round(cell_m * cells, 3)


def _too_many(n_clusters: int, size_m: Point) -> ParameterError:
    return ParameterError(
        f"{n_clusters} clusters in {size_m[0]:g} x {size_m[1]:g} m; expected fewer, or a larger field: "
        "their discs would touch"
    )
