"""The report of a sweep: figures, `claims.md` for people, `claims.json` for programs."""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import msgspec

from uav_dc_ros import files
from uav_dc_ros.core.reward import DATA, MISSION_REWARD
from uav_dc_ros.core.stats import Interval, interval
from uav_dc_ros.env.trajectory import Trajectory
from uav_dc_ros.experiments.paper.claims.contradictions import mark
from uav_dc_ros.experiments.paper.claims.criteria import RULES, ClaimTable, Criterion, Verdict
from uav_dc_ros.experiments.paper.claims.findings import Finding, check
from uav_dc_ros.experiments.paper.evidence import Evidence, NotMeasured
from uav_dc_ros.experiments.paper.figures import draw, drawable
from uav_dc_ros.experiments.paper.plan import FIGURES
from uav_dc_ros.experiments.paper.results import Results
from uav_dc_ros.experiments.paper.setting import domain, name
from uav_dc_ros.experiments.paper.worlds.page import PAGE_FILE
from uav_dc_ros.experiments.paper.worlds.shares import holding
from uav_dc_ros.experiments.paper.worlds.verdicts import WORLDS_FILE, Multiverse

CLAIMS_FILE, VERDICTS_FILE = "claims.md", "claims.json"
_VERDICTS: dict[Verdict, str] = {
    "holds": "hold",
    "does not hold": "do not hold",
    "undecided": "are undecided",
    "not tested": "were not tested",
}
# By whether the block is another than 0.
_BLOCKS = (
    "whose environments and seeds had a part in choosing worlds and rules",
    "whose environments and seeds no choice has seen",
)
_SHARES = ("landing_rate", "greedy_landing_rate")  # measures from 0 to 1
# Measure: title, divisor, decimals. The words of `MISSION_REWARD` replace r^t.
_UNITS = {
    "reward": ("reward r^t", 1.0, 3),
    "reward_share": ("reward share, r^t", 1.0, 3),
    "common_share": ("reward share with the binary R_plus for all, r^t", 1.0, 3),
    "greedy_reward": ("reward of greedy missions, r^t", 1.0, 3),
    "greedy_reward_share": ("reward share of greedy missions, r^t", 1.0, 3),
    "throughput_bps": ("throughput, Mbit/s", 1e6, 4),
    "greedy_throughput_bps": ("throughput of greedy missions, Mbit/s", 1e6, 4),
    "users_collected": ("users collected", 1.0, 1),
    "greedy_users_collected": ("users collected in greedy missions", 1.0, 1),
    "landing_rate": ("share of missions that landed", 1.0, 2),
    "greedy_landing_rate": ("share of greedy missions that landed", 1.0, 2),
    "arrival_step": ("arrival step, T_cons when not landed", 1.0, 1),
    "greedy_arrival_step": ("arrival step of greedy missions, T_cons when not landed", 1.0, 1),
    "convergence": ("convergence, episodes; all of them where it never converged", 1.0, 0),
    "fluctuation": ("fluctuation of the reward r^t", 1.0, 4),
}


def write(
    results: Results, tracks: Sequence[Trajectory], folder: Path, only: Sequence[str] | None = None
) -> None:
    """Writes the claims, and the figures in `only` or all that the results allow, into an existing folder."""
    for figure in drawable(results) if only is None else only:
        draw(figure, results, tracks, folder / f"{figure}.png")
    findings = check(results)
    drawn = [figure for figure in FIGURES if (folder / f"{figure}.png").is_file()]
    worlds = Multiverse.load(folder) if (folder / WORLDS_FILE).is_file() else None
    files.write(folder / CLAIMS_FILE, claims_md(results, findings, drawn, worlds).encode())
    verdicts = msgspec.json.format(msgspec.json.encode([_plain(one) for one in findings]), indent=2)
    files.write(folder / VERDICTS_FILE, verdicts + b"\n")


def claims_md(
    results: Results, findings: Sequence[Finding], drawn: Sequence[str], worlds: Multiverse | None = None
) -> str:
    """The text of `claims.md`; `drawn` are the figures beside it, as is the page of the `worlds`."""
    evidence, scale = Evidence(results), results.metadata.scale
    warning = (
        f"> **The scale is `{scale.name}`: {scale.episodes} episodes. These numbers mean nothing.** "
        "They show that every figure and every claim can be made."
    )
    sections = [
        "# Findings on the paper's claims",
        *([] if scale.name == "full" else [warning]),
        f"Of {len(findings)} claims {_counts(findings)}.",
        *_of_five(findings),
        _summary(findings, worlds),
        "Effect and interval are those of the part that decides: where a claim fails, the part it fails by.",
        "## How it was made",
        _provenance(results),
        "## The rules",
        "The settings were fixed before the sweep ran, and the rules before any result was seen, but for the "
        "interval (below).",
        RULES,
        "## The figures",
        *map(_figure, drawn),
        "## The claims",
        *(section for finding in findings for section in _sections(finding, evidence, drawn)),
    ]
    return "\n\n".join(sections) + "\n"


def _counts(findings: Sequence[Finding]) -> str:
    n = Counter(finding.verdict for finding in findings)
    return ", ".join(f"{n[verdict]} {words}" for verdict, words in _VERDICTS.items() if n[verdict])


def _of_five(findings: Sequence[Finding]) -> list[str]:
    """What would change with as many environments as the paper has; nothing if there are no more."""
    fewer = [finding.of_five for finding in findings if finding.of_five]
    if not fewer:
        return []
    other = [one.claim.id for one, five in zip(findings, fewer, strict=True) if one.verdict != five.verdict]
    differ = f"The verdicts on {', '.join(other)} differ" if other else "No verdict differs"
    return [f"In the first five environments alone, as many as the paper has, {_counts(fewer)}. {differ}."]


def _provenance(results: Results) -> str:
    metadata, scale = results.metadata, results.metadata.scale
    minutes = f"; {metadata.wall_time_s / 60:.1f} minutes" if metadata.wall_time_s else ""
    worlds = ", ".join(f"`{name}` {world.fingerprint}" for name, world in metadata.worlds.items())
    data = ", ".join(f"`{name}` {DATA[world.reward_data]}" for name, world in metadata.worlds.items())
    environments = ", ".join(map(str, scale.environments))
    seeds = sorted({run.seed for run in results.planned})
    return f"""```
{metadata.command}
```

- uav_dc_ros {metadata.version}; {metadata.device}{minutes}
- {len(results.planned)} runs of {scale.episodes} episodes; block {scale.block}, {_BLOCKS[scale.block > 0]}
- environments {environments}, in each {scale.repeats} run(s) of a setting;
  seeds {", ".join(map(str, seeds))}
- worlds and their fingerprints: {worlds}
- data in r^t (eq. 7): {data}
- data: `runs.parquet`, `curves.parquet` (means over {scale.episodes_per_point} episodes);
  verdicts also in `{VERDICTS_FILE}`"""


def _summary(findings: Sequence[Finding], worlds: Multiverse | None) -> str:
    header = ["", "setting", "claim", "verdict", "effect [95% interval]", "contradicted by"]
    rows = []
    for finding in findings:
        claim, criterion = finding.claim, finding.decisive
        effect = _effect(criterion.effect, criterion.unit) if criterion else ""
        link = f"[{claim.id}](#{claim.id.lower()})"
        row = [link, claim.setting, claim.text, f"**{finding.verdict}**", effect, mark(claim.id)]
        rows.append([*row, finding.of_five.verdict] if finding.of_five else row)
    header = [*header, "with the paper's five"][: len(rows[0])]
    if worlds is not None:
        header.append(f"holds in [many worlds]({PAGE_FILE})")
        for row, share in zip(rows, holding(worlds).values(), strict=True):
            row.append("" if share is None else f"{share.share:.0%} [{share.low:.0%}, {share.high:.0%}]")
    return _markdown(header, rows)


def _figure(name: str) -> str:
    plan = FIGURES[name]
    return f"### {name}\n\n![{plan.caption}]({name}.png)\n\n{plan.caption}. Claims: {', '.join(plan.claims)}."


def _sections(finding: Finding, evidence: Evidence, drawn: Sequence[str]) -> list[str]:
    claim, verdict = finding.claim, finding.verdict
    figures = ", ".join(f"[{name}](#{name.lower()})" if name in drawn else name for name in claim.figures)
    sections = [
        f"### {claim.id}",
        f"*{claim.setting}:* {claim.text}. Figure {figures}. **{verdict[0].upper()}{verdict[1:]}.**",
    ]
    if verdict != "not tested":
        sections.append(_criteria(finding, True, "verdict"))
        if not all(one.decides for one in finding.criteria):
            sections += ["Beside:", _criteria(finding, False, "verdict by itself")]
        sections += [text for table in claim.tables for text in tables_md(evidence, table)]
    if claim.notes:
        sections.append("\n".join(f"- {note}" for note in claim.notes))
    return sections


def _criteria(finding: Finding, decide: bool, verdict_title: str) -> str:
    """A table of the criteria that decide the verdict, or of the others."""
    rows = []
    for one, five in _with_five(finding):
        if one.decides == decide:
            detail = f" ({one.detail})" if one.detail else ""
            row = [f"{one.text}; {one.rule}{detail}", _effect(one.effect, one.unit), one.verdict]
            rows.append([*row, f"{_effect(five.effect, five.unit)}: {five.verdict}"] if five else row)
    header = ("part", "effect [95% interval]", verdict_title, "with the paper's five")
    return _markdown(header[: len(rows[0])], rows)


def _with_five(finding: Finding) -> Iterator[tuple[Criterion, Criterion | None]]:
    """Each criterion with the same of five environments, if there are more."""
    return zip_longest(finding.criteria, finding.of_five.criteria if finding.of_five else ())


def tables_md(evidence: Evidence, table: ClaimTable) -> list[str]:
    """A table in Markdown; with `columns`, one for each measure. Settings without runs are left out."""
    if table.columns is None:
        header = [_title(measure, evidence, table) for measure in table.measures]
        return [_markdown(["", *header], _rows(evidence, table, table.measures))]
    header = [name(value) for value in domain(table.columns, evidence.scale)]
    sections = []
    for measure in table.measures:
        title = _title(measure, evidence, table)
        text = _markdown(["", *header], _rows(evidence, table, [measure], table.columns))
        sections.append(f"**{title[0].upper()}{title[1:]}**\n\n{text}")
    return sections


def _title(measure: str, evidence: Evidence, table: ClaimTable) -> str:
    """A measure in words."""
    data = evidence.results.metadata.worlds[table.setting.scenario].reward_data
    return _UNITS[measure][0].replace("r^t", MISSION_REWARD[data])


def _rows(evidence: Evidence, table: ClaimTable, measures: Sequence[str], *axes: str) -> list[list[str]]:
    """For each setting its label, and a cell for each measure and each value on `axes`."""
    rows = []
    for setting in table.setting.along(table.rows, evidence.scale):
        row = [", ".join(map(name, setting.values(table.rows or ("algorithm",))))]
        try:
            for measure in measures:
                values = evidence.of(measure, setting, *axes)
                row += [_cell(interval(column), measure) for column in values.reshape(len(values), -1).T]
        except NotMeasured:
            continue
        rows.append(row)
    return rows


def _cell(effect: Interval, measure: str) -> str:
    """A mean with its interval in the unit of the measure's title."""
    _, unit, decimals = _UNITS[measure]
    effect = effect.within(0.0, 1.0) if measure in _SHARES else effect
    mean, low, high = (f"{value / unit:.{decimals}f}" for value in effect)
    return f"{mean} [{low}, {high}]"


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in (header, *rows)]
    return "\n".join([lines[0], f"|{'---|' * len(header)}", *lines[1:]])


def _effect(effect: Interval, unit: str) -> str:
    mean, low, high = (f"{value:.3g}" for value in effect)
    return f"{mean} [{low}, {high}] {unit}".strip()


def _plain(finding: Finding) -> dict[str, Any]:
    """A finding as JSON can hold it."""

    def plain(decide: bool) -> list[dict[str, Any]]:
        made = []
        for one, five in _with_five(finding):
            values = one._asdict() | {"effect": one.effect._asdict()}
            if five:
                values["of_five"] = {"effect": five.effect._asdict(), "verdict": five.verdict}
            if values.pop("decides") == decide:
                made.append(values)
        return made

    claim, five = finding.claim, finding.of_five
    return {
        "id": claim.id,
        "setting": claim.setting,
        "claim": claim.text,
        "verdict": finding.verdict,
        **({"verdict_of_five": five.verdict} if five else {}),
        "parts": plain(True),
        "beside": plain(False),
    }
