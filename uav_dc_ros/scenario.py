"""Make, check and draw scenarios.

python -m uav_dc_ros.scenario new my_field.toml
python -m uav_dc_ros.scenario check my_field.toml
"""

from typing import NoReturn

from uav_dc_ros import cli

PROG = "python -m uav_dc_ros.scenario"


def parser() -> cli.Parser:
    """The command line."""
    from uav_dc_ros.experiments.scenarios import check, draw, listing, make

    options = cli.Parser(prog=PROG, description="Make, check and draw scenarios.")
    verbs = options.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, help: str) -> cli.Parser:
        return verbs.add_parser(name, help=help, description=f"{help[0].upper()}{help[1:]}.")

    verb("list", "the shipped scenarios").set_defaults(run=listing.run)
    shown = verb("show", "print a scenario's file")
    shown.add_argument("scenario", metavar="NAME|FILE|random:SEED")
    shown.set_defaults(run=listing.show)
    make.add_new(verb("new", "write a scenario with a comment for each key"))
    make.add_random(verb("random", "write a scenario of a random field that can be flown"))
    make.add_import(verb("import", "write a scenario around the users of a file"))
    check.add_options(verb("check", "check that a scenario can be flown, and list the policies that fit"))
    draw.add_options(verb("draw", "draw a scenario: users, what is in reach, and rates"))
    return options


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command, and exit."""

    def command() -> int:
        options = parser().parse_args(arguments)
        return int(options.run(options))

    cli.run(command, PROG)


if __name__ == "__main__":
    main()
