"""The command line of `python -m uav_dc_ros.leaderboard`."""

import argparse
import os
import time
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.agents.agent import Agent
from uav_dc_ros.core.objective import DEFAULT_WEIGHT, EXPECTED_WEIGHT
from uav_dc_ros.errors import FROM_TRAIN, UavDcError
from uav_dc_ros.experiments.evaluate.cli import candidates
from uav_dc_ros.experiments.leaderboard import decision_times, flights, page, standings
from uav_dc_ros.experiments.leaderboard.flights import Contestant, FlightTask
from uav_dc_ros.experiments.leaderboard.worlds import SECTIONS, Board, Sizes, boards
from uav_dc_ros.experiments.processes import run_tasks
from uav_dc_ros.experiments.train.progress import ProgressBar
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.run_config import SEARCH_MAX

PROG = "python -m uav_dc_ros.leaderboard"
REPORT_FILE = "leaderboard.json"
_LINE_EVERY_S = 30.0  # between two lines of progress without a terminal


def parser() -> cli.Parser:
    """The command line."""
    options = cli.Parser(
        prog=PROG,
        description="Fly policies and planners in many worlds, and write their standings against one another "
        "and against what is possible.",
    )
    add = options.add_argument
    text = (
        "beside the planners and the shipped policies; policies for any field fly in all worlds, others in "
    )
    text += "their own. The first one for any field is what all are compared with, without one search"
    add("--policy", nargs="+", default=[], metavar="NAME|DIR", help=text)
    text = "missions of a search on top of the given policies, which fly also without; see evaluate --search"
    number = cli.whole_number(1, SEARCH_MAX, f"a whole number from 1 to {SEARCH_MAX}")
    add("--search", type=number, nargs="+", default=[], metavar="N", help=text)
    add(
        "--planners",
        nargs="+",
        choices=list(PLANNERS),
        default=list(PLANNERS),
        metavar="NAME",
        help="default: all",
    )
    add(
        "--only",
        nargs="+",
        choices=SECTIONS,
        default=list(SECTIONS),
        metavar="SECTION",
        help=f"{', '.join(SECTIONS)}",
    )
    text = "random fields of seeds 0 to N-1; default 500"
    add("--fields", type=cli.count, default=500, metavar="N", help=text)
    add("--missions", type=cli.count, default=50, metavar="N", help="in each shipped world; default 50")
    text = "random fields with each channel, obstacle and shift; default 20"
    add("--variants", type=cli.count, default=20, metavar="N", help=text)
    text = "random fields with a bound, and a tenth of it in other boards; default 100"
    add("--bounds", type=cli.whole_number(0), default=100, metavar="N", help=text)
    text = "of the decision diagrams behind the bounds, see optimum --width; default 250"
    add("--width", type=cli.count, default=250, metavar="N", help=text)
    weight = cli.number(0.0, 1.0, EXPECTED_WEIGHT)
    text = "w of the objective J: 1 counts the users only, 0 the time only; default 10/11"
    add("--objective", type=weight, default=DEFAULT_WEIGHT, metavar="W", help=text)
    text = "folder of the page, its pictures and its data; default leaderboard"
    add("--out", type=Path, default=Path("leaderboard"), metavar="DIR", help=text)
    text = "folder that keeps all flights, so that the next command flies what is new only; default "
    text += "leaderboard_flights"
    add("--flights", type=Path, default=Path("leaderboard_flights"), metavar="DIR", help=text)
    cores = len(os.sched_getaffinity(0))
    add(
        "--workers",
        type=cli.count,
        default=cores,
        metavar="N",
        help="processes, each on one core; default all",
    )
    return options


def main(argv: list[str] | None = None) -> None:
    """Run the command, and exit."""
    cli.run(lambda: _leaderboard(parser().parse_args(argv)), PROG)


def _leaderboard(options: argparse.Namespace) -> int:
    if find_spec("matplotlib") is None:  # before the flights, not after them
        raise UavDcError(f"matplotlib {FROM_TRAIN}")
    sizes = Sizes(
        fields=options.fields, missions=options.missions, variants=options.variants, bounds=options.bounds
    )
    entrants = _entrants(options.planners, options.policy, options.search)
    contestants = {
        one.name: Contestant(name=one.name, argument=one.argument, sha256=one.sha256, search=one.search)
        for one in entrants
    }
    baseline = _baseline(entrants)
    planned = boards(sizes, tuple(options.only))
    for folder in (options.out, options.flights):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UavDcError(f"{folder} cannot be made: {error.strerror}") from None
        files.check_writable(folder / REPORT_FILE)
    flying = {
        board.name: [contestants[one.name] for one in entrants if _flies(one, board)] for board in planned
    }
    blocks = {board.name: flights.blocks(board, options.objective, options.width) for board in planned}
    tasks = [
        flights.task(board, i, block, flying[board.name], options.flights)
        for board in planned
        for i, block in enumerate(blocks[board.name])
    ]
    _run([task for task in tasks if task.contestants or task.bounds], len(tasks), options)

    results = [
        standings.collect(board, blocks[board.name], flying[board.name], options.flights) for board in planned
    ]
    report = standings.report(
        results,
        list(contestants.values()),
        baseline.name,
        weight=options.objective,
        width=options.width,
        sizes=sizes,
    )
    from uav_dc_ros.experiments.leaderboard.pictures import draw  # needs matplotlib

    draw(report, baseline, options.out)
    files.write(options.out / REPORT_FILE, msgspec.json.encode(report) + b"\n")
    files.write(options.out / page.PAGE_FILE, page.page(report).encode())
    times = [_times(one, planned, options.objective) for one in entrants]
    text = decision_times.page([one for one in times if one is not None])
    files.write(options.out / decision_times.TIMES_FILE, text.encode())
    Console().print(
        f"{options.out}: {len(planned)} boards; read {options.out / page.PAGE_FILE}", soft_wrap=True
    )
    return 0


def _entrants(planners: Sequence[str], given: Sequence[str], searches: Sequence[int]) -> list[Agent]:
    """Planners, shipped policies, and the given ones, these also with each search."""
    if planner := next((name for name in given if name in PLANNERS), None):
        raise UavDcError(f"--policy {planner}: a planner; expected --planners {planner}")
    if searches and not given:
        raise UavDcError(f"--search {searches[0]} without --policy; expected a policy that searches")
    shipped = [name for name in policies.names() if name not in given]
    every = candidates([*dict.fromkeys(planners), *shipped], [0]) + candidates(given, [0, *searches])
    names = [one.name for one in every]
    if double := next((name for name in names if names.count(name) > 1), None):
        raise UavDcError(f"--policy: another policy has the name {double!r}; expected a name of its own")
    for one in every:
        if not one.for_any_field and one.home is not None and one.home.name not in scenarios.names():
            raise UavDcError(
                f"--policy {one.name}: it flies in {one.home.name!r} only; expected a policy for any field, "
                f"or for one of {', '.join(scenarios.names())}"
            )
    return every


def _baseline(entrants: Sequence[Agent]) -> Agent:
    for_any = [one for one in entrants if one.for_any_field and one.policy is not None]
    planners = sorted((one for one in entrants if one.policy is None), key=lambda one: one.name != "search")
    return [*for_any, *planners][0]


def _flies(one: Agent, board: Board) -> bool:
    return one.for_any_field or (one.home is not None and one.home.name == board.home)


def _times(
    one: Agent, planned: Sequence[Board], weight: float
) -> tuple[str, str, list[float], list[float]] | None:
    board = next((board for board in planned if _flies(one, board) and not board.unshifted), None)
    return None if board is None else (one.name, board.name, *decision_times.measure(one, board, weight))


def _run(tasks: Sequence[FlightTask], n_tasks: int, options: argparse.Namespace) -> None:
    """Fly the tasks, and show the progress."""
    if not tasks:
        return
    total, done = sum(task.n_steps for task in tasks), dict.fromkeys((task.name for task in tasks), 0)
    started = latest = time.monotonic()
    columns = (
        BarColumn(bar_width=20),
        TextColumn("{task.percentage:3.0f}%  {task.fields[text]}"),
        TimeElapsedColumn(),
    )
    with ProgressBar(*columns, total=total) as bar:

        def show(name: str, steps: int) -> None:
            nonlocal latest
            done[name] = steps
            now, line = time.monotonic(), None
            if now - latest > _LINE_EVERY_S:
                latest = now
                line = f"{sum(done.values())} of {total} worlds, {(now - started) / 60:.1f} minutes: {name}"
            bar.update(sum(done.values()), name, line)

        fly = partial(flights.fly, options.flights)
        run_tasks(tasks, fly, options.workers, show, "the same command continues")
    minutes = (time.monotonic() - started) / 60
    Console().print(f"flew {len(tasks)} of {n_tasks} blocks in {minutes:.1f} minutes", soft_wrap=True)
