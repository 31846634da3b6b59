"""Tell what a bag holds, and whether it is complete: for people, or as JSON."""

import argparse
import sys
from collections import Counter
from pathlib import Path

import msgspec
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from uav_dc_ros import files
from uav_dc_ros.bags.storage import RECOVER
from uav_dc_ros.recordings.info.missions import MissionSurvey
from uav_dc_ros.recordings.info.survey import Survey, TopicSurvey, start_text, survey
from uav_dc_ros.recordings.recorded_step import printable

WIDTH = 80  # where there is no terminal
MISSIONS_MAX = 30  # that are told one by one


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the verb takes."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    parser.add_argument(
        "--json", nargs="?", const="-", metavar="FILE", help="JSON instead, into a file or to the output"
    )


def run(options: argparse.Namespace) -> int:
    """The verb."""
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
    """Print what a bag holds, fit for a terminal of 80 columns."""
    state = Text("complete", "green") if found.complete else Text("not complete", "bold red")
    console.print(Text(found.path, "bold"), state, soft_wrap=True)
    for problem in found.problems:
        console.print(Text(f"  - {problem}"), soft_wrap=True)
    if found.recoverable:
        console.print(Text(f"  {RECOVER} {found.path} --out DIR"), soft_wrap=True)
    console.print()
    facts = Table.grid(padding=(0, 2), pad_edge=True)
    for name, value in _facts(found):
        facts.add_row(name, Text(value, overflow="fold"))
    console.print(facts)
    console.print(_topics(found))
    if found.missions:
        console.print(_missions(found.missions))
        for line in _reasons(found.missions):
            console.print(Text(line), soft_wrap=True)


def _facts(found: Survey) -> list[tuple[str, str]]:
    about = found.about
    facts = []
    if found.messages:
        facts.append(("recorded", f"{start_text(found.start_ns)}, {found.duration_s:,.3f} s"))
    n_parts = len(found.parts)
    parts = f"{n_parts} parts" if n_parts > 1 else "1 part"
    facts.append(("holds", f"{found.messages:,} messages, {_size(found.size_bytes)} in {parts}"))
    if found.compressed:
        facts.append(("compressed", f"each message by itself, of {len(found.compressed)} topics (zstd)"))
    if bare := [part.name for part in found.parts if not part.has_index]:
        facts.append(("index", f"none in {', '.join(bare)}: read from beginning to end"))
    if found.set_back_s:
        facts.append(("clock", f"set back by {found.set_back_s:,.3f} s while it was recorded"))
    scenarios = {(one.scenario, one.fingerprint) for one in found.missions if one.scenario is not None}
    if "scenario" in about:
        scenarios.add((about["scenario"], about.get("scenario_fingerprint")))
    told = sorted(f"{name} ({print or 'no fingerprint'})" for name, print in scenarios)
    facts.append(("scenario", ", ".join(told) or "-"))
    policy = about.get("policy", "-")
    facts.append(("policy", f"{policy} ({about['policy_sha256']})" if "policy_sha256" in about else policy))
    if "seed" in about:
        facts.append(("seed", about["seed"]))
    elif found.missions and found.missions[0].seed is not None:
        facts.append(("seed", f"{found.missions[0].seed} (of its first mission)"))
    else:
        facts.append(("seed", "-"))
    if "vehicle" in about:
        facts.append(("vehicle", about["vehicle"]))
    if "pace" in about:
        facts.append(("pace", about["pace"]))
    libraries = dict.fromkeys(part.library for part in found.parts if part.library)
    versions = [f"uav_dc_ros {about['version']}"] if "version" in about else []
    versions += [f"ROS 2 {found.ros_distro}"] if found.ros_distro else []
    versions += [f"written by {', '.join(libraries)}"] if libraries else []
    facts.append(("versions", ", ".join(versions) or "-"))
    facts.append(("missions", _outcomes(found.missions) or "none"))
    restarts = ", ".join(f"{node} {n}" for node, n in found.restarts.items())
    if restarts or found.missions:
        facts.append(("restarts", restarts or "none"))
    return facts


def _outcomes(missions: list[MissionSurvey]) -> str:
    if not missions:
        return ""
    outcomes = ", ".join(f"{n} {outcome}" for outcome, n in Counter(m.outcome for m in missions).items())
    shares = [m.collected / m.users for m in missions if m.collected is not None and m.users]
    collected = f"; {sum(shares) / len(shares):.1%} of the users collected" if shares else ""
    return f"{len(missions):,}: {outcomes}{collected}"


def _reasons(missions: list[MissionSurvey]) -> list[str]:
    """Why missions of real vehicles ended as they did."""
    told = []
    for mission in missions[:MISSIONS_MAX]:
        if mission.reason:
            flight = f" of flight {mission.flight}" if mission.flight else ""
            where = f" in {mission.namespace}" if mission.namespace else ""
            told.append(
                f" mission {mission.mission}{flight}{where}: {mission.outcome}: {printable(mission.reason)}"
            )
    return told


def _topics(found: Survey) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    table.add_column("topic", overflow="fold")
    table.add_column("type", overflow="fold")
    dropped = any(topic.dropped for topic in found.topics)
    for column in ["messages", *(["dropped"] if dropped else []), "Hz", "longest gap"]:
        table.add_column(column, justify="right", no_wrap=True)
    for topic in found.topics:
        n_dropped = [f"{topic.dropped:,}"] if dropped else []
        hz = "-" if topic.mean_hz is None else f"{topic.mean_hz:,.2f}"
        table.add_row(
            Text(topic.name),
            Text(", ".join(type.rsplit("/", 1)[-1] for type in (topic.type, *topic.other_types))),
            f"{topic.messages:,}",
            *n_dropped,
            hz,
            _gap(topic),
        )
    return table


def _gap(topic: TopicSurvey) -> str:
    if topic.gap_s is None:
        return "-"
    return f"{topic.gap_s:,.3f} s at {topic.gap_at_s:,.1f} s"


def _missions(missions: list[MissionSurvey]) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    several = len({mission.namespace for mission in missions}) > 1
    flights = any(mission.flight for mission in missions)
    columns = [*(["namespace"] if several else []), *(["flight"] if flights else []), "mission", "outcome"]
    not_reached = any(mission.steps_not_reached for mission in missions)
    columns += ["steps", *(["not reached"] if not_reached else []), "users collected", "seed", "lacks"]
    for column in columns:
        table.add_column(column, justify="left" if column in ("namespace", "outcome", "lacks") else "right")
    for mission in missions[:MISSIONS_MAX]:
        collected = "-" if mission.users is None else f"{mission.collected:,} of {mission.users:,}"
        lacks = ", ".join(f"{n} {topic}" for topic, n in mission.missing.items())
        table.add_row(
            *([Text(mission.namespace or "/")] if several else []),
            *([f"{mission.flight}"] if flights else []),
            f"{mission.mission}", mission.outcome, f"{mission.steps}",
            *([f"{mission.steps_not_reached}"] if not_reached else []), collected,
            "-" if mission.seed is None else f"{mission.seed}", lacks,
        )  # fmt: skip
    if len(missions) > MISSIONS_MAX:
        table.caption = f"and {len(missions) - MISSIONS_MAX:,} missions more: --json"
    return table


def _size(n_bytes: int) -> str:
    if n_bytes < 2**10:
        return f"{n_bytes} bytes"
    for unit, one in (("GiB", 2**30), ("MiB", 2**20)):
        if n_bytes >= one:
            return f"{n_bytes / one:.1f} {unit}"
    return f"{n_bytes / 2**10:.1f} KiB"
