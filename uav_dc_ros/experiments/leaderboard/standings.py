"""From the flights to the standings: means, intervals, differences, and the flights that are looked at."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from uav_dc_ros import __version__
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.stats import interval
from uav_dc_ros.experiments.evaluate.evaluation import Figure, figure
from uav_dc_ros.experiments.leaderboard import flights
from uav_dc_ros.experiments.leaderboard.flights import BlockResult, Bounds, Contestant
from uav_dc_ros.experiments.leaderboard.worlds import Board, BoardWorld, Sizes

WORST = 10  # flights that are listed and drawn
_SHARE = (0.0, 1.0)  # possible values
_EQUAL = 1e-12  # of two values of J


class BoardRow(msgspec.Struct, frozen=True, kw_only=True):
    """A contestant on a board. A figure is over the fields, or over the missions of a single world."""

    policy: str
    objective: Figure  # J, see `core.objective`
    share_of_bound: Figure  # mean J over mean bound, of the missions with a bound
    users: Figure  # collected, share of all
    data: Figure  # delivered, mean over the users of the share of r_min, each at most 1
    landing_rate: Figure
    arrival: Figure  # step of the arrival, share of T_cons; missions that landed only
    # `policy` minus the baseline, of the same missions: J, users, arrival. Absent for the baseline
    differences: dict[str, Figure] | UnsetType = UNSET
    # better, worse: fields, or missions, in which J is above and below that of the baseline
    better: int = 0
    worse: int = 0
    shift_effect: Figure | UnsetType = UNSET  # J minus that in the same worlds without the shift
    objectives: list[float]  # J by mission, world by world


class Standings(msgspec.Struct, frozen=True, kw_only=True):
    """A board with its ranking."""

    name: str
    section: str
    home: str  # world whose own policies fly, too; "": only what flies in any field
    n_worlds: int
    n_missions: int  # in each world
    n_bounded: int  # missions with a bound
    bound: float | None  # mean of the bounds
    found: float | None  # mean J of the best missions that were found with the walks known
    n_optimal: int  # of these, missions that are proved to be the best
    rows: list[BoardRow]  # the highest J first
    refused: dict[str, str]  # why a contestant does not fit, by its name


class ListedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """A flight of the baseline on the board `fields` that is listed and drawn."""

    scenario: str
    seed: int
    objective: float
    bound: float | None
    users: float
    landed: bool
    arrival: float  # step, share of T_cons
    best: str  # the other contestant with the highest J there
    best_objective: float
    # clusters, users_total, cells, max_steps: of the field
    clusters: int
    users_total: int
    cells: tuple[int, int, int]
    max_steps: int


class LeaderboardReport(msgspec.Struct, frozen=True, kw_only=True):
    """The content of `leaderboard.json`."""

    version: str  # of the package
    objective_weight: float  # w in J
    width: int  # of the decision diagrams behind the bounds
    sizes: Sizes
    contestants: dict[str, str | None]  # by name, the hash of a policy's config and model; none of a planner
    baseline: str  # with which all are compared
    boards: list[Standings]
    # of the baseline on the board `fields`: the flight with the highest J, the middle one, the lowest ones
    best: ListedFlight | None
    median: ListedFlight | None
    worst: list[ListedFlight]


@dataclass(frozen=True)
class BoardResults:
    """Everything that was flown on a board."""

    board: Board
    flown: dict[str, BlockResult]  # by contestant
    bounds: Bounds


def collect(
    board: Board, blocks: Sequence[flights.Block], contestants: Sequence[Contestant], folder: Path
) -> BoardResults:
    """The results of all blocks of a board; raises UavDcError for one that is missing or damaged."""
    flown = {
        one.name: flights.joined([flights.load_flown(folder, block, one) for block in blocks])
        for one in contestants
    }
    bounds = [flights.load_bounds(folder, block) for block in blocks if block.n_bounded]
    bound = [value for one in bounds for value in one.bound]
    return BoardResults(board, flown, Bounds(bound=bound, found=[v for one in bounds for v in one.found]))


def report(
    results: Sequence[BoardResults],
    contestants: Sequence[Contestant],
    baseline: str,
    *,
    weight: float,
    width: int,
    sizes: Sizes,
) -> LeaderboardReport:
    """The report of all boards."""
    by_name = {one.board.name: one for one in results}
    worst, median, best = _listed(by_name.get("fields"), baseline)
    return LeaderboardReport(
        version=__version__,
        objective_weight=weight,
        width=width,
        sizes=sizes,
        contestants={one.name: one.sha256 for one in contestants},
        baseline=baseline,
        boards=[_standings(one, by_name.get(one.board.unshifted), baseline) for one in results],
        best=best,
        median=median,
        worst=worst,
    )


def _standings(one: BoardResults, unshifted: BoardResults | None, baseline: str) -> Standings:
    board, bounds = one.board, one.bounds
    pairs = zip(bounds.bound, bounds.found, strict=True)
    known = [(b, f) for b, f in pairs if b is not None and f is not None]
    flown = {name: result for name, result in one.flown.items() if not result.refused}
    of_baseline = flown.get(baseline)
    rows = [
        _row(name, result, one, None if name == baseline else of_baseline, unshifted)
        for name, result in flown.items()
    ]
    return Standings(
        name=board.name,
        section=board.section,
        home=board.home,
        n_worlds=len(board.worlds),
        n_missions=board.n_missions,
        n_bounded=len(known),
        bound=float(np.mean([b for b, _ in known])) if known else None,
        found=float(np.mean([f for _, f in known])) if known else None,
        n_optimal=sum(b <= f + _EQUAL for b, f in known),
        rows=sorted(rows, key=lambda row: -(row.objective.mean or 0.0)),
        refused={name: result.refused for name, result in one.flown.items() if result.refused},
    )


def _row(
    name: str,
    flown: BlockResult,
    results: BoardResults,
    baseline: BlockResult | None,
    unshifted: BoardResults | None,
) -> BoardRow:
    units = _units(results.board)
    mine = _figures(flown, units)
    bounds = results.bounds.bound
    pairs = [(value, b) for value, b in zip(flown.objective[: len(bounds)], bounds, strict=True) if b]
    row = BoardRow(
        policy=name,
        objective=figure(mine["objective"], _SHARE),
        users=figure(mine["users"], _SHARE),
        data=figure(mine["data"], _SHARE),
        landing_rate=figure(mine["landing_rate"], _SHARE),
        arrival=figure(mine["arrival"], _SHARE),
        share_of_bound=_share(np.asarray(pairs)) if pairs else Figure(n=0),
        objectives=flown.objective,
    )
    if baseline is not None:
        other = _figures(baseline, units)
        differences = {key: mine[key] - other[key] for key in ("objective", "users", "arrival")}
        row = msgspec.structs.replace(
            row,
            differences={key: figure(values) for key, values in differences.items()},
            better=int((differences["objective"] > 0).sum()),
            worse=int((differences["objective"] < 0).sum()),
        )
    before = unshifted.flown.get(name) if unshifted else None
    if before is not None and len(before.objective) >= len(flown.objective):
        change = np.subtract(flown.objective, before.objective[: len(flown.objective)])
        row = msgspec.structs.replace(row, shift_effect=figure(units(change)))
    return row


def _units(board: Board) -> Callable[[Array], Array]:
    """From missions to what the figures are over: fields, each with its mean, or missions of one world."""

    def means(values: Array) -> Array:
        if len(board.worlds) == 1:
            return values
        by_world = np.reshape(values, (len(board.worlds), board.n_missions))
        n = np.isfinite(by_world).sum(axis=1)
        return np.where(n > 0, np.nansum(by_world, axis=1) / np.maximum(n, 1), np.nan)

    return means


def _figures(flown: BlockResult, units: Callable[[Array], Array]) -> dict[str, Array]:
    landed = np.asarray(flown.landed)
    values = {
        "objective": np.asarray(flown.objective),
        "users": np.asarray(flown.users),
        "data": np.asarray(flown.data),
        "landing_rate": landed.astype(np.float64),
        "arrival": np.where(landed, flown.arrival, np.nan),
    }
    return {name: units(each) for name, each in values.items()}


def _share(pairs: Array) -> Figure:
    """Mean J over mean bound, of J and bound `[n, 2]`."""
    if len(pairs) == 1:
        return Figure(n=1, mean=float(pairs[0, 0] / pairs[0, 1]))
    found = interval(pairs, lambda means: means[..., 0] / means[..., 1]).within(*_SHARE)
    return Figure(n=len(pairs), **found._asdict())


def _listed(
    results: BoardResults | None, baseline: str
) -> tuple[list[ListedFlight], ListedFlight | None, ListedFlight | None]:
    """The flights of the baseline with the lowest J, the middle one and the best one."""
    if results is None or results.flown[baseline].refused:
        return [], None, None
    order = np.argsort(results.flown[baseline].objective, kind="stable").tolist()
    worst = [_flight(results, baseline, i) for i in order[:WORST]]
    median = _flight(results, baseline, order[(len(order) - 1) // 2])
    return worst, median, _flight(results, baseline, order[-1])


def _flight(results: BoardResults, baseline: str, i: int) -> ListedFlight:
    board, flown, bounds = results.board, results.flown[baseline], results.bounds.bound
    others = {name: one for name, one in results.flown.items() if name != baseline and not one.refused}
    world: BoardWorld = board.worlds[i // board.n_missions]
    scenario = world.load().scenario
    best = max(others, key=lambda name: others[name].objective[i], default="")
    return ListedFlight(
        scenario=world.scenario,
        seed=i % board.n_missions,
        objective=flown.objective[i],
        bound=bounds[i] if i < len(bounds) else None,
        users=flown.users[i],
        landed=flown.landed[i],
        arrival=flown.arrival[i],
        best=best,
        best_objective=others[best].objective[i] if best else 0.0,
        clusters=scenario.n_clusters,
        users_total=scenario.n_users,
        cells=scenario.grid.shape,
        max_steps=scenario.mission.max_steps,
    )
