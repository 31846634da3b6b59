"""Tables of numbers: means over environments with their intervals."""

from collections.abc import Mapping, Sequence
from itertools import product

from uav_dc_ros.core.stats import Interval, interval
from uav_dc_ros.experiments.paper.evidence import Evidence, NotMeasured, Table, name
from uav_dc_ros.experiments.paper.setting import Setting

# Measure: title, what to divide by, decimals.
_UNITS = {
    "reward": ("reward", 1.0, 3),
    "reward_share": ("reward share", 1.0, 3),
    "common_share": ("reward share with the binary R_plus for all", 1.0, 3),
    "greedy_reward": ("reward of greedy missions", 1.0, 3),
    "greedy_reward_share": ("reward share of greedy missions", 1.0, 3),
    "throughput_bps": ("throughput, Mbit/s", 1e6, 4),
    "greedy_throughput_bps": ("throughput of greedy missions, Mbit/s", 1e6, 4),
    "users_collected": ("users collected", 1.0, 1),
    "greedy_users_collected": ("users collected in greedy missions", 1.0, 1),
    "landing_rate": ("share of missions that landed", 1.0, 2),
    "greedy_landing_rate": ("share of greedy missions that landed", 1.0, 2),
    "arrival_step": ("arrival step, T_cons when not landed", 1.0, 1),
    "greedy_arrival_step": ("arrival step of greedy missions, T_cons when not landed", 1.0, 1),
    "convergence": ("convergence, episodes; all of them where it never converged", 1.0, 0),
    "fluctuation": ("fluctuation of the reward", 1.0, 4),
}


def numbers(
    evidence: Evidence,
    setting: Setting,
    rows: Mapping[str, Sequence[object]],
    columns: tuple[str, Sequence[object]],
    *measures: str,
) -> tuple[Table, ...]:
    """A table for each measure: settings down, one axis across; a cell is a mean and its interval.

    Args:
        evidence: the measures.
        setting: what all cells share.
        rows: axes whose combinations are the rows.
        columns: name and values of the axis across.
        measures: see `Evidence`.
    """
    axis, across = columns
    header = ("", *(name(value) for value in across))
    tables = []
    for measure in measures:
        title, _, _ = _UNITS[measure]
        body = []
        for point in product(*rows.values()):
            try:
                row = evidence.of(
                    measure, setting.with_(**dict(zip(rows, point, strict=True))), **{axis: across}
                )
            except NotMeasured:
                continue  # a sweep of some figures only: a table beside a claim may have fewer rows
            cells = [cell(interval(column), measure) for column in row.T]
            body.append((", ".join(name(value) for value in point), *cells))
        if body:
            tables.append(Table(title, header, tuple(body)))
    return tuple(tables)


def by_setting(
    evidence: Evidence, setting: Setting, rows: Mapping[str, Sequence[object]], *measures: str
) -> tuple[Table, ...]:
    """One table: settings down, measures across."""
    body = []
    for point in product(*rows.values()):
        here = setting.with_(**dict(zip(rows, point, strict=True)))
        try:
            cells = [cell(interval(evidence.of(measure, here)), measure) for measure in measures]
        except NotMeasured:
            continue
        body.append((", ".join(name(value) for value in point), *cells))
    header = ("", *(_UNITS[measure][0] for measure in measures))
    return (Table("", header, tuple(body)),)


def cell(weighed: Interval, measure: str) -> str:
    """A mean with its interval as text, in the unit of the measure's title."""
    _, unit, decimals = _UNITS[measure]
    mean, low, high = (f"{value / unit:.{decimals}f}" for value in weighed)
    return f"{mean} [{low}, {high}]"
