"""List, show and check scenarios.

python -m uav_dc_ros.scenario check my_field.toml
"""

from typing import TYPE_CHECKING, NoReturn

from uav_dc_ros import cli

if TYPE_CHECKING:
    from uav_dc_ros.core.scenario import Scenario

PROG = "python -m uav_dc_ros.scenario"


def parser() -> cli.Parser:
    """The command line."""
    options = cli.Parser(prog=PROG, description="List, show and check scenarios.")
    verbs = options.add_subparsers(dest="verb", required=True, metavar="VERB")
    verbs.add_parser("list", help="the shipped scenarios", description="The shipped scenarios.")
    show = verbs.add_parser("show", help="a scenario as TOML", description="A scenario as TOML.")
    show.add_argument("scenario", metavar="NAME|FILE")
    check = "check that a scenario is valid, and list the policies that fit"
    verbs.add_parser("check", help=check, description=f"{check.capitalize()}.").add_argument(
        "scenario", metavar="FILE|NAME"
    )
    return options


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command, and exit."""

    def command() -> int:
        options = parser().parse_args(arguments)
        from uav_dc_ros import scenarios
        from uav_dc_ros.agents import policy as policies
        from uav_dc_ros.errors import PolicyError
        from uav_dc_ros.scenarios import problems

        if options.verb == "list":
            for name in scenarios.names():
                print(f"{name}: {_description(scenarios.load(name))}")
            return 0
        if options.verb == "show":
            scenarios.load(options.scenario)
            print(scenarios.find(options.scenario).read_text("utf-8"), end="")
            return 0
        scenario, found = problems.find(scenarios.read(options.scenario))
        for problem in found:
            cli.print_error(problem.within(options.scenario))
        if scenario is None:
            return cli.FAILED
        print(f"{options.scenario}: {_description(scenario)}")
        fitting = []
        for name in policies.names():
            try:
                policies.load(name).check(scenario)
            except PolicyError:
                continue
            fitting.append(name)
        print(f"shipped policies that fit: {', '.join(fitting) or '(none): train one'}")
        return 0

    cli.run(command, PROG)


def _description(scenario: "Scenario") -> str:
    from uav_dc_ros.core import channel

    grid, mission = scenario.grid, scenario.mission
    return (
        f"{scenario.n_users} users in {scenario.n_clusters} clusters, "
        f"{grid.n_x} x {grid.n_y} x {grid.n_z} cells of {grid.cell_m:g} m, "
        f"{mission.max_steps} steps of {mission.step_s:g} s, channel {channel.title(scenario.radio)}, "
        f"fingerprint {scenario.fingerprint}"
    )


if __name__ == "__main__":
    main()
