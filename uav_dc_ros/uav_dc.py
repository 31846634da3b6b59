"""The command `uav-dc`; each verb is also a command of its own, `python -m uav_dc_ros.NAME`."""

import importlib
import sys
from typing import NoReturn

from uav_dc_ros import cli

PROG = "uav-dc"
DESCRIPTION = "Fly, train, evaluate and study a UAV that collects data from IoT users."
# Module of each verb, with `main(arguments)`, and its description.
VERBS = {
    "fly": ("uav_dc_ros.run_all", "fly recorded missions with a trained policy, on ROS 2"),
    "train": ("uav_dc_ros.experiments.train.cli", "train a policy for a scenario"),
    "evaluate": ("uav_dc_ros.experiments.evaluate.cli", "fly policies over many missions, and compare them"),
    "optimum": (
        "uav_dc_ros.experiments.optimum.cli",
        "bound what is possible, and how far policies are from it",
    ),
    "leaderboard": (
        "uav_dc_ros.experiments.leaderboard.cli",
        "fly policies and planners in many worlds, and write their standings",
    ),
    "paper": ("uav_dc_ros.experiments.paper.cli", "reproduce every figure of the paper, and test its claims"),
    "bag": ("uav_dc_ros.bag", "record, play, recover, verify and explain bags"),
    "scenario": ("uav_dc_ros.scenario", "make, check and draw scenarios"),
}


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command, and exit."""
    given = sys.argv[1:] if arguments is None else arguments
    verb = given[0] if given else "--help"
    if verb in VERBS:
        importlib.import_module(VERBS[verb][0]).main(given[1:])
        raise SystemExit(0)
    cli.run(lambda: cli.without_verb(verb, VERBS, PROG, DESCRIPTION), PROG)


if __name__ == "__main__":
    main()
