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
from uav_dc_ros.core.world import Act
from uav_dc_ros.errors import UavDcError
from uav_dc_ros.experiments.evaluate.evaluation import (
    COLUMNS,
    TITLES,
    EvaluatedMissions,
    Evaluation,
    EvaluationReport,
    Figure,
    compare,
    evaluate_act,
    greedy_act,
    mean_and_interval,
    rows,
    save_mission_picture,
)
from uav_dc_ros.planners import PLANNERS

PROG = "python -m uav_dc_ros.evaluate"

# Figures of the overview.
_MAIN_FIGURES = ("landing_rate", "users_collected", "arrival_step", "sum_rate_bps")


class Candidate(NamedTuple):
    """A policy or a planner to evaluate."""

    name: str  # in the results
    sha256: str | None  # of a policy's config and model
    home: str | None  # name of the scenario that a policy was trained in
    act_in: Callable[[Scenario], Act]  # raises PolicyError where the policy does not fit


def main(argv: list[str] | None = None) -> None:
    """Run the command, and exit."""
    description = "Fly policies over many missions, and show and compare their performance."
    parser = cli.Parser(prog=PROG, description=description)
    add = parser.add_argument
    text = f"shipped: {', '.join(policies.names())}; baselines: {', '.join(PLANNERS)}; "
    text += "all are compared with the first"
    add("--policy", nargs="+", required=True, metavar="NAME|DIR", help=text)
    text = f"every policy flies in each; shipped: {', '.join(scenarios.names())}; "
    text += "default: by the name of the policy's own"
    add("--scenario", nargs="+", default=[], metavar="NAME|FILE", help=text)
    add("--seeds", type=cli.count, default=100, metavar="N", help="missions, seeds 0 to N-1")
    add("--json", type=Path, metavar="FILE", help="write evaluations and comparisons")
    add("--picture", type=Path, metavar="FILE.png", help="draw the mission with seed 0")

    def command() -> int:
        options = parser.parse_args(argv)
        pairs = _pairs(options.policy, options.scenario)
        acts = [candidate.act_in(scenario) for candidate, scenario in pairs]
        if options.picture and len(pairs) > 1:
            raise UavDcError(f"--picture of {len(pairs)} evaluations; expected one policy in one scenario")
        for path in filter(None, (options.json, options.picture)):
            files.check_writable(path)
        if options.picture:
            candidate, scenario = pairs[0]
            save_mission_picture(candidate.act_in(scenario), scenario, 0, options.picture)

        evaluated = [
            evaluate_act(candidate.name, candidate.sha256, act, scenario, range(options.seeds))
            for (candidate, scenario), act in zip(pairs, acts, strict=True)
        ]
        first: dict[str, EvaluatedMissions] = {}  # in each scenario
        comparisons = []
        for one in evaluated:
            baseline = first.setdefault(one.evaluation.fingerprint, one)
            if one is not baseline:
                comparisons.append(compare(one, baseline))
        report = EvaluationReport(evaluations=[one.evaluation for one in evaluated], comparisons=comparisons)
        if options.json:
            files.write(options.json, msgspec.json.format(msgspec.json.encode(report), indent=2) + b"\n")
        show(report)
        return 0

    cli.run(command, PROG)


def _pairs(policy_names: Sequence[str], scenario_names: Sequence[str]) -> list[tuple[Candidate, Scenario]]:
    """Candidates and scenarios in the order of the results: every policy in each scenario, or in its own."""
    for option, values in (("--policy", policy_names), ("--scenario", scenario_names)):
        for value in values:
            if values.count(value) > 1:
                raise UavDcError(f"{option} {value} is given {values.count(value)} times; expected once")
    candidates = [_candidate(value) for value in policy_names]
    names = [candidate.name for candidate in candidates]
    candidates = [  # equal names are replaced by the arguments, which differ
        candidate._replace(name=value) if names.count(candidate.name) > 1 else candidate
        for candidate, value in zip(candidates, policy_names, strict=True)
    ]
    if scenario_names:
        worlds = [scenarios.load(value) for value in scenario_names]
        names = [world.name for world in worlds]
        if len(set(names)) < len(names):
            raise UavDcError(
                f"--scenario {' '.join(scenario_names)}: their names are {', '.join(names)}; "
                "expected different ones"
            )
        return [(candidate, world) for world in worlds for candidate in candidates]
    pairs = []
    for candidate in candidates:
        if candidate.home is None:
            raise UavDcError(
                f"--policy {candidate.name}: a planner has no scenario of its own; expected --scenario"
            )
        pairs.append((candidate, scenarios.load(candidate.home)))
    return pairs


def _candidate(value: str) -> Candidate:
    if value in PLANNERS:
        return Candidate(value, None, None, PLANNERS[value])
    policy = policies.load(value)
    return Candidate(policy.name, policy.sha256, policy.scenario.name, partial(greedy_act, policy))


def show(report: EvaluationReport) -> None:
    """Print a table for each evaluation, and an overview of several."""
    # A file or a pipe has no width; rich wraps at 80 by default.
    console = Console(width=None if sys.stdout.isatty() else 100, highlight=False)
    for evaluation in report.evaluations:
        where = f"{evaluation.scenario}, {evaluation.users_total} users"
        title = f"{evaluation.policy} in {where}, {_missions(evaluation)}"
        console.print(title, style="bold", markup=False, soft_wrap=True)
        table = _table()
        for column in COLUMNS:
            table.add_column(column, justify="right" if column else "left", no_wrap=True)
        for row in rows(evaluation):
            table.add_row(*row)
        console.print(table, "")
    if len(report.evaluations) > 1:
        title = f"Means and their 95% bootstrap intervals, {_missions(report.evaluations[0])}"
        console.print(title, style="bold", soft_wrap=True)
        console.print(_overview(report))
        console.print("Arrival: over missions that landed; its difference: over those in which both did.")


def _overview(report: EvaluationReport) -> Table:
    """The main figures of all policies, and their differences from the first policy's."""
    table = _table()
    table.add_column("", overflow="fold")
    for name in _MAIN_FIGURES:
        table.add_column(TITLES[name].replace(" ", "\n", 1), justify="right", no_wrap=True)
    for scenario in dict.fromkeys(evaluation.scenario for evaluation in report.evaluations):
        differences = [comparison for comparison in report.comparisons if comparison.scenario == scenario]
        table.add_section()
        table.add_row(f"[bold]in {escape(scenario)}")
        for evaluation in report.evaluations:
            if evaluation.scenario == scenario:
                _add(table, evaluation.policy, {name: getattr(evaluation, name) for name in _MAIN_FIGURES})
        if differences:
            table.add_row(f"[bold]less {escape(differences[0].baseline)}")
        for comparison in differences:
            _add(table, comparison.policy, comparison.differences, "+")
    return table


def _table() -> Table:
    return Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))


def _add(table: Table, policy: str, figures: Mapping[str, Figure], sign: Literal["", "+"] = "") -> None:
    cells = []
    for name in _MAIN_FIGURES:
        mean, interval = mean_and_interval(name, figures[name], sign)
        cells.append(f"{mean}\n[dim]{interval.replace(' to ', '..')}[/dim]")  # four of them in 80 columns
    table.add_row(f" {escape(policy)}", *cells)


def _missions(evaluation: Evaluation) -> str:
    first, n = evaluation.seeds
    return f"{n} missions, seeds {first} to {first + n - 1}"
