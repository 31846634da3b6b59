"""The verb `report`: a page about the missions of a bag, or several bags side by side."""

import argparse
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from uav_dc_ros import __version__, cli, files
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import BagError, ParameterError
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.pages import compare
from uav_dc_ros.recordings.pages.health import Health
from uav_dc_ros.recordings.pages.missions import Flown, flown
from uav_dc_ros.recordings.pages.page import Page
from uav_dc_ros.recordings.pages.vehicle import Way, way
from uav_dc_ros.recordings.pages.world import world
from uav_dc_ros.recordings.recorded_step import RecordedStep, printable
from uav_dc_ros.recordings.recorded_vehicle import vehicle
from uav_dc_ros.topics import SIMULATED

SUMMARIES_MAX = 2_000  # rows in the list of missions
SYSTEM_ROOM = 150_000  # bytes kept for it, for latencies, nodes and faults
OURS = b'<meta name="generator" content="uav_dc_ros report">'
BEGINNING = 1_000  # bytes of a page, within which it says whose it is


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="a bag's folder, or one of its files")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE.html",
        help="the page; a report that is there already is replaced (default: BAG.html, here)",
    )
    parser.add_argument(
        "--mission",
        type=cli.whole_number(0),
        nargs="+",
        metavar="N",
        help="indices of missions (default: all, as many as a page of 3 MB holds)",
    )
    parser.add_argument(
        "--compare",
        type=Path,
        nargs="*",
        metavar="BAG",
        help="bags to put beside the first one; without any, the missions of the first one side by side",
    )
    parser.add_argument("--scenario", metavar="NAME|FILE", help="the world, for a bag without one")
    parser.add_argument("--namespace", metavar="NAME", help="of the missions, where there are several")


def run(options: argparse.Namespace) -> int:
    """Write the page, and tell about it."""
    out: Path = options.out or Path(f"{options.bag.absolute().stem}.html")
    _check_out(out)
    if options.compare is None:
        page, told = _of_bag(options)
    else:
        page, told = compare.page(
            [options.bag, *options.compare], options.mission, options.scenario, options.namespace
        )
    content = page.content()
    files.write(out, content)
    # Beside a page that goes to the output itself, not into it.
    beside = sys.stdout if files.is_replaced(out) else sys.stderr
    print(f"{out}: {told}, {len(content) / 1e6:.2f} MB", file=beside)
    return 0


def _of_bag(options: argparse.Namespace) -> tuple[Page, str]:
    """The page of one bag, and what is in it, in words."""
    with BagReader(options.bag) as reader:
        name = step_reader.namespace(reader, options.namespace)
        scenario = step_reader.scenario(reader, name, options.scenario)
        bag = printable(options.bag.absolute().name)
        title = f"{scenario.name}: {bag}"
        page, health = Page("mission", title), Health(reader, name)
        recorded = step_reader.Steps(reader, name, scenario.step_ns)
        flew = vehicle(reader, name)
        real = flew != SIMULATED
        taken = way(reader, name, scenario) if real else None
        summaries: list[dict[str, Any]] = []
        held: list[int] = []
        total = 0
        full = False
        for one in flown(_heard(recorded, health), scenario, real):
            if options.mission is not None and one.index not in options.mission:
                continue
            total += 1
            health.missed(one)
            if len(summaries) >= SUMMARIES_MAX:
                continue
            summaries.append(one.summary())
            # Missions are shown from the first one on: no later and smaller one fills a gap.
            full = full or not page.add(f"mission-{total - 1}", _of_mission(one, taken), SYSTEM_ROOM)
            if not full:
                held.append(total - 1)
        if not total:
            wanted = "" if options.mission is None else f" {', '.join(map(str, options.mission))}"
            why = "; ".join(recorded.rejected.lines())
            raise BagError(f"bag {options.bag}: no step of a mission{wanted} is in it{why and f': {why}'}")
        health.count(recorded)
        health.read()
        data = {
            "title": title,
            "bag": bag,
            "recorded": _date(reader.first_ns),
            "policy": reader.about.get("policy", "unknown"),
            "about": {k: reader.about[k] for k in ("pace", "policy_sha256") if k in reader.about},
            **({"vehicle": flew} if real else {}),
            "version": __version__,
            "world": world(scenario),
            "missions": summaries,
            "missions_total": total,
            "held": held,
            "health": health.page(),
        }
    if not held or not page.add("data", data):
        raise BagError(f"bag {options.bag}: its report does not fit into 3 MB; expected --mission N")
    left = "" if len(held) == total else f" of {total} (as many as fit; --mission N shows others)"
    return page, f"{len(held)}{left} mission{'s' if total > 1 else ''}"


def _heard(recorded: step_reader.Steps, health: Health) -> Iterator[RecordedStep]:
    for step in recorded:
        health.hear(step)
        yield step


def _of_mission(one: Flown, taken: Way | None) -> dict[str, Any]:
    told = {} if one.journey is None or taken is None else {"journey": one.journey.page(taken)}
    return {"stride": one.stride, "course": one.course(), "table": one.table(), **told}


def _date(at_ns: int) -> str:
    return datetime.fromtimestamp(at_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M UTC")


def _check_out(out: Path) -> None:
    """Refuse to replace what is no report: a bag's file is soon named by mistake.

    Raises:
        ParameterError: something else is there, or the folder is not.
    """
    if not out.absolute().parent.is_dir():
        raise ParameterError(f"--out {out}: expected a file in an existing folder")
    if not out.exists() or not (out.is_dir() or files.is_replaced(out)):
        return
    if out.is_file():
        with out.open("rb") as file:
            if OURS in file.read(BEGINNING):
                return
    raise ParameterError(f"--out {out}: it exists, and is no report; expected a new file, or a report")
