"""`uav-dc`: one command for all; each verb is also a command of its own, `python -m uav_dc_ros.NAME`."""

import importlib
import sys
from typing import NoReturn

from uav_dc_ros import __version__, cli
from uav_dc_ros.errors import ParameterError

PROG = "uav-dc"
DESCRIPTION = "Fly, train, evaluate and study a UAV that collects data from IoT users."
# Module of each verb, with `main(arguments)`, and what it does.
VERBS = {
    "fly": ("uav_dc_ros.run_all", "fly recorded missions with a trained policy, on ROS 2"),
    "train": ("uav_dc_ros.experiments.train.cli", "train a policy for a scenario"),
    "evaluate": ("uav_dc_ros.experiments.evaluate.cli", "fly policies over many missions, and compare them"),
    "paper": ("uav_dc_ros.experiments.paper.cli", "reproduce every figure of the paper, and test its claims"),
    "bag": ("uav_dc_ros.bag", "record, play, recover, verify and explain bags"),
    "scenario": ("uav_dc_ros.scenario", "list, show and check scenarios"),
}


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command, and exit."""
    given = sys.argv[1:] if arguments is None else arguments
    wanted = given[0] if given else "--help"
    if wanted in VERBS:
        module, _ = VERBS[wanted]
        importlib.import_module(module).main(given[1:])
        raise SystemExit(0)

    def command() -> int:
        if wanted == "--version":
            print(__version__)
        elif wanted in ("-h", "--help"):
            print(_help())
        else:
            raise ParameterError(f"{wanted!r}; expected a verb: {', '.join(VERBS)}")
        return 0

    cli.run(command, PROG)


def _help() -> str:
    verbs = "\n".join(f"  {verb:<10} {does}" for verb, (_, does) in VERBS.items())
    return f"usage: {PROG} VERB ...\n\n{DESCRIPTION}\n\n{verbs}\n\n{PROG} VERB --help tells its options."


if __name__ == "__main__":
    main()
