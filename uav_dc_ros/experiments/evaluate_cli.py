"""The command line of `python -m uav_dc_ros.evaluate`."""

from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table

from uav_dc_ros import cli, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.errors import UavDcError
from uav_dc_ros.experiments.evaluate import Evaluation, judge, rows, save_mission_picture, steer
from uav_dc_ros.planners import PLANNERS

PROG = "python -m uav_dc_ros.evaluate"


def main(argv: list[str] | None = None) -> None:
    """Runs the command line, and exits."""
    parser = cli.Parser(prog=PROG, description="Fly policies over many missions and show how they do.")
    parser.add_argument(
        "--policy",
        nargs="+",
        required=True,
        metavar="NAME|DIR",
        help=f"shipped: {', '.join(policies.names())}; to compare with: {', '.join(PLANNERS)}",
    )
    parser.add_argument(
        "--scenario",
        metavar="NAME|FILE",
        help=f"shipped: {', '.join(scenarios.names())}; default: by the name of the policy's own",
    )
    parser.add_argument("--seeds", type=cli.count, default=100, metavar="N", help="missions, seeds 0 to N-1")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures, a list")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the mission with seed 0")
    options = parser.parse_args(argv)

    def command() -> int:
        if options.picture and len(options.policy) > 1:
            raise UavDcError(f"--picture with {len(options.policy)} policies; expected one policy")
        results = []
        for name in options.policy:
            if name in PLANNERS:
                if not options.scenario:
                    raise UavDcError(
                        f"--policy {name}: a planner has no scenario of its own; expected --scenario"
                    )
                scenario, sha256 = scenarios.load(options.scenario), None
                act = PLANNERS[name](scenario)
            else:
                policy = policies.load(name)
                scenario, sha256 = scenarios.load(options.scenario or policy.scenario.name), policy.sha256
                act, name = steer(policy, scenario), policy.name
            results.append(judge(name, sha256, act, scenario, range(options.seeds)))
            if options.picture:
                save_mission_picture(act, scenario, 0, options.picture)
        for result in results:
            show(result)
        if options.json:
            cli.write_whole(options.json, msgspec.json.format(msgspec.json.encode(results), indent=2) + b"\n")
        return 0

    cli.run(command, PROG)


def show(result: Evaluation) -> None:
    """Prints one evaluation as a table."""
    first, n = result.seeds
    table = Table(
        title=f"{result.policy} in {result.scenario}, {n} missions, seeds {first} to {first + n - 1}, "
        f"{result.users_total} users",
        title_justify="left",
    )
    table.add_column("")
    for title in ("mean", "min", "max"):
        table.add_column(title, justify="right")
    for row in rows(result):
        table.add_row(*row)
    Console().print(table)
