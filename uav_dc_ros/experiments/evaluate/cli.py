"""The command line of `python -m uav_dc_ros.evaluate`."""

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import UavDcError
from uav_dc_ros.experiments.evaluate.evaluation import (
    COLUMNS,
    TITLES,
    EvaluatedMissions,
    Evaluation,
    EvaluationReport,
    Figure,
    compare,
    judge,
    mean_and_interval,
    rows,
    save_mission_picture,
    steer,
)
from uav_dc_ros.experiments.evaluate.rollout import Act
from uav_dc_ros.planners import PLANNERS

PROG = "python -m uav_dc_ros.evaluate"

# The figures by which policies are compared at a glance.
_AT_A_GLANCE = ("landing_rate", "users_collected", "arrival_step", "sum_rate_bps")


class Pilot(NamedTuple):
    """Who can fly: a policy, or a planner.

    Attributes:
        name: what the results call it.
        sha256: of a policy's config and model.
        home: name of the scenario that a policy learnt in.
        steer: how it flies in a scenario; raises PolicyError where it does not fit.
    """

    name: str
    sha256: str | None
    home: str | None
    steer: Callable[[Scenario], Act]


def main(argv: list[str] | None = None) -> None:
    """Runs the command line, and exits."""
    parser = cli.Parser(
        prog=PROG, description="Fly policies over many missions, and show and compare how they do."
    )
    parser.add_argument(
        "--policy",
        nargs="+",
        required=True,
        metavar="NAME|DIR",
        help=f"shipped: {', '.join(policies.names())}; to compare with: {', '.join(PLANNERS)}; "
        "all are compared with the first",
    )
    parser.add_argument(
        "--scenario",
        nargs="+",
        default=[],
        metavar="NAME|FILE",
        help=f"every policy flies in each; shipped: {', '.join(scenarios.names())}; "
        "default: by the name of the policy's own",
    )
    parser.add_argument("--seeds", type=cli.count, default=100, metavar="N", help="missions, seeds 0 to N-1")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write evaluations and comparisons")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the mission with seed 0")

    def command() -> int:
        options = parser.parse_args(argv)
        flights = _flights(options.policy, options.scenario)
        acts = [pilot.steer(scenario) for pilot, scenario in flights]
        if options.picture and len(flights) > 1:
            raise UavDcError(f"--picture of {len(flights)} flights; expected one policy in one scenario")
        for path in filter(None, (options.json, options.picture)):
            files.check_writable(path)
        if options.picture:
            pilot, scenario = flights[0]
            save_mission_picture(pilot.steer(scenario), scenario, 0, options.picture)

        flown = [
            judge(pilot.name, pilot.sha256, act, scenario, range(options.seeds))
            for (pilot, scenario), act in zip(flights, acts, strict=True)
        ]
        first: dict[str, EvaluatedMissions] = {}  # in each scenario
        comparisons = []
        for one in flown:
            baseline = first.setdefault(one.evaluation.fingerprint, one)
            if one is not baseline:
                comparisons.append(compare(one, baseline))
        report = EvaluationReport(evaluations=[one.evaluation for one in flown], comparisons=comparisons)
        if options.json:
            files.write(options.json, msgspec.json.format(msgspec.json.encode(report), indent=2) + b"\n")
        show(report)
        return 0

    cli.run(command, PROG)


def _flights(wanted: Sequence[str], where: Sequence[str]) -> list[tuple[Pilot, Scenario]]:
    """Who flies where, in the order of the results: every policy in each scenario, or in its own."""
    for option, given in (("--policy", wanted), ("--scenario", where)):
        for one in given:
            if given.count(one) > 1:
                raise UavDcError(f"{option} {one} is given {given.count(one)} times; expected once")
    pilots = [_pilot(one) for one in wanted]
    names = [pilot.name for pilot in pilots]
    pilots = [  # a table must tell them apart
        pilot._replace(name=one) if names.count(pilot.name) > 1 else pilot
        for pilot, one in zip(pilots, wanted, strict=True)
    ]
    if where:
        worlds = [scenarios.load(one) for one in where]
        names = [world.name for world in worlds]
        if len(set(names)) < len(names):
            raise UavDcError(
                f"--scenario {' '.join(where)}: their names are {', '.join(names)}; expected different ones"
            )
        return [(pilot, world) for world in worlds for pilot in pilots]
    flights = []
    for pilot in pilots:
        if pilot.home is None:
            raise UavDcError(
                f"--policy {pilot.name}: a planner has no scenario of its own; expected --scenario"
            )
        flights.append((pilot, scenarios.load(pilot.home)))
    return flights


def _pilot(given: str) -> Pilot:
    if given in PLANNERS:
        return Pilot(given, None, None, PLANNERS[given])
    policy = policies.load(given)
    return Pilot(policy.name, policy.sha256, policy.scenario.name, partial(steer, policy))


def show(report: EvaluationReport) -> None:
    """Prints a table for each evaluation, and one of all when there are more."""
    # A file or a pipe has no width of its own; rich would wrap at 80.
    console = Console(width=None if sys.stdout.isatty() else 100, highlight=False)
    for evaluation in report.evaluations:
        where = f"{evaluation.scenario}, {evaluation.users_total} users"
        title = f"{evaluation.policy} in {where}, {_missions(evaluation)}"
        console.print(title, style="bold", markup=False, soft_wrap=True)
        console.print(_details(evaluation), "")
    if len(report.evaluations) > 1:
        title = f"Means and their 95% bootstrap intervals, {_missions(report.evaluations[0])}"
        console.print(title, style="bold", soft_wrap=True)
        console.print(_overview(report))
        console.print("Arrival: over missions that landed; its difference: over those in which both did.")


def _details(evaluation: Evaluation) -> Table:
    """Every figure of one evaluation."""
    table = _table()
    for column in COLUMNS:
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in rows(evaluation):
        table.add_row(*row)
    return table


def _overview(report: EvaluationReport) -> Table:
    """The figures that matter most, of all policies, and how much they differ from the first's."""
    table = _table()
    table.add_column("", overflow="fold")
    for name in _AT_A_GLANCE:
        table.add_column(TITLES[name].replace(" ", "\n", 1), justify="right", no_wrap=True)
    for scenario in dict.fromkeys(evaluation.scenario for evaluation in report.evaluations):
        here = [evaluation for evaluation in report.evaluations if evaluation.scenario == scenario]
        differences = [comparison for comparison in report.comparisons if comparison.scenario == scenario]
        table.add_section()
        table.add_row(f"[bold]in {escape(scenario)}")
        for evaluation in here:
            _add(table, evaluation.policy, {name: getattr(evaluation, name) for name in _AT_A_GLANCE})
        if differences:
            table.add_row(f"[bold]less {escape(differences[0].baseline)}")
        for comparison in differences:
            _add(table, comparison.policy, comparison.differences, "+")
    return table


def _table() -> Table:
    return Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))


def _add(table: Table, policy: str, figures: Mapping[str, Figure], sign: Literal["", "+"] = "") -> None:
    cells = []
    for name in _AT_A_GLANCE:
        mean, interval = mean_and_interval(name, figures[name], sign)
        cells.append(f"{mean}\n[dim]{interval.replace(' to ', '..')}[/dim]")  # four of them in 80 columns
    table.add_row(f" {escape(policy)}", *cells)


def _missions(evaluation: Evaluation) -> str:
    first, n = evaluation.seeds
    return f"{n} missions, seeds {first} to {first + n - 1}"
