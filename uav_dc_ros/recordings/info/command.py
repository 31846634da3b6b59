"""Show the content of a bag, and whether it is complete: as text, or as JSON."""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import msgspec
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from uav_dc_ros import files
from uav_dc_ros.bags.metadata import MADE_BY_KEY
from uav_dc_ros.bags.storage import RECOVER
from uav_dc_ros.messages import printable
from uav_dc_ros.recordings.info.survey import MissionSurvey, Survey, survey
from uav_dc_ros.recordings.recorded_step import mission_name

WIDTH = 80  # without a terminal
MISSIONS_MAX = 30  # listed one by one
NAMES_MAX = 6  # of users not collected, listed for a mission
TEXTS = ("namespace", "outcome", "not collected", "lacks")  # columns of text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    json = "JSON instead, into a file or to the output"
    parser.add_argument("--json", nargs="?", const="-", metavar="FILE", help=json)


def run(options: argparse.Namespace) -> int:
    """Print the survey of a bag; the exit status."""
    found = survey(options.bag)
    if options.json is None:
        show(found, Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False))
        return 0
    text = msgspec.json.format(msgspec.json.encode(found), indent=2) + b"\n"
    if options.json == "-":
        print(text.decode(), end="")
    else:
        files.write(Path(options.json), text)
    return 0


def show(found: Survey, console: Console) -> None:
    """Print a survey for a terminal of 80 columns."""
    state = Text("complete", "green") if found.complete else Text("not complete", "bold red")
    console.print(Text(found.path, "bold"), state, soft_wrap=True)
    for problem in found.problems:
        console.print(Text(f"  - {problem}"), soft_wrap=True)
    if found.recoverable:
        console.print(Text(f"  {RECOVER} {found.path} --out DIR"), soft_wrap=True)
    console.print()
    facts = Table.grid(padding=(0, 2), pad_edge=True)
    for name, value in _facts(found).items():
        facts.add_row(name, Text(value, overflow="fold"))
    console.print(facts)
    console.print(_topics(found))
    if found.missions:
        console.print(_missions(found.missions))
    for mark in found.marks[:MISSIONS_MAX]:
        where = f" in {mark.namespace}" if mark.namespace else ""
        console.print(Text(f" mark{where} at {mark.s:.3f} s: {mark.text}"), soft_wrap=True)
    for mission in found.missions[:MISSIONS_MAX]:
        if mission.reason:
            where = f" in {mission.namespace}" if mission.namespace else ""
            name = mission_name(mission.mission, mission.flight)
            text = f" {name}{where}: {mission.outcome}: {printable(mission.reason)}"
            console.print(Text(text), soft_wrap=True)


def _facts(found: Survey) -> dict[str, str]:
    about, facts = found.about, dict[str, str]()
    if found.messages:
        start = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(found.start_ns // 10**9))
        facts["recorded"] = f"{start}, {found.duration_s:,.3f} s"
    n_parts = len(found.parts)
    parts = f"{n_parts} parts" if n_parts > 1 else "1 part"
    facts["holds"] = f"{found.messages:,} messages, {_size(found.size_bytes)} in {parts}"
    if found.compressed:
        facts["compressed"] = f"message by message, on {len(found.compressed)} topics (zstd)"
    if found.json_channels:
        facts["payloads"] = f"{', '.join(found.json_channels)} as JSON"
    if MADE_BY_KEY in about:
        facts["made by"] = printable(about[MADE_BY_KEY])
    if bare := [part.name for part in found.parts if not part.has_index]:
        facts["index"] = f"none in {', '.join(bare)}: read sequentially"
    if found.set_back_s:
        facts["clock"] = f"set back by {found.set_back_s:,.3f} s during the recording"
    scenarios = {(one.scenario, one.fingerprint) for one in found.missions if one.scenario is not None}
    if "scenario" in about:
        scenarios.add((about["scenario"], about.get("scenario_fingerprint")))
    names = sorted(f"{name} ({print or 'no fingerprint'})" for name, print in scenarios)
    facts["scenario"] = ", ".join(names) or "-"
    policy = about.get("policy", "-")
    facts["policy"] = f"{policy} ({about['policy_sha256']})" if "policy_sha256" in about else policy
    first = found.missions[0].seed if found.missions else None
    facts["seed"] = about.get("seed", "-" if first is None else f"{first} (of its first mission)")
    facts |= {name: about[name] for name in ("vehicle", "pace") if name in about}
    libraries = dict.fromkeys(part.library for part in found.parts if part.library)
    versions = [f"uav_dc_ros {about['version']}"] if "version" in about else []
    versions += [f"ROS 2 {found.ros_distro}"] if found.ros_distro else []
    versions += [f"written by {', '.join(libraries)}"] if libraries else []
    facts["versions"] = ", ".join(versions) or "-"
    facts["missions"] = _outcomes(found.missions)
    restarts = ", ".join(f"{node} {n}" for node, n in found.restarts.items())
    if restarts or found.missions:
        facts["restarts"] = restarts or "none"
    return facts


def _outcomes(missions: list[MissionSurvey]) -> str:
    if not missions:
        return "none"
    outcomes = ", ".join(f"{n} {outcome}" for outcome, n in Counter(m.outcome for m in missions).items())
    shares = [m.collected / m.users for m in missions if m.collected is not None and m.users]
    collected = f"; {sum(shares) / len(shares):.1%} of the users collected" if shares else ""
    return f"{len(missions):,}: {outcomes}{collected}"


def _topics(found: Survey) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    table.add_column("topic", overflow="fold")
    table.add_column("type", overflow="fold")
    dropped = any(topic.dropped for topic in found.topics)
    for column in ["messages", *(["dropped"] if dropped else []), "Hz", "longest gap"]:
        table.add_column(column, justify="right", no_wrap=True)
    for topic in found.topics:
        types = (type.rsplit("/", 1)[-1] for type in (topic.type, *topic.other_types))
        table.add_row(
            Text(topic.name),
            Text(", ".join(types)),
            f"{topic.messages:,}",
            *([f"{topic.dropped:,}"] if dropped else []),
            "-" if topic.mean_hz is None else f"{topic.mean_hz:,.2f}",
            "-" if topic.gap_s is None else f"{topic.gap_s:,.3f} s at {topic.gap_at_s:,.1f} s",
        )
    return table


def _missions(missions: list[MissionSurvey]) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    rows = [
        {
            "namespace": mission.namespace or "/",
            "flight": f"{mission.flight}",
            "mission": f"{mission.mission}",
            "outcome": mission.outcome,
            "steps": f"{mission.steps}",
            "not reached": f"{mission.steps_not_reached}",
            "users collected": f"{mission.collected:,} of {mission.users:,}"
            if mission.users is not None
            else "-",
            "not collected": _listed(mission.not_collected or []),
            "seed": "-" if mission.seed is None else f"{mission.seed}",
            "lacks": ", ".join(f"{n} {topic}" for topic, n in mission.missing.items()),
        }
        for mission in missions[:MISSIONS_MAX]
    ]
    shown = {
        "namespace": len({mission.namespace for mission in missions}) > 1,
        "flight": any(mission.flight for mission in missions),
        "not collected": any(mission.not_collected for mission in missions),
        "not reached": any(mission.steps_not_reached for mission in missions),
    }
    columns = [column for column in rows[0] if shown.get(column, True)]
    for column in columns:
        table.add_column(column, justify="left" if column in TEXTS else "right")
    for row in rows:
        table.add_row(*(Text(row[column]) for column in columns))
    if len(missions) > MISSIONS_MAX:
        table.caption = f"and {len(missions) - MISSIONS_MAX:,} more missions: --json"
    return table


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - NAMES_MAX} more" if len(names) > NAMES_MAX else ""
    return printable(", ".join(names[:NAMES_MAX]) + more)


def _size(n_bytes: int) -> str:
    for unit, size in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if n_bytes >= size:
            return f"{n_bytes / size:.1f} {unit}"
    return f"{n_bytes} bytes"
