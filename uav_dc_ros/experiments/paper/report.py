"""The document of a sweep: figures, `claims.md` for people, `claims.json` for programs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from uav_dc_ros import files
from uav_dc_ros.core.stats import Interval
from uav_dc_ros.env.trajectory import Trajectory
from uav_dc_ros.experiments.paper.claims import Finding, check, count
from uav_dc_ros.experiments.paper.evidence import RULES, Part, Table, Verdict
from uav_dc_ros.experiments.paper.figures import draw, drawable
from uav_dc_ros.experiments.paper.plan import FIGURES
from uav_dc_ros.experiments.paper.results import Metadata, Results

CLAIMS_FILE, VERDICTS_FILE = "claims.md", "claims.json"
_VERDICTS: dict[Verdict, str] = {
    "holds": "hold",
    "does not hold": "do not hold",
    "undecided": "are undecided",
    "not tested": "were not tested",
}


def write(
    results: Results, tracks: Sequence[Trajectory], folder: Path, only: Sequence[str] | None = None
) -> None:
    """Draws figures and writes what came of the claims into an existing folder.

    Args:
        results: what was measured.
        tracks: greedy missions for the figure `Traj`.
        folder: where to.
        only: figures to draw; None for all that the results allow.
    """
    possible = drawable(results)
    for name in possible if only is None else only:
        draw(name, results, tracks, folder / f"{name}.png")
    findings = check(results)
    drawn = [name for name in FIGURES if (folder / f"{name}.png").is_file()]
    files.write(folder / CLAIMS_FILE, claims_md(results, findings, drawn).encode())
    verdicts = msgspec.json.format(msgspec.json.encode([_plain(one) for one in findings]), indent=2)
    files.write(folder / VERDICTS_FILE, verdicts + b"\n")


def claims_md(results: Results, findings: Sequence[Finding], drawn: Sequence[str]) -> str:
    """The text of `claims.md`; `drawn` are the figures that lie beside it."""
    counts = ", ".join(
        f"{n} {words}" for verdict, words in _VERDICTS.items() if (n := count(findings, verdict))
    )
    sections = [
        "# What came of the paper's claims",
        *_warning(results.metadata),
        f"Of {len(findings)} claims {counts}.",
        _summary(findings),
        "Effect and interval are those of the part that decides: where a claim fails, the part it fails by.",
        "## How it was made",
        _provenance(results),
        "## The rules",
        "The settings were fixed before the sweep ran, and the rules before any of its results was seen.",
        RULES,
        "## The figures",
        *(_figure(name) for name in drawn),
        "## The claims",
        *(section for finding in findings for section in _section(finding, drawn)),
    ]
    return "\n\n".join(sections) + "\n"


def _warning(metadata: Metadata) -> list[str]:
    if metadata.scale.name == "full":
        return []
    return [
        f"> **The scale is `{metadata.scale.name}`: {metadata.scale.episodes} episodes. These numbers mean "
        "nothing.** They show that every figure and every claim can be made."
    ]


def _provenance(results: Results) -> str:
    metadata, scale = results.metadata, results.metadata.scale
    minutes = f"{metadata.wall_time_s / 60:.1f} minutes" if metadata.wall_time_s else "interrupted, not timed"
    worlds = ", ".join(f"`{name}` {world.fingerprint}" for name, world in metadata.worlds.items())
    environments = ", ".join(map(str, scale.environments))
    seeds = sorted({run.seed for run in results.planned})
    return f"""```
{metadata.command}
```

- uav_dc_ros {metadata.version}; {metadata.device}; {minutes}
- {len(results.planned)} runs of {scale.episodes} episodes; environments {environments}, in each
  {scale.repeats} run(s) of a setting; seeds {", ".join(map(str, seeds))}
- worlds and their fingerprints: {worlds}
- data: `runs.parquet`, `curves.parquet` (means over {scale.episodes_per_point} episodes);
  verdicts also in `{VERDICTS_FILE}`"""


def _summary(findings: Sequence[Finding]) -> str:
    rows = ["| | setting | claim | verdict | effect [95% interval] |", "|---|---|---|---|---|"]
    for claim, verdict, _ in findings:
        rows.append(f"| [{claim.id}](#{claim.id.lower()}) | {claim.setting} | {claim.text} | **{verdict}** |")
    for i, finding in enumerate(findings):
        part = finding.decisive
        rows[2 + i] += f" {_effect(part.effect, part.unit)} |" if part else " |"
    return "\n".join(rows)


def _figure(name: str) -> str:
    plan = FIGURES[name]
    return f"### {name}\n\n![{plan.caption}]({name}.png)\n\n{plan.caption}. Claims: {', '.join(plan.claims)}."


def _section(finding: Finding, drawn: Sequence[str]) -> list[str]:
    claim, verdict, weighed = finding
    figures = ", ".join(f"[{name}](#{name.lower()})" if name in drawn else name for name in claim.figures)
    sections = [
        f"### {claim.id}",
        f"*{claim.setting}:* {claim.text}. Figure {figures}. **{verdict[0].upper()}{verdict[1:]}.**",
    ]
    if weighed.parts:
        sections.append(_parts(weighed.parts, decide=True))
    if weighed.beside:
        sections += ["Beside:", _parts(weighed.beside, decide=False)]
    sections += [_table(table) for table in weighed.tables if table.rows]
    if claim.notes:
        sections.append("\n".join(f"- {note}" for note in claim.notes))
    return sections


def _parts(parts: Sequence[Part], decide: bool) -> str:
    last = ("verdict", "---") if decide else ("it would say", "---")
    rows = [f"| part | effect [95% interval] | {last[0]} |", f"|---|---|{last[1]}|"]
    for part in parts:
        text = f"{part.text}; {part.rule}" if part.rule else part.text
        detail = f" ({part.detail})" if part.detail else ""
        rows.append(f"| {text}{detail} | {_effect(part.effect, part.unit)} | {part.verdict} |")
    return "\n".join(rows)


def _table(table: Table) -> str:
    lines = [f"**{table.title[0].upper()}{table.title[1:]}**\n"] if table.title else []
    lines += [f"| {' | '.join(table.header)} |", f"|{'---|' * len(table.header)}"]
    lines += [f"| {' | '.join(row)} |" for row in table.rows]
    return "\n".join(lines)


def _effect(effect: Interval, unit: str) -> str:
    mean, low, high = (f"{value:.3g}" for value in effect)
    return f"{mean} [{low}, {high}] {unit}".strip()


def _plain(finding: Finding) -> dict[str, Any]:
    """A finding as JSON can hold it."""

    def plain(part: Part) -> dict[str, Any]:
        return {**part._asdict(), "effect": part.effect._asdict()}

    claim, verdict, weighed = finding
    return {
        "id": claim.id,
        "setting": claim.setting,
        "claim": claim.text,
        "verdict": verdict,
        "parts": [plain(part) for part in weighed.parts],
        "beside": [plain(part) for part in weighed.beside],
    }
