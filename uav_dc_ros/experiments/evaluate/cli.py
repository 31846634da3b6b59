"""The command line of `python -m uav_dc_ros.evaluate`."""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import UNSET, UnsetType
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.agents.agent import Agent
from uav_dc_ros.core.objective import DEFAULT_WEIGHT, EXPECTED_WEIGHT
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act
from uav_dc_ros.errors import PolicyError, UavDcError
from uav_dc_ros.experiments.evaluate.evaluation import (
    COLUMNS,
    ONE_MISSION,
    TITLES,
    Comparison,
    EvaluatedMissions,
    Evaluation,
    EvaluationReport,
    Figure,
    ShiftEffect,
    compare,
    evaluate_act,
    mean_and_interval,
    rows,
    save_mission_picture,
    shift_effect,
)
from uav_dc_ros.experiments.evaluate.fields import evaluate_fields, show_fields
from uav_dc_ros.experiments.evaluate.shifts import (
    NO_KEYS,
    Shift,
    ShiftedWorld,
    ShiftRequest,
    apply,
    parse,
)
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.run_config import SEARCH_MAX

PROG = "python -m uav_dc_ros.evaluate"

# Figures of the overview, and of the table of shifts.
_MAIN_FIGURES = ("objective", "landing_rate", "users_collected", "arrival_step")
_SHIFT_FIGURES = ("objective", "users_collected", "data_bits", "landing_rate", "arrival_step")


def main(argv: list[str] | None = None) -> None:
    """Run the command, and exit."""
    description = "Fly policies over many missions, and show and compare their performance."
    parser = cli.Parser(prog=PROG, description=description)
    add = parser.add_argument
    text = f"shipped: {', '.join(policies.names())}; planners: {', '.join(PLANNERS)}; "
    text += "all are compared with the first"
    add("--policy", nargs="+", required=True, metavar="NAME|DIR", help=text)
    text = f"every policy flies in each; shipped: {', '.join(scenarios.names())}; "
    text += "default: by the name of the policy's own"
    add("--scenario", nargs="+", default=[], metavar="NAME|FILE|random:SEED", help=text)
    add("--seeds", type=cli.count, metavar="N", help="missions, seeds 0 to N-1; default 100, of --fields 10")
    text = "missions that a policy flies in a model before each move, see docs/planners.md; several: each "
    text += "policy flies with each, and 0 is without; planners fly as they are; default 0"
    number = cli.whole_number(0, SEARCH_MAX, f"a whole number from 0 to {SEARCH_MAX}")
    add("--search", type=number, nargs="+", default=[0], metavar="N", help=text)
    text = "instead of --scenario: the random fields of seeds 0 to N-1 (random:SEED), compared field by field"
    add("--fields", type=cli.count, metavar="N", help=text)
    text = "w of the objective J, which tour and search maximise: 1 counts the users only, 0 the time only; "
    text += "default 10/11"
    weight = cli.number(0.0, 1.0, EXPECTED_WEIGHT)
    add("--objective", type=weight, default=DEFAULT_WEIGHT, metavar="W", help=text)
    add("--json", type=Path, metavar="FILE", help="write evaluations and comparisons")
    add("--picture", type=Path, metavar="FILE.png", help="draw the mission with seed 0")
    text = "fly also with values of the scenario changed: KEY=+DELTA, KEY=-DELTA, KEY=xFACTOR, KEY=VALUE, "
    text += "users.missing=SHARE%% for users that send nothing, users.position_error=SHARE%% of the distance "
    text += "between clusters, or grid.cells=xN for a finer grid; several with ',' between; may be repeated"
    add("--shift", type=parse, action="append", default=[], metavar="KEY=CHANGE[,...]", help=text)

    def command() -> int:
        options = parser.parse_args(argv)
        _check_once("--shift", [request.text for request in options.shift])
        if options.fields:
            return _fly_in_fields(options)
        pairs = _pairs(candidates(options.policy, options.search), options.scenario)
        flights = [flight for pair in pairs for flight in _flights(*pair, options.shift, options.objective)]
        if options.picture and len(flights) > 1:
            raise UavDcError(
                f"--picture of {len(flights)} evaluations; expected one policy, one scenario, no --shift"
            )
        for path in filter(None, (options.json, options.picture)):
            files.check_writable(path)
        if options.picture:
            candidate, scenario = pairs[0]
            save_mission_picture(candidate.act_in(scenario, options.objective), scenario, 0, options.picture)

        seeds = range(options.seeds or 100)
        for name in dict.fromkeys(scenario.name for _, scenario in pairs if not scenario.is_random):
            if len(seeds) > 1:
                cli.print_error(f"{PROG}: {name}: {ONE_MISSION}; --seeds 1 is enough")
        evaluated = [
            evaluate_act(one.name, one.sha256, act, world.scenario, seeds, world.shift, options.objective)
            for one, world, act in flights
        ]
        report = _report(evaluated)
        if options.json:
            files.write(options.json, msgspec.json.format(msgspec.json.encode(report), indent=2) + b"\n")
        show(report)
        return 0

    cli.run(command, PROG)


def _check_once(option: str, values: Sequence[str]) -> None:
    for value in values:
        if values.count(value) > 1:
            raise UavDcError(f"{option} {value} is given {values.count(value)} times; expected once")


def _fly_in_fields(options: argparse.Namespace) -> int:
    for name in ("scenario", "shift", "picture"):
        if getattr(options, name):
            raise UavDcError(f"--fields {options.fields} beside --{name}; expected one or the other")
    if options.json:
        files.check_writable(options.json)
    seeds = range(options.seeds or 10)
    report = evaluate_fields(
        candidates(options.policy, options.search), options.fields, seeds, options.objective
    )
    if options.json:
        files.write(options.json, msgspec.json.format(msgspec.json.encode(report), indent=2) + b"\n")
    show_fields(report, _console(), _table())
    return 0


def _pairs(flown: Sequence[Agent], scenario_names: Sequence[str]) -> list[tuple[Agent, Scenario]]:
    """Agents and scenarios in the order of the results: every policy in each scenario, or in its own."""
    _check_once("--scenario", scenario_names)
    if scenario_names:
        worlds = [scenarios.load(value) for value in scenario_names]
        names = [world.name for world in worlds]
        if len(set(names)) < len(names):
            raise UavDcError(
                f"--scenario {' '.join(scenario_names)}: their names are {', '.join(names)}; "
                "expected different ones"
            )
        return [(candidate, world) for world in worlds for candidate in flown]
    pairs = []
    for candidate in flown:
        if candidate.home is None:
            raise UavDcError(
                f"--policy {candidate.name}: a planner has no scenario of its own; expected --scenario"
            )
        pairs.append((candidate, scenarios.load(candidate.home.name)))
    return pairs


def _flights(
    candidate: Agent, scenario: Scenario, shifts: Sequence[ShiftRequest], weight: float
) -> Iterator[tuple[Agent, ShiftedWorld, Act]]:
    """A candidate in the scenario as it is and in each shifted world, with its actions there."""
    yield candidate, ShiftedWorld(scenario, scenario), candidate.act_in(scenario, weight)
    for request in shifts:
        world = apply(request, scenario)
        try:
            act = candidate.act_in(world.known, weight)
        except PolicyError as error:
            raise PolicyError(f"--shift {request.text}: {error}") from None
        yield candidate, world, act


def _report(evaluated: Sequence[EvaluatedMissions]) -> EvaluationReport:
    """All evaluations, compared with the first policy's in the same world and with the unshifted ones."""
    first: dict[tuple[str, str | UnsetType], EvaluatedMissions] = {}  # by scenario and shift
    unshifted = evaluated[0]
    comparisons, effects = [], []
    for one in evaluated:
        evaluation = one.evaluation
        text = UNSET if evaluation.shift is UNSET else evaluation.shift.text
        if text is UNSET:
            unshifted = one
        else:
            effects.append(shift_effect(one, unshifted))
        baseline = first.setdefault((evaluation.scenario, text), one)
        if one is not baseline:
            comparisons.append(compare(one, baseline))
    evaluations = [one.evaluation for one in evaluated]
    return EvaluationReport(evaluations=evaluations, comparisons=comparisons, shifts=effects or UNSET)


def candidates(names: Sequence[str], searches: Sequence[int] = (0,)) -> list[Agent]:
    """The policies of `--policy`, each with each search, and the planners.

    Those of one name are named by their arguments, and those that search by the number of missions, too.
    Raises UavDcError for a name or a search that occurs twice, and for a search without a policy; and
    PolicyError for a policy that cannot be loaded.
    """
    _check_once("--policy", names)
    _check_once("--search", list(map(str, searches)))
    found = [agents.load(value) for value in names]
    loaded = [one.name for one in found]
    if any(searches) and not any(one.policy for one in found):
        raise UavDcError(
            f"--search {max(searches)}: {', '.join(loaded)}: planners only; expected a policy in --policy"
        )
    named = [
        replace(one, name=value) if loaded.count(one.name) > 1 else one
        for one, value in zip(found, names, strict=True)
    ]
    return [
        replace(one, name=f"{one.name}, search {n}", search=n) if n else one
        for one in named
        for n in (searches if one.policy else (0,))
    ]


def show(report: EvaluationReport) -> None:
    """Print a table for each evaluation without a shift, an overview of several, and the shifts."""
    console = _console()
    evaluations = [one for one in report.evaluations if one.shift is UNSET]
    for evaluation in evaluations:
        title = f"{_where(evaluation)}, {_missions(evaluation)}"
        console.print(title, style="bold", markup=False, soft_wrap=True)
        table = _table()
        for column in COLUMNS:
            table.add_column(column, justify="right" if column else "left", no_wrap=True)
        for row in rows(evaluation):
            table.add_row(*row)
        console.print(table, "")
    if len(report.evaluations) == 1:
        return
    title = f"Means and their 95% bootstrap intervals, {_missions(evaluations[0])}"
    console.print(title, style="bold", soft_wrap=True)
    if len(evaluations) > 1:
        console.print(_overview(evaluations, report.comparisons), "")
    for evaluation in evaluations if report.shifts else ():
        own = (evaluation.policy, evaluation.scenario)
        worlds = [one for one in report.evaluations if (one.policy, one.scenario) == own]
        effects = [one for one in report.shifts or () if (one.policy, one.scenario) == own]
        console.print(_where(evaluation), style="bold", markup=False, soft_wrap=True)
        for i, one in enumerate(worlds):
            text = "as it is" if one.shift is UNSET else _changes(one.shift)
            console.print(f" {i}  {text}", markup=False, soft_wrap=True)
        console.print(_shifts(worlds, effects), "")
    console.print("Arrival: over missions that landed; its difference: over those in which both did.")


def _overview(evaluations: Sequence[Evaluation], comparisons: Sequence[Comparison]) -> Table:
    """The main figures of all policies, and their differences from the first policy's."""
    table = _figures_table(_MAIN_FIGURES)
    for scenario in dict.fromkeys(evaluation.scenario for evaluation in evaluations):
        compared = [one for one in comparisons if one.scenario == scenario and one.shift is UNSET]
        table.add_section()
        table.add_row(f"[bold]in {escape(scenario)}")
        for evaluation in evaluations:
            if evaluation.scenario == scenario:
                _add(table, escape(evaluation.policy), _MAIN_FIGURES, _figures(evaluation))
        if compared:
            table.add_row(f"[bold]less {escape(compared[0].baseline)}")
        for comparison in compared:
            _add(table, escape(comparison.policy), _MAIN_FIGURES, comparison.differences, "+")
    return table


def _shifts(worlds: Sequence[Evaluation], effects: Sequence[ShiftEffect]) -> Table:
    """A policy in a scenario as it is and in the shifted worlds, by number, and the differences."""
    table = _figures_table(_SHIFT_FIGURES)
    for i, evaluation in enumerate(worlds):
        _add(table, str(i), _SHIFT_FIGURES, _figures(evaluation))
    table.add_section()
    for i, effect in enumerate(effects, start=1):
        _add(table, f"{i} - 0", _SHIFT_FIGURES, effect.differences, "+")
    return table


def _changes(shift: Shift) -> str:
    """A shift, with the numbers before and after each change."""
    numbers = [
        "" if value.key in NO_KEYS or isinstance(value.after, list) else f" ({value.before} -> {value.after})"
        for value in shift.values
    ]
    texts = shift.text.split(",")
    return ", ".join(text.strip() + more for text, more in zip(texts, numbers, strict=True))


def _figures(evaluation: Evaluation) -> dict[str, Figure]:
    return {name: getattr(evaluation, name) for name in {*_MAIN_FIGURES, *_SHIFT_FIGURES}}


def _figures_table(names: Sequence[str]) -> Table:
    table = _table()
    table.add_column("", overflow="fold")
    for name in names:
        table.add_column(TITLES[name].replace(" ", "\n", 1), justify="right", no_wrap=True)
    return table


def _console() -> Console:
    # A file or a pipe has no width; rich wraps at 80 by default.
    return Console(width=None if sys.stdout.isatty() else 100, highlight=False)


def _table() -> Table:
    return Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))


def _add(
    table: Table,
    title: str,
    names: Sequence[str],
    figures: Mapping[str, Figure],
    sign: Literal["", "+"] = "",
) -> None:
    cells = []
    for name in names:
        mean, interval = mean_and_interval(name, figures[name], sign)
        cells.append(f"{mean}\n[dim]{interval.replace(' to ', '..')}[/dim]")  # four of them in 80 columns
    table.add_row(f" {title}", *cells)


def _where(evaluation: Evaluation) -> str:
    return f"{evaluation.policy} in {evaluation.scenario}, {evaluation.users_total} users"


def _missions(evaluation: Evaluation) -> str:
    first, n = evaluation.seeds
    return f"{n} missions, seeds {first} to {first + n - 1}" if n > 1 else f"1 mission, seed {first}"
