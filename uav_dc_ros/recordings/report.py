"""The verb `report`: a page about the missions of a bag, or several bags side by side."""

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from uav_dc_ros import __version__, cli, files
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import BagError, ParameterError
from uav_dc_ros.messages import printable
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.flight_log import aligned
from uav_dc_ros.recordings.pages import compare
from uav_dc_ros.recordings.pages.flight_log import log_data
from uav_dc_ros.recordings.pages.health import Health
from uav_dc_ros.recordings.pages.missions import read_missions
from uav_dc_ros.recordings.pages.page import Page, world_data
from uav_dc_ros.recordings.pages.vehicle import read_path
from uav_dc_ros.topics import SIMULATED

SUMMARIES_MAX = 2_000  # rows in the list of missions
SYSTEM_ROOM = 150_000  # bytes kept for latencies, nodes and faults
GENERATOR = b'<meta name="generator" content="uav_dc_ros report">'
HEAD_SIZE = 1_000  # bytes of a page that contain the generator
LOG_OFFSET = "--log-offset"
ABOUT = ("pace", "objective_weight", "search", "policy_sha256")  # of a bag, that the page shows


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    out = "the page; replaces an existing report (default: BAG.html in the current folder)"
    add("--out", type=Path, metavar="FILE.html", help=out)
    missions = "indices of missions (default: all, as many as a page of 3 MB holds)"
    add("--mission", type=cli.whole_number(0), nargs="+", metavar="N", help=missions)
    bags = "bags to compare with the first one; without any, the missions of the first one side by side"
    add("--compare", type=Path, nargs="*", metavar="BAG", help=bags)
    what = f"the autopilot's own log of the flight, aligned as by the verb `log`: {aligned.LOG_HELP}"
    add("--log", type=Path, metavar="LOG", help=what)
    aligned.add_offset(parser, LOG_OFFSET)
    add("--scenario", metavar="NAME|FILE", help="the world, for a bag without one")
    add("--namespace", metavar="NAME", help="of the missions, for a bag with several")


def run(options: argparse.Namespace) -> int:
    """Write the page and print its content; the exit status."""
    out: Path = options.out or Path(f"{options.bag.absolute().stem}.html")
    if options.log is not None and options.compare is not None:
        raise ParameterError("--log applies to the page of one bag; expected no --compare beside it")
    if options.log_offset is not None and options.log is None:
        raise ParameterError(f"{LOG_OFFSET} applies to --log only")
    _check_out(out)
    if options.compare is None:
        page, summary = _report(options)
    else:
        page, summary = compare.page(options)
    content = page.content()
    files.write(out, content)
    # To standard error if the page goes to standard output.
    stream = sys.stdout if files.is_replaced(out) else sys.stderr
    print(f"{out}: {summary}, {len(content) / 1e6:.2f} MB", file=stream)
    return 0


def _report(options: argparse.Namespace) -> tuple[Page, str]:
    """The page of one bag, and its content in a few words."""
    with BagReader(options.bag) as reader:
        name = step_reader.namespace(reader, options.namespace)
        scenario = step_reader.scenario(reader, name, options.scenario)
        bag = printable(options.bag.absolute().name)
        title = f"{scenario.name}: {bag}"
        page, health = Page("mission", title), Health(reader, name)
        recorded = step_reader.Steps(reader, name, scenario.step_ns)
        vehicle = step_reader.vehicle(reader, name)
        real = vehicle != SIMULATED
        path = read_path(reader, name, scenario) if real else None
        log = None
        if options.log is not None:
            log = log_data(aligned.load(reader, name, options.log, options.log_offset, LOG_OFFSET))
        summaries: list[dict[str, Any]] = []
        shown: list[int] = []
        total = 0
        for mission in read_missions(map(health.add_step, recorded), scenario, real):
            if options.mission is not None and mission.index not in options.mission:
                continue
            total += 1
            health.add_mission(mission)
            if len(summaries) >= SUMMARIES_MAX:
                continue
            summaries.append(mission.summary())
            # The first missions are shown: a later and smaller one fills no gap.
            is_next = len(shown) == len(summaries) - 1
            if is_next and page.add(f"mission-{total - 1}", mission.data(path), SYSTEM_ROOM):
                shown.append(total - 1)
        if not total:
            raise BagError(compare.no_step(options.bag, options.mission, recorded))
        health.read(recorded)
        start = datetime.fromtimestamp(reader.first_ns * 1e-9, UTC)
        overview = {
            "title": title,
            "bag": bag,
            "recorded": start.strftime("%Y-%m-%d %H:%M UTC"),
            "policy": reader.about.get("policy", "unknown"),
            "about": {key: reader.about[key] for key in ABOUT if key in reader.about},
            **({"vehicle": vehicle} if real else {}),
            "version": __version__,
            "world": world_data(scenario),
            "missions": summaries,
            "missions_total": total,
            "shown": shown,
            "health": health.data(),
            "log": log,
        }
    if not shown or not page.add("data", overview):
        raise BagError(f"bag {options.bag}: its report does not fit into 3 MB; expected --mission N")
    left = "" if len(shown) == total else f" of {total} (as many as fit; --mission N shows others)"
    return page, f"{len(shown)}{left} mission{'s' if total > 1 else ''}"


def _check_out(out: Path) -> None:
    """Raises ParameterError if the file exists and is no report, or its folder does not exist."""
    if not out.absolute().parent.is_dir():
        raise ParameterError(f"--out {out}: expected a file in an existing folder")
    if not out.exists() or not (out.is_dir() or files.is_replaced(out)):
        return
    if out.is_file():
        with out.open("rb") as file:
            if GENERATOR in file.read(HEAD_SIZE):
                return
    raise ParameterError(f"--out {out} exists and is not a report; expected a new file, or a report")
