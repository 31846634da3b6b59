"""Fly recorded missions: start the nodes, watch the flight, close the bag, print a summary.

python -m uav_dc_ros.run_all --scenario five_clusters --seed 3
"""

import argparse
import os
from pathlib import Path
from typing import NoReturn

from uav_dc_ros import __version__, cli
from uav_dc_ros.core import pace
from uav_dc_ros.errors import ParameterError

PROG = "python -m uav_dc_ros.run_all"
DOMAIN_MAX = 232  # the ports of higher ones do not exist
WATCHABLE_PACE = 90.0  # a mission of sixty steps of 15 s in ten seconds


def parser() -> cli.Parser:
    """The command line."""
    options = cli.Parser(
        prog=PROG,
        description="Fly recorded missions with a trained policy: world, channel monitor, policy and "
        "recorder as separate ROS 2 nodes.",
    )
    options.add_argument(
        "--scenario",
        default="five_clusters",
        metavar="NAME|FILE",
        help="shipped scenario, or a TOML file (default: %(default)s)",
    )
    options.add_argument(
        "--policy",
        metavar="NAME|DIR",
        help="shipped policy, or its folder (default: the scenario's name with '_dueling')",
    )
    options.add_argument(
        "--seed",
        type=cli.whole_number(0),
        default=0,
        metavar="N",
        help="seed of the users (default: %(default)s)",
    )
    options.add_argument(
        "--missions",
        type=cli.count,
        default=1,
        metavar="N",
        help="missions, with seeds N, N+1, ... (default: %(default)s)",
    )
    options.add_argument(
        "--pace",
        type=_pace,
        default=WATCHABLE_PACE,
        metavar="lockstep|FACTOR",
        help="as fast as the nodes can, or how many times faster than real time (default: %(default)g)",
    )
    recording = options.add_mutually_exclusive_group()
    recording.add_argument(
        "--bag", type=Path, metavar="DIR", help="folder of the new bag (default: a dated one in bags/)"
    )
    recording.add_argument("--no-record", action="store_true", help="fly without a bag")
    options.add_argument("--summary", type=Path, metavar="FILE", help="write the summary as JSON")
    options.add_argument("--version", action="version", version=__version__)
    return options


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command, and exit."""
    options = parser().parse_args(arguments)

    def command() -> int:
        _prepare_ros()  # before it is imported
        from uav_dc_ros.nodes.flight import Flight

        return Flight(options).run()

    cli.run(command, PROG)


def _prepare_ros() -> None:
    """What holds for this command and its nodes, unless the user's environment says otherwise.

    Raises:
        ParameterError: an environment in which ROS cannot start.
    """
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    if not (domain.isdecimal() and int(domain) <= DOMAIN_MAX):
        raise ParameterError(f"ROS_DOMAIN_ID is {domain!r}; expected a whole number from 0 to {DOMAIN_MAX}")
    # Nobody else on the network should see these nodes by accident.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("RCUTILS_CONSOLE_OUTPUT_FORMAT", "{severity}: {message}")
    # Jazzy's Fast DDS reads the first name, later ones the second.
    names = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
    if not any(name in os.environ for name in names):
        profiles = str(Path(__file__).parent / "nodes" / "fastdds.xml")
        os.environ.update(dict.fromkeys(names, profiles))


def _pace(text: str) -> float | None:
    try:
        return pace.parse(text)
    except ParameterError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


if __name__ == "__main__":
    main()
