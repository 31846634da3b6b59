"""The command line of `python -m uav_dc_ros.optimum`."""

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from uav_dc_ros import __version__, cli, files, scenarios
from uav_dc_ros.agents.agent import Agent
from uav_dc_ros.core.objective import DEFAULT_WEIGHT, EXPECTED_WEIGHT
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import FROM_TRAIN, UavDcError
from uav_dc_ros.experiments.evaluate.cli import candidates
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.experiments.optimum.mip import solve_program
from uav_dc_ros.experiments.optimum.problem import ClairvoyantProblem
from uav_dc_ros.experiments.optimum.solve import DIAGRAM_WIDTHS, Solution, as_flown, solve

PROG = "python -m uav_dc_ros.optimum"
FRONT_WEIGHTS = tuple(i / 10 for i in range(11))


class BestMission(msgspec.Struct, frozen=True, kw_only=True):
    """The best mission that was found for a seed, and the bound."""

    seed: int
    objective: float  # J of the mission
    # No mission of this seed has a greater J; the mission is the best one where both are equal.
    bound: float
    is_optimal: bool
    stopped: bool  # the time limit ended the search
    users_collected: int
    arrival_step: int  # 0: it does not land
    data_bits: float  # collected in the mission, bit
    actions: list[int]  # of the mission, see `core.grid.Action`


class Standing(msgspec.Struct, frozen=True, kw_only=True):
    """A policy or planner in the same missions."""

    # policy, sha256: name, and hash of config and model; no hash for a planner
    policy: str
    sha256: str | None
    objective: float  # mean J
    share_of_bound: float  # mean J, over the mean bound
    users_collected: float  # mean
    arrival_step: float | None  # mean over the missions that landed; null where none did
    objectives: list[float]  # J by seed


class OptimumReport(msgspec.Struct, frozen=True, kw_only=True):
    """The content of a file of `python -m uav_dc_ros.optimum --json`."""

    # scenario, fingerprint: name, and hash of the world's values
    scenario: str
    fingerprint: str
    version: str  # of the package
    objective_weight: float  # w in J
    seeds: tuple[int, int]  # first seed and number of seeds
    users_total: int  # users in the field
    max_steps: int  # T_cons
    # objective, bound: means over the seeds
    objective: float
    bound: float
    n_optimal: int  # missions that are proved to be the best
    missions: list[BestMission]
    policies: list[Standing]


def parser() -> cli.Parser:
    """The command line."""
    options = cli.Parser(
        prog=PROG, description="The best missions of a planner that knows the walks, and bounds."
    )
    add = options.add_argument
    add("--scenario", required=True, metavar="NAME|FILE", help=f"shipped: {', '.join(scenarios.names())}")
    add("--seeds", type=cli.count, default=20, metavar="N", help="missions, seeds 0 to N-1; default 20")
    limit = cli.number(0.0, math.inf, "seconds, at least 0")
    add("--time-limit", type=limit, default=math.inf, metavar="S", help="seconds for a seed; default: none")
    weight = cli.number(0.0, 1.0, EXPECTED_WEIGHT)
    text = "w of the objective J: 1 counts the users only, 0 the time only; default 10/11"
    add("--objective", type=weight, default=DEFAULT_WEIGHT, metavar="W", help=text)
    text = "partial missions that a decision diagram holds at most: more take longer and bound better"
    add("--width", type=cli.count, default=DIAGRAM_WIDTHS[-1], metavar="N", help=text)
    add("--method", choices=("diagram", "mip"), default="diagram", help="mip: HiGHS, for small worlds")
    add("--policy", nargs="+", default=[], metavar="NAME|DIR", help="how far these are from the bound")
    add("--json", type=Path, metavar="FILE", help="write the missions, bounds and policies")
    add("--front", type=Path, metavar="FILE.png", help="draw users against arrival for weights from 0 to 1")
    return options


def main(argv: list[str] | None = None) -> None:
    """Run the command, and exit."""

    def command() -> int:
        options = parser().parse_args(argv)
        scenario = scenarios.load(options.scenario)
        flown = candidates(options.policy)
        for one in flown:
            one.act_in(scenario, options.objective)  # an error now, and not after the search
        for path in filter(None, (options.json, options.front)):
            files.check_writable(path)
        widths = (*(width for width in DIAGRAM_WIDTHS if width < options.width), options.width)

        def best(weight: float) -> list[Solution]:
            found = []
            for seed in range(options.seeds):
                problem = ClairvoyantProblem(scenario, seed)
                if options.method == "mip":
                    program = solve_program(problem, weight, options.time_limit)
                    found.append(as_flown(problem, program.actions, weight, program.bound, program.stopped))
                else:
                    found.append(solve(problem, weight, options.time_limit, widths))
            return found

        report = report_of(scenario, options.objective, best(options.objective), flown)
        show(report)
        if options.json:
            files.write(options.json, msgspec.json.format(msgspec.json.encode(report), indent=2) + b"\n")
        if options.front:
            try:
                from uav_dc_ros.experiments.optimum.front import draw_front  # needs matplotlib
            except ModuleNotFoundError:
                raise UavDcError(f"matplotlib {FROM_TRAIN}") from None
            draw_front([report_of(scenario, w, best(w), flown) for w in FRONT_WEIGHTS], options.front)
        return 0

    cli.run(command, PROG)


def report_of(
    scenario: Scenario, weight: float, found: Sequence[Solution], flown: Sequence[Agent]
) -> OptimumReport:
    """The report of solutions, one for each seed from 0, and of policies in the same missions."""
    missions = [
        BestMission(
            seed=seed,
            objective=one.objective,
            bound=one.bound,
            is_optimal=one.is_optimal,
            stopped=one.stopped,
            users_collected=one.users_collected,
            arrival_step=one.arrival_step,
            data_bits=one.data_bits,
            actions=[int(action) for action in one.actions],
        )
        for seed, one in enumerate(found)
    ]
    bound = float(np.mean([one.bound for one in found]))
    return OptimumReport(
        scenario=scenario.name,
        fingerprint=scenario.fingerprint,
        version=__version__,
        objective_weight=weight,
        seeds=(0, len(found)),
        users_total=scenario.n_users,
        max_steps=scenario.mission.max_steps,
        objective=float(np.mean([one.objective for one in found])),
        bound=bound,
        n_optimal=sum(one.is_optimal for one in found),
        missions=missions,
        policies=[_standing(one, scenario, weight, range(len(found)), bound) for one in flown],
    )


def _standing(one: Agent, scenario: Scenario, weight: float, seeds: range, bound: float) -> Standing:
    missions = roll_out(scenario, one.act_in(scenario, weight), seeds, service=False)
    values = missions.objective(scenario, weight)
    arrivals = missions.arrival_step[missions.landed]
    return Standing(
        policy=one.name,
        sha256=one.sha256,
        objective=float(values.mean()),
        share_of_bound=float(values.mean()) / bound,
        users_collected=float(missions.users_collected.mean()),
        arrival_step=float(arrivals.mean()) if arrivals.size else None,
        objectives=values.tolist(),
    )


def show(report: OptimumReport) -> None:
    """Print a table of the missions, and one of the policies."""
    console = Console(width=None if sys.stdout.isatty() else 100, highlight=False)
    title = f"{report.scenario}, {report.users_total} users, {report.max_steps} steps, objective J with w = "
    console.print(f"{title}{report.objective_weight:.3g}", style="bold", markup=False, soft_wrap=True)
    table = _table("seed", "users", "data, Mbit", "arrival step", "J", "bound", "gap")
    for one in report.missions:
        gap = "optimal" if one.is_optimal else f"{one.bound - one.objective:.4f}"
        table.add_row(
            str(one.seed),
            str(one.users_collected),
            f"{one.data_bits / 1e6:.1f}",
            str(one.arrival_step) if one.arrival_step else "-",
            f"{one.objective:.4f}",
            f"{one.bound:.4f}" + "*" * one.stopped,
            gap,
        )
    table.add_section()
    means = [
        float(np.mean([getattr(one, name) for one in report.missions]))
        for name in ("users_collected", "data_bits", "arrival_step")
    ]
    table.add_row(
        "mean",
        f"{means[0]:.1f}",
        f"{means[1] / 1e6:.1f}",
        f"{means[2]:.1f}",
        f"{report.objective:.4f}",
        f"{report.bound:.4f}",
        f"{report.bound - report.objective:.4f}",
    )
    console.print(table)
    console.print(f"{report.n_optimal} of {len(report.missions)} missions are proved to be the best.")
    if any(one.stopped for one in report.missions):
        console.print("*: the time limit ended the search; another machine may find another bound.")
    if report.policies:
        table = _table("", "users", "arrival step", "J", "share of the bound")
        for standing in report.policies:
            arrival = "-" if standing.arrival_step is None else f"{standing.arrival_step:.1f}"
            share = f"{100.0 * standing.share_of_bound:.1f}%"
            table.add_row(
                standing.policy,
                f"{standing.users_collected:.1f}",
                arrival,
                f"{standing.objective:.4f}",
                share,
            )
        console.print("", table)


def _table(*columns: str) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for i, column in enumerate(columns):
        table.add_column(column, justify="right" if i else "left", no_wrap=True)
    return table
