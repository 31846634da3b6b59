"""The verb `index`: one table over the missions of many bags, on the terminal and as a file."""

import argparse
import math
import os
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from uav_dc_ros.bags.metadata import METADATA_FILE
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import mission as core_mission
from uav_dc_ros.core.objective import DEFAULT_WEIGHT, objective
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagDamagedError, BagError, MessageError, UavDcError
from uav_dc_ros.messages import Phase, printable
from uav_dc_ros.payloads import check
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.export.tables import Columns, check_new, write_table
from uav_dc_ros.recordings.recorded_step import MissionTotals
from uav_dc_ros.recordings.step_reader import Steps

SUFFIXES = (".mcap", ".db3")
WIDTH = 120  # without a terminal
HASH_SHOWN = 12  # digits of a policy's hash on the terminal
# fmt: off
COLUMNS: Columns = {
    "bag": "text",  # path from the folder of all
    "namespace": "text",  # without a slash at its end
    "flight": "int", "mission": "int",
    "scenario": "text", "scenario_fingerprint": "text", "policy": "text", "policy_sha256": "text",
    "seed": "int",
    "outcome": "text",  # landed, timeout, aborted; unfinished: the bag does not hold the end
    "steps": "int",
    # Step after which the UAV stayed over the dock, as `evaluate` counts it; of missions that landed
    "arrival_step": "int",
    "users_collected": "int", "users_total": "int", "data_bits": "float",
    "objective": "float",  # J of `core.objective` with its default weight; of missions that ended
    "received_ns": "int",  # the bag's first message, since the epoch
    "problem": "text",  # why nothing, or not all, of the bag can be read
}
# fmt: on


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add = parser.add_argument
    add("folder", type=Path, metavar="DIR", help="folder with bags, also in folders inside of it")
    out = "also write a row per mission into a new file, .parquet (which needs pyarrow) or .csv"
    add("--out", type=Path, metavar="FILE", help=out)
    add(
        "--json",
        action="store_true",
        help="print a JSON array with an object per mission instead of the table",
    )


def run(options: argparse.Namespace) -> int:
    """Print and write the table; the exit status."""
    out: Path | None = options.out
    if out is not None:
        check_new(out, ".parquet", ".csv")
    rows = [row for bag in find_bags(options.folder) for row in bag_rows(bag, options.folder)]
    if not rows:
        raise BagError(f"{options.folder} holds no bag; expected folders or files with {', '.join(SUFFIXES)}")
    if out is not None:
        write_table(out, COLUMNS, {name: [row[name] for row in rows] for name in COLUMNS})
    if options.json:
        print(msgspec.json.format(msgspec.json.encode(rows), indent=2).decode())
    else:
        _show(rows)
    return 0


def find_bags(folder: Path) -> Iterator[Path]:
    """Folders of bags, and files that are bags alone, in order; raises BagError if the folder is unreadable.

    The files of one folder are one bag if it has a metadata.yaml, or if all begin with the folder's name.
    """
    if not folder.is_dir():
        raise BagError(f"{folder}: no such folder; expected one with bags")
    for name, folders, names in os.walk(folder, onerror=None):
        folders[:] = sorted(one for one in folders if not one.startswith("."))
        path = Path(name)
        stored = sorted(one for one in names if one.endswith(SUFFIXES) and not one.startswith("."))
        own = f"{path.absolute().name}_"
        if stored and (METADATA_FILE in names or all(one.startswith(own) for one in stored)):
            yield path
        else:
            yield from (path / one for one in stored)


def bag_rows(path: Path, folder: Path) -> list[dict[str, Any]]:
    """A row for each mission of a bag, or one with its problem; `folder` is that of all bags."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS) | {"bag": printable(str(path.relative_to(folder)))}
    try:
        try:
            with BagReader(path) as reader:
                return _missions(reader, row)
        except BagDamagedError as error:
            with BagReader(path, torn=True) as reader:
                return _missions(reader, row | {"problem": printable(str(error))})
    except UavDcError as error:
        return [row | {"problem": printable(str(error))}]


def _missions(reader: BagReader, row: dict[str, Any]) -> list[dict[str, Any]]:
    about = reader.about
    row = row | {"received_ns": reader.first_ns or None, "seed": None}
    row |= {name: about.get(name) for name in ("policy", "policy_sha256")}
    rows = []
    for namespace in step_reader.namespaces(reader):
        try:
            scenario: Scenario | None = step_reader.scenario(reader, namespace)
        except UavDcError:
            scenario = None  # of a bag of another recorder
        steps = Steps(reader, namespace, 2**63 if scenario is None else scenario.step_ns)
        for (flight, number), recorded in groupby(steps, attrgetter("flight", "mission")):
            totals, arrival = MissionTotals(), None
            for step in recorded:
                totals.add(step.step, step.status, step.rates)
                if step.step and step.status and scenario and _is_of(step.status, scenario):
                    docked = bool(core_mission.at_dock(np.asarray(step.status.cell), scenario.dock_cell))
                    arrival = (step.step if arrival is None else arrival) if docked else None
            rows.append(
                row
                | {
                    "namespace": namespace,
                    "flight": flight,
                    "mission": number,
                    "scenario": totals.scenario,
                    "scenario_fingerprint": totals.fingerprint,
                    "seed": totals.seed,
                    "outcome": totals.outcome,
                    "steps": totals.steps,
                    "arrival_step": arrival if totals.outcome == Phase.LANDED else None,
                    "users_collected": totals.collected,
                    "users_total": totals.users,
                    "data_bits": totals.data_bits,
                    "objective": _objective(totals, arrival, scenario),
                }
            )
    return rows or [row | {"problem": row["problem"] or "no mission"}]


def _is_of(status: Any, scenario: Scenario) -> bool:
    try:
        check(status, scenario)
    except MessageError:
        return False
    return True


def _objective(totals: MissionTotals, arrival: int | None, scenario: Scenario | None) -> float | None:
    """J of a mission; None where it did not end, or something of it is unknown."""
    landed = totals.outcome == Phase.LANDED
    if not totals.is_over or scenario is None or totals.collected is None or (landed and arrival is None):
        return None
    values = np.asarray(totals.collected), np.asarray(math.nan if arrival is None else arrival)
    sizes = {"n_users": scenario.n_users, "max_steps": scenario.mission.max_steps}
    return float(objective(*values, np.asarray(landed), **sizes))


def _show(rows: Sequence[dict[str, Any]]) -> None:
    """Print a line for each bag, policy and scenario."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    columns = ("bag", "scenario", "policy", "seeds", "outcomes", "users", "arrival", "J")
    for column in columns:
        right = column in ("users", "arrival", "J")
        table.add_column(column, justify="right" if right else "left", overflow="fold", no_wrap=right)
    grouped: defaultdict[tuple[Any, ...], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        grouped[tuple(row[key] for key in ("bag", "scenario", "policy", "policy_sha256"))].append(row)
    for (bag, scenario, policy, sha256), missions in grouped.items():
        hash = f" ({sha256[:HASH_SHOWN]})" if sha256 else ""
        seeds = sorted({row["seed"] for row in missions if row["seed"] is not None})
        outcomes = Counter(row["outcome"] for row in missions if row["outcome"])
        shares = [row["users_collected"] / row["users_total"] for row in missions if row["users_total"]]
        cells = (
            bag,
            scenario or "-",
            f"{policy or '-'}{hash}",
            _span(seeds),
            ", ".join(f"{n} {outcome}" for outcome, n in outcomes.items()) or "-",
            f"{np.mean(shares):.1%}" if shares else "-",
            _mean(missions, "arrival_step", 1),
            _mean(missions, "objective", 3),
        )
        table.add_row(*map(Text, cells))
    table.caption = f"users, arrival and J (weight {DEFAULT_WEIGHT:.3g}) are means over the missions"
    console = Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    console.print(table)
    for bag, problem in dict.fromkeys((row["bag"], row["problem"]) for row in rows if row["problem"]):
        console.print(Text(f" {bag}: {problem}"), soft_wrap=True)


def _span(seeds: Sequence[int]) -> str:
    if len(seeds) > 1 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"{seeds[0]}-{seeds[-1]}"
    return ", ".join(map(str, seeds)) or "-"


def _mean(missions: Sequence[dict[str, Any]], key: str, digits: int) -> str:
    known = [row[key] for row in missions if row[key] is not None]
    return f"{np.mean(known):.{digits}f}" if known else "-"
