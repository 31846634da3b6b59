"""The page of a leaderboard: `README.md`, from its report alone."""

from collections.abc import Sequence

from msgspec import UNSET, UnsetType

from uav_dc_ros.experiments.evaluate.evaluation import OBJECTIVE_IN_WORDS, Figure
from uav_dc_ros.experiments.leaderboard.standings import BoardRow, LeaderboardReport, ListedFlight, Standings

PAGE_FILE, FLIGHTS_PICTURE, WORST_PICTURE = "README.md", "flights.png", "worst.png"
_TITLES = {
    "fields": "Unseen fields",
    "shipped": "Shipped worlds",
    "channels": "Channels",
    "obstacles": "Obstacles",
    "shifts": "Shifts",
}
_ABOUT = {
    "fields": "The random fields `random:0` and up, one mission each, seed 0.",
    "shipped": "Each with its own policies. Where no user moves, all missions are equal.",
    "channels": "Random fields with another channel or interference. The data of a user, r_min, stays that "
    "of the field.",
    "obstacles": "Random fields with three obstacles at random places.",
    "shifts": "The world is changed, and the contestants keep what they know: see [Shifts](../shifts.md).",
}


def page(report: LeaderboardReport) -> str:
    """The text of the page."""
    sections = dict.fromkeys(board.section for board in report.boards)
    parts = ["# Leaderboard: the tables", _head(report), "## Overview", _overview(report)]
    for section in sections:
        parts += [f"## {_TITLES[section]}", _ABOUT[section]]
        for board in report.boards:
            if board.section == section:
                parts += _board(board, report.baseline, titled=section != "fields")
        if section == "fields" and report.best and report.median:
            parts += _flights(report, report.best, report.median)
    parts += ["## Contestants", _contestants(report)]
    return "\n\n".join(parts) + "\n"


def _head(report: LeaderboardReport) -> str:
    return (
        f"{OBJECTIVE_IN_WORDS} Here w = {report.objective_weight:.3g}. All numbers are means with their 95% "
        f"bootstrap intervals. *Less {report.baseline}* is the mean of J less that of `{report.baseline}`, "
        "mission by mission, and in how many fields or "
        "missions J is above and below it. [About the "
        "leaderboard](../leaderboard.md) explains the columns."
    )


def _overview(report: LeaderboardReport) -> str:
    """Mean J of each contestant on each board; the highest one is bold."""
    means = {board.name: _means(board) for board in report.boards}
    names = [
        name for name in report.contestants if all(name in means[b.name] for b in report.boards if not b.home)
    ]
    rows = []
    for board in means.values():
        texts = {name: f"{mean:.3f}" for name, mean in board.items()}
        best = max(texts.values(), default="")
        texts = {name: f"**{text}**" if text == best else text for name, text in texts.items()}
        own = ", ".join(f"`{name}` {text}" for name, text in texts.items() if name not in names)
        rows.append([*(texts.get(name, "") for name in names), own])
    titled = [[f"`{name}`", *row] for name, row in zip(means, rows, strict=True)]
    header = ["mean J", *(f"`{name}`" for name in names), "policies of that world"]
    return _table(header, titled)


def _means(board: Standings) -> dict[str, float]:
    return {row.policy: row.objective.mean for row in board.rows if row.objective.mean is not None}


def _board(board: Standings, baseline: str, *, titled: bool) -> list[str]:
    unit = "missions" if board.n_worlds == 1 else "fields"
    n = board.n_missions if board.n_worlds == 1 else board.n_worlds
    each = f", {board.n_missions} missions in each" if board.n_worlds > 1 and board.n_missions > 1 else ""
    facts = f"{n} {unit}{each}."
    if board.bound is not None and board.found is not None:
        facts += (
            f" In the first {board.n_bounded} missions no planner exceeds a mean J of {board.bound:.4f}; the "
            f"best missions found, with the walks known, have {board.found:.4f}, and {board.n_optimal} of "
            "them are proved to be the best."
        )
    elif board.section != "shifts":
        facts += " No mission has a bound."
    shifted = any(row.shift_effect is not UNSET for row in board.rows)
    header = ["", "J", *(["J less unshifted"] if shifted else ["of the bound"])]
    header += ["users", "data", "landed", "arrival / T_cons", f"J less {baseline}", "above, below"]
    rows = [_row(row, shifted) for row in board.rows]
    found = [f"### `{board.name}`"] * titled + [facts, _table(header, rows)]
    return found + [f"`{name}` does not fly: {_sentence(why)}" for name, why in board.refused.items()]


def _row(row: BoardRow, shifted: bool) -> list[str]:
    compared = row.differences is not UNSET
    return [
        f"`{row.policy}`",
        _number(row.objective),
        _number(row.shift_effect, "+") if shifted else _percent(row.share_of_bound, 1),
        _percent(row.users, 1),
        _percent(row.data, 1),
        _percent(row.landing_rate, 1),
        _number(row.arrival, decimals=3),
        _number(row.differences["objective"], "+") if row.differences is not UNSET else "",
        f"{row.better}, {row.worse}" if compared else "",
    ]


def _flights(report: LeaderboardReport, best: ListedFlight, median: ListedFlight) -> list[str]:
    header = [
        "",
        "field",
        "clusters, users, cells, steps",
        "J",
        "bound",
        "users",
        "landed",
        "arrival",
        "best other",
    ]
    worst = [(f"worst {i}", one) for i, one in enumerate(report.worst, start=1)]
    rows = [_flight(*each) for each in (("best", best), ("median", median), *worst)]
    name = report.baseline
    return [
        f"### Flights of `{name}`",
        f"The best, the median and the worst one by J:\n\n![The best, median and worst flight of {name}]"
        f"({FLIGHTS_PICTURE})",
        f"The worst {len(worst)}, in the order of the table; [why](../leaderboard.md#the-worst-flights):\n\n"
        f"![The worst flights of {name}]({WORST_PICTURE})",
        _table(header, rows),
    ]


def _flight(title: str, one: ListedFlight) -> list[str]:
    cells = " x ".join(map(str, one.cells))
    return [
        title,
        f"`{one.scenario}`" + (f", seed {one.seed}" if one.seed else ""),
        f"{one.clusters}, {one.users_total}, {cells}, {one.max_steps}",
        f"{one.objective:.4f}",
        "" if one.bound is None else f"{one.bound:.4f}",
        f"{one.users:.1%}",
        "yes" if one.landed else "no",
        f"{one.arrival:.3f}" if one.landed else "",
        f"`{one.best}` {one.best_objective:.4f}" if one.best else "",
    ]


def _contestants(report: LeaderboardReport) -> str:
    rows = [
        [f"`{name}`", f"`{sha256[:12]}`" if sha256 else ""] for name, sha256 in report.contestants.items()
    ]
    sizes = report.sizes
    made = (
        f"Version {report.version}: {sizes.fields} fields, {sizes.missions} missions in a shipped world, "
        f"{sizes.variants} fields with each channel, obstacle and shift, bounds by diagrams "
        f"of width {report.width}."
    )
    return f"{_table(['', 'SHA-256 of config and model'], rows)}\n\n{made}"


def _sentence(text: str) -> str:
    return f"{text}."


def _number(value: Figure | UnsetType, sign: str = "", decimals: int = 4) -> str:
    if value is UNSET or value.mean is None:
        return ""
    mean = f"{value.mean:{sign}z.{decimals}f}"
    if value.low is None or value.high is None:
        return mean
    return f"{mean} ({value.low:{sign}z.{decimals}f} to {value.high:{sign}z.{decimals}f})"


def _percent(value: Figure, decimals: int) -> str:
    if value.mean is None:
        return ""
    mean = f"{value.mean:.{decimals}%}"
    if value.low is None or value.high is None:
        return mean
    return f"{mean} ({100 * value.low:.{decimals}f} to {100 * value.high:.{decimals}f})"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in (header, *rows)]
    return "\n".join([lines[0], f"|{'---|' * len(header)}", *lines[1:]])
