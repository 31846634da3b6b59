"""The report of a multiverse: `worlds.md`, `worlds.png`, and the scenarios of the chosen world."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from uav_dc_ros import files
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.experiments.paper.claims.contradictions import CONTRADICTIONS, mark
from uav_dc_ros.experiments.paper.claims.findings import CLAIMS
from uav_dc_ros.experiments.paper.worlds import plan
from uav_dc_ros.experiments.paper.worlds.choices import CHOICES, FIXED, PLACES, REFERENCES
from uav_dc_ros.experiments.paper.worlds.choose import implausibility, ranking
from uav_dc_ros.experiments.paper.worlds.draw import World
from uav_dc_ros.experiments.paper.worlds.figure import draw
from uav_dc_ros.experiments.paper.worlds.shares import ClaimShares, Decider, Share, share, summaries
from uav_dc_ros.experiments.paper.worlds.verdicts import (
    SCREENED_FILE,
    VERDICTS_FILE,
    WORLDS_FILE,
    Multiverse,
)

PAGE_FILE, FIGURE_FILE = "worlds.md", "worlds.png"
_BEST = 5  # worlds of the ranking that are shown
_TITLES = {one.name: one.title for one in (*CHOICES, *PLACES)}


def write(multiverse: Multiverse, folder: Path) -> None:
    """Writes the page, its figure, and the chosen world's scenarios, into an existing folder."""
    draw(multiverse.drawn, folder / FIGURE_FILE)
    files.write(folder / PAGE_FILE, worlds_md(multiverse).encode())
    ranked = ranking(multiverse)
    for name in plan.SCENARIOS if len(ranked) else ():
        scenario = multiverse.worlds[ranked[0]].scenario(name)
        files.write(folder / f"chosen_{name}.toml", toml(scenario).encode())


def worlds_md(multiverse: Multiverse) -> str:
    """The text of `worlds.md`."""
    scale, drawn = multiverse.metadata.scale, multiverse.drawn
    n = len(drawn.worlds)
    warning = (
        f"> **The scale is `{scale.name}`: {scale.episodes} episodes. These verdicts mean nothing.** "
        "They show that every part of this page can be made."
    )
    found = summaries(drawn)
    sections = [
        "# The paper's claims in many worlds",
        *([] if scale.name == "full" else [warning]),
        f"The paper leaves {len(CHOICES) + len(PLACES)} values and readings open. {n} worlds were drawn "
        "over all of them, and every claim was weighed in each by the rules of the sweep, as in `claims.md`. "
        "A claim that holds in few worlds owes much to choices that the paper does not state.",
        f"![Claims by worlds]({FIGURE_FILE})",
        "## The claims",
        _claims(found, drawn),
        "Each share has its 95% interval (Wilson). The choices that decide a claim are the two that give "
        "most information on its verdict: 0 is none, 1 is all of it (mutual information adjusted for "
        "chance; Vinh, Epps and Bailey, JMLR 11, 2010). Numbers are taken in three classes of equal size. "
        "*None* stands where no choice is above what the best of all choices reaches in 95% of random "
        "orders of the verdicts. What only a combination of choices decides is not found this way.",
        "### How the choices decide",
        _deciders(found),
        "## Claims against arithmetic and one another",
        "Noted before the run.",
        _contradictions(),
        "## The chosen world",
        _chosen(multiverse),
        "## What is drawn",
        _ranges(multiverse),
        "Open too, but equal in all worlds:",
        "\n".join(f"- {text}" for text in FIXED),
        "## How it was made",
        _provenance(multiverse),
    ]
    return "\n\n".join(sections) + "\n"


def toml(scenario: Scenario) -> str:
    """A scenario as a TOML file."""

    def value(one: object) -> str:
        return msgspec.json.encode(one).decode()  # numbers, strings and arrays look the same in TOML

    lines = []
    for key, table in msgspec.to_builtins(scenario).items():
        if isinstance(table, dict):
            lines += ["", f"[{key}]", *(f"{name} = {value(one)}" for name, one in table.items())]
        else:
            lines.append(f"{key} = {value(table)}")
    return "\n".join(lines) + "\n"


def _claims(found: Sequence[ClaimShares], multiverse: Multiverse) -> str:
    rows = []
    for claim, one, tested in zip(CLAIMS, found, multiverse.tested, strict=True):
        shares = [_share(each) for each in one.shares] if tested else ["", "all: not weighed", ""]
        deciders = "; ".join(_decider(each) for each in one.deciders) or ("none" if tested else "")
        rows.append([claim.id, claim.setting, claim.text, *shares, deciders, mark(claim.id)])
    header = (
        "",
        "setting",
        "claim",
        "holds",
        "undecided",
        "does not hold",
        "decided most by",
        "contradicted by",
    )
    return _table(header, rows)


def _deciders(found: Sequence[ClaimShares]) -> str:
    rows = [
        [one.claim, _TITLES[each.name], ", ".join(f"{label}: {share:.0%}" for label, share in each.shares)]
        for one in found
        for each in one.deciders
    ]
    if not rows:
        return "No choice decides any claim by itself."
    text = (
        "A layout is the length of its shortest tour over that of the direct way to the dock, the dock its "
        "way from the start in widths of the field."
    )
    return f"{text}\n\n{_table(('', 'choice', 'share of worlds in which the claim holds'), rows)}"


def _contradictions() -> str:
    rows = [(claim, one.against, one.why) for claim, several in CONTRADICTIONS.items() for one in several]
    return _table(("claim", "against", "why"), rows)


def _chosen(multiverse: Multiverse) -> str:
    ranked = ranking(multiverse)
    holds = (multiverse.verdicts == "holds").sum(axis=1)
    rule = (
        "The rule was committed before the run: among the worlds in which C1 holds, the one in which most "
        "claims hold; of equals the most plausible one, by the root mean square of log2(value / reference); "
        "then the first."
    )
    references = _table(
        ("reference", "value", "why"),
        [(f"`{one.name}`", f"{one.value:g}", one.reason) for one in REFERENCES],
    )
    if multiverse.screened:
        rule += f" {_screening(multiverse)}"
    if not len(ranked):
        return f"{rule}\n\n{references}\n\nC1 holds in no world: none is chosen."
    best = [
        (f"{multiverse.worlds[i].number}", f"{holds[i]}", f"{implausibility(multiverse.worlds[i]):.2f}")
        for i in ranked[:_BEST]
    ]
    world = multiverse.worlds[ranked[0]]
    text = (
        f"C1 holds in {len(ranked)} of the {len(holds)} worlds in which every claim was weighed; the first "
        f"{len(best)} of the rule's order are "
        f"below. World {world.number} is chosen; its scenarios are `chosen_five_clusters.toml` and "
        "`chosen_three_clusters.toml`."
    )
    ranks = _table(("world", "claims that hold", "distance from plausible, doublings"), best)
    return f"{rule}\n\n{references}\n\n{text}\n\n{ranks}"


def _screening(multiverse: Multiverse) -> str:
    n, screened = len(multiverse.drawn.worlds), multiverse.screened
    holds = sum(row.verdict == "holds" for row in screened)
    return (
        f"Since C1 holds in few of the {n} worlds, or in none, C1 alone was weighed in the next "
        f"{len(screened)} worlds of the sequence whose episode ends at the time limit (where it ends on "
        "arrival, the agent of none of the first 64 worlds lands in more than one greedy mission in ten). "
        "Where it was undecided there, it was weighed again in "
        f"{plan.WIDEST // 2} times as many environments. It holds in "
        f"{_share(share(holds, len(screened)))} of them, {holds}, and every claim was weighed in those. They "
        "are in no share and no figure above."
    )


def _ranges(multiverse: Multiverse) -> str:
    ranked = ranking(multiverse)
    chosen = multiverse.worlds[ranked[0]] if len(ranked) else None
    rows = [
        [one.title, str(one.values), one.paper, one.reason, *([_value(chosen, one.name)] if chosen else [])]
        for one in (*CHOICES, *PLACES)
    ]
    return _table(("choice", "range", "the paper", "reason", *(("chosen",) if chosen else ())), rows)


def _value(world: World, name: str) -> str:
    value = getattr(world, name)
    if isinstance(value, tuple):
        return " ".join(f"({x:g}, {y:g})" for x, y in np.reshape(value, (-1, 2)))
    extra = {"time_per_tour": f": {world.max_steps} steps", "r_min_steps": f": {world.r_min_bits:g} bit"}
    extra["data_scale"] = f": {world.data_scale_bits:g} bit"
    return f"{value}{extra.get(name, '')}"


def _provenance(multiverse: Multiverse) -> str:
    metadata, n = multiverse.metadata, len(multiverse.drawn.worlds)
    scale = metadata.scale
    option = f" --screen {len(multiverse.screened)}" if multiverse.screened else ""
    option += "" if scale.name == "full" else f" --scale {scale.name}"
    n_rejected = sum(metadata.rejected.values())
    reasons = "; ".join(f"{reason}: {k}" for reason, k in metadata.rejected.items())
    planned = plan.planned(scale)
    ratios = ", ".join(f"{beta:g}:{zeta:g}" for beta, zeta in scale.ratios)
    screened = f", `{SCREENED_FILE}` (C1 in each screened world)" if multiverse.screened else ""
    cut = "\n".join(f"- {claim} is not weighed: {why}" for claim, why in plan.CUT.items())
    return f"""```
python -m uav_dc_ros.paper --worlds {n}{option}
```

- uav_dc_ros {metadata.version}; the same command gives the same bytes, also in pieces
- worlds: points of a scrambled Sobol sequence; world n is the n-th that can exist. Of {n + n_rejected} points
  {n_rejected} were rejected{f" ({reasons})" if reasons else ""}
- {len(planned)} runs of {scale.episodes} episodes in each world: the settings that the claims read, in
  {len(scale.environments)} environments from number {scale.environments[0]} on ({", ".join(plan.WIDE)}: in
  twice as many), at the ratios {ratios}
- under `on_arrival` an episode is T_cons iterations and may hold several missions
{cut}
- data: `{WORLDS_FILE}` (a row for each world), `{VERDICTS_FILE}` (a row for each world and claim: verdict,
  the part that decides, its effect and interval){screened}"""


def _share(one: Share) -> str:
    return f"{one.share:.0%} [{one.low:.0%}, {one.high:.0%}]"


def _decider(one: Decider) -> str:
    return f"{_TITLES[one.name]} ({one.measure:.2f})"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in (header, *rows)]
    return "\n".join([lines[0], f"|{'---|' * len(header)}", *lines[1:]])
