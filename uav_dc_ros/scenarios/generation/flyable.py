"""Whether a mission of a scenario can be flown: what is in reach, and what a tour of the clusters collects.

The tour is the planner `fixed_tour`, flown with the scenario's own channel, users and end of a mission.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import msgspec
import numpy as np

from uav_dc_ros.core import mission, observations, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.obstacles import UNREACHABLE, moves_to_dock
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act, rollout_steps
from uav_dc_ros.planners.baselines import ENOUGH, fixed_tour

SEEDS = range(10)
DISC_POINTS = 500  # of a disc, of equal area each
EDGE_POINTS = 72
DISTANCES_MAX = 2_000_000  # between points and cells, at a time
HOVERS_MAX = 20  # steps for each cluster, beside the way, after which a tour without a limit ends


Point: TypeAlias = tuple[float, float]


class Cluster(msgspec.Struct, frozen=True, kw_only=True):
    """One cluster of the field."""

    key: str  # in the scenario
    centre_m: tuple[float, float]
    users: int
    in_reach: float  # share of where its users start within `mission.d_cons_m` of a cell, 0 to 1
    reach_m: float  # smallest `mission.d_cons_m` that has all of it in reach, metres
    collected: float  # users that a tour collects, mean over the missions


class Tour(msgspec.Struct, frozen=True, kw_only=True):
    """Missions of the planner `fixed_tour`."""

    missions: int
    landed: int  # missions
    collected: float  # users, mean over the missions
    docked_step: float | None  # step after which the UAV stayed over the dock, mean of those that landed
    energy_used_j: float | None  # maximum, joules; None in a scenario without `energy`
    without_limit: float | None  # see `steps_of_tour`


class Flyable(msgspec.Struct, frozen=True, kw_only=True):
    """The result of `examine`."""

    users: int
    moves_to_dock: int  # from the start
    speed_mps: float  # of a move to the next cell, m/s
    clusters: tuple[Cluster, ...]
    tour: Tour
    problems: tuple[str, ...]  # each begins with its key


@dataclass(frozen=True)
class Flown:
    """Missions at their end, one entry per seed."""

    collected: Array  # users by cluster, `[S, M]`
    data_bits: Array  # of each user, `[S, U]`
    landed: Array  # bool `[S]`
    docked_step: Array  # step after which the UAV stayed over the dock; NaN: it did not land; `[S]`
    energy_used_j: Array  # joules, `[S]`


def examine(scenario: Scenario, seeds: Sequence[int] = SEEDS) -> Flyable:
    """Fly tours, and collect what is wrong with a scenario."""
    flown = fly(scenario, fixed_tour(scenario), seeds)
    collected = flown.collected.mean(axis=0)
    users = scenario.users
    starts = [[((user.x_m, user.y_m), user.radius_m) for user in listed] for listed in users.listed]
    reaches = [
        [reach(scenario, *start) for start in of_cluster]
        for of_cluster in starts or [[(disc.centre_m, disc.radius_m)] for disc in users.clusters]
    ]
    clusters = tuple(
        Cluster(
            key=disc.key,
            centre_m=disc.centre_m,
            users=size,
            in_reach=math.fsum(share for share, _ in found) / len(found),
            reach_m=max(needed_m for _, needed_m in found),
            collected=float(of_cluster),
        )
        for disc, size, found, of_cluster in zip(users.clusters, users.sizes, reaches, collected, strict=True)
    )
    tour = Tour(
        missions=len(seeds),
        landed=int(flown.landed.sum()),
        collected=float(collected.sum()),
        docked_step=float(flown.docked_step[flown.landed].mean()) if flown.landed.any() else None,
        energy_used_j=float(flown.energy_used_j.max()) if scenario.energy else None,
        without_limit=steps_of_tour(scenario, seeds),
    )
    (east, north, _), dock = scenario.start_cell, scenario.dock_cell
    moves = abs(east - dock[0]) + abs(north - dock[1])
    return Flyable(
        users=scenario.n_users,
        moves_to_dock=moves_to_dock(scenario) if scenario.obstacles else moves,
        speed_mps=scenario.grid.cell_m / scenario.mission.step_s,
        clusters=clusters,
        tour=tour,
        problems=tuple(_problems(scenario, clusters, tour, seeds)),
    )


def fly(
    scenario: Scenario, act: Act, seeds: Sequence[int], until: Callable[..., bool] | None = None
) -> Flown:
    """Fly the missions of seeds side by side, each to its end; or all of them until `until` holds."""
    steps = rollout_steps(scenario, act, seeds)
    final, _ = next(steps)
    over = landed = final.step < 0
    docked_step = np.full(over.shape, np.nan)
    for state, outcome in steps:
        assert outcome is not None, "every step but the start has one"
        final = world.select(over, final, state)
        docked = mission.at_dock(final.cell, scenario.dock_cell)
        docked_step = np.where(docked, np.where(np.isnan(docked_step), final.step, docked_step), np.nan)
        landed = landed | (outcome.landed & ~over)
        over = over | outcome.terminated | outcome.truncated
        if over.all() or (until is not None and until(state)):
            break

    return Flown(
        collected=by_cluster(scenario, final.collected),
        data_bits=final.data_bits,
        landed=landed,
        docked_step=docked_step,
        energy_used_j=final.energy_used_j,
    )


def by_cluster(scenario: Scenario, collected: Array) -> Array:
    """Users collected of each cluster, `[..., M]`, of bool `[..., U]`."""
    shares = observations.cluster_means(scenario, collected.astype(np.float64))
    return np.rint(shares * np.asarray(scenario.users.sizes))


def steps_of_tour(scenario: Scenario, seeds: Sequence[int] = SEEDS) -> float | None:
    """Steps of a tour that has no limit: it stays until `ENOUGH` of each cluster is collected.

    The mean step at which it is home, over the missions that collect so much; None: fewer than half do.
    """
    grid = scenario.grid
    longest = (grid.n_x + grid.n_y + HOVERS_MAX) * (scenario.n_clusters + 1) + grid.n_z
    limits = msgspec.structs.replace(scenario.mission, max_steps=longest, episode_end="at_time_limit")
    free = msgspec.structs.replace(scenario, mission=limits, energy=None)
    enough = ENOUGH * np.asarray(scenario.users.sizes)

    def is_home(state: world.State) -> bool:
        served = (by_cluster(free, state.collected) >= enough).all(axis=-1)
        return bool((served & mission.at_dock(state.cell, scenario.dock_cell)).all())

    flown = fly(free, fixed_tour(free), seeds, until=is_home)
    complete = (flown.collected >= enough).all(axis=-1)
    return float(flown.docked_step[complete].mean()) if 2 * complete.sum() >= len(seeds) else None


def reach(scenario: Scenario, centre_m: Point, radius_m: float) -> tuple[float, float]:
    """What of a disc is within `mission.d_cons_m` of a cell.

    Returns:
        The share of the disc's area, 0 to 1, and the distance of its point that is farthest from the cell
        nearest to it, metres.
    """
    distance_m = nearest_cell_m(scenario, disc_m(centre_m, radius_m))
    return float((distance_m[:DISC_POINTS] <= scenario.mission.d_cons_m).mean()), float(distance_m.max())


def out_of_reach_m(scenario: Scenario) -> Array:
    """Points where users start from which no cell is within `mission.d_cons_m`, metres, `[P, 2]`."""
    starts = scenario.users.start_discs()
    points_m = np.concatenate([disc_m(disc.centre_m, disc.radius_m) for disc in starts])
    return points_m[nearest_cell_m(scenario, points_m) > scenario.mission.d_cons_m]


def disc_m(centre_m: Point, radius_m: float) -> Array:
    """Points of a disc, metres, `[P, 2]`: `DISC_POINTS` of equal area, then its edge; or only its centre."""
    if radius_m == 0.0:
        return np.asarray([centre_m])
    radii = np.ones(DISC_POINTS + EDGE_POINTS)
    radii[:DISC_POINTS] = np.sqrt((np.arange(DISC_POINTS) + 0.5) / DISC_POINTS)
    turns = (
        np.arange(DISC_POINTS) * (math.sqrt(5.0) - 1.0) / 2.0
    )  # by the golden section: spread at any radius
    angles = 2.0 * math.pi * np.concatenate([turns, np.arange(EDGE_POINTS) / EDGE_POINTS])
    return np.asarray(centre_m) + radius_m * np.stack(
        [radii * np.cos(angles), radii * np.sin(angles)], axis=-1
    )


def nearest_cell_m(scenario: Scenario, ground_m: Array) -> Array:
    """3D distance of points on the ground, metres `[P, 2]`, from the cell nearest to each, metres, `[P]`."""
    cells_m = nearest_cells_m(scenario, ground_m)
    return np.hypot(np.linalg.norm(ground_m - cells_m[:, :2], axis=-1), cells_m[:, 2])


def nearest_cells_m(scenario: Scenario, ground_m: Array) -> Array:
    """Centres x, y, altitude of the cells nearest to points on the ground `[P, 2]`, metres, `[P, 3]`.

    Among obstacles, of the cells that the UAV can reach.
    """
    grid = scenario.grid
    if scenario.moves is None:
        columns = np.clip(np.rint(ground_m / grid.cell_m), 0, np.asarray(grid.shape[:2]) - 1)
        return np.pad(columns * grid.cell_m, ((0, 0), (0, 1)), constant_values=grid.altitude_min_m)
    lowest_m = _lowest_reachable_m(scenario)
    found = []
    for block in np.array_split(ground_m, max(1, len(ground_m) * len(lowest_m) // DISTANCES_MAX)):
        distance = ((block[:, None] - lowest_m[:, :2]) ** 2).sum(axis=-1) + lowest_m[:, 2] ** 2
        found.append(lowest_m[distance.argmin(axis=-1)])
    return np.concatenate(found)


@lru_cache(maxsize=1)
def _lowest_reachable_m(scenario: Scenario) -> Array:
    """Centre of the lowest cell of each column that the UAV can reach from the start, metres, `[C, 3]`."""
    assert scenario.moves is not None, "only with obstacles"
    reachable = scenario.moves.steps_from(np.asarray([scenario.start_cell])) != UNREACHABLE
    columns = np.argwhere(reachable.any(axis=-1))
    lowest = reachable.argmax(axis=-1)[tuple(columns.T)]
    return scenario.grid.centre_m(np.column_stack([columns, lowest]), like=np.zeros(1))


def _problems(
    scenario: Scenario, clusters: Sequence[Cluster], tour: Tour, seeds: Sequence[int]
) -> Iterator[str]:
    limits, battery = scenario.mission, scenario.energy
    for disc in scenario.users.start_discs():
        share, needed_m = reach(scenario, disc.centre_m, disc.radius_m)
        if needed_m > limits.d_cons_m:
            yield (
                f"{disc.key} = {list(disc.centre_m)}: {share:.0%} of its disc is in reach of a cell with "
                f"mission.d_cons_m = {limits.d_cons_m:g}; expected all of it, as with {math.ceil(needed_m)}"
            )
    missed = [i for i, cluster in enumerate(clusters) if not cluster.collected]
    if missed:
        yield _uncollected(scenario, missed, ", ".join(clusters[i].key for i in missed), tour, seeds)
    if tour.landed < tour.missions:
        yield (
            f"mission.max_steps = {limits.max_steps}: a tour lands in {tour.landed} of {tour.missions} "
            "missions; expected in all"
        )
    if battery is not None and battery.ends == "steps" and (tour.energy_used_j or 0.0) > battery.battery_j:
        yield (
            f"energy.battery_j = {battery.battery_j:g}: a mission takes {tour.energy_used_j:.6g} J; expected "
            "at least that, or energy.ends = 'both'"
        )


def _uncollected(scenario: Scenario, missed: list[int], names: str, tour: Tour, seeds: Sequence[int]) -> str:
    """Why a tour collects no user of some clusters."""
    limits = scenario.mission
    steps = f"mission.max_steps = {limits.max_steps}: a tour collects no user of {names}; expected"
    if tour.without_limit is not None:
        return f"{steps} at least {math.ceil(tour.without_limit)}, the steps of a tour of all clusters"
    alone = [fly(scenario, _visit(scenario, i), seeds) for i in missed]
    most_bits = min(
        one.data_bits[:, scenario.user_cluster == i].max() for i, one in zip(missed, alone, strict=True)
    )
    if most_bits == 0.0 or any(one.collected[:, i].any() for i, one in zip(missed, alone, strict=True)):
        return f"{steps} more, or less than mission.r_min_bits = {limits.r_min_bits:g}"
    return (
        f"mission.r_min_bits = {limits.r_min_bits:g}: even flights to one cluster alone collect no user of "
        f"{names}; expected at most {most_bits:.3g}, what one of its users delivers then"
    )


def _visit(scenario: Scenario, cluster: int) -> Act:
    """The tour of a UAV that counts every other cluster as collected."""
    act, others = fixed_tour(scenario), scenario.user_cluster != cluster
    return lambda state: act(replace(state, collected=state.collected | others))
