"""Fly recorded missions: start the nodes, watch the flight, close the bag, print a summary.

python -m uav_dc_ros.run_all --scenario five_clusters --seed 3
python -m uav_dc_ros.run_all --vehicle mavlink --connect tcp:127.0.0.1:5760 --arm --datum here
"""

import argparse
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from uav_dc_ros import __version__, cli
from uav_dc_ros.core import pace as paces
from uav_dc_ros.errors import NodeError, ParameterError
from uav_dc_ros.run_config import PORT_MAX, RunConfig
from uav_dc_ros.topics import SIMULATED, SYSTEM_MAX, VEHICLES

if TYPE_CHECKING:  # a command line is read before anything heavy is imported
    from uav_dc_ros.mission_summary import Summary

PROG = "python -m uav_dc_ros.run_all"
LIVE_PORT = 8765  # Foxglove's own default


def parser(prog: str = PROG) -> cli.Parser:
    """The command line."""
    options = cli.Parser(
        prog=prog,
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
        default=paces.WATCHABLE,
        metavar="lockstep|FACTOR",
        help="as fast as the nodes can, or how many times faster than real time (default: %(default)g); a "
        "real vehicle has its own",
    )
    vehicle = options.add_argument_group("a real vehicle, or one that another simulator flies")
    vehicle.add_argument(
        "--vehicle",
        choices=(SIMULATED, *VEHICLES),
        default=SIMULATED,
        help="what flies: the world node's own, or an autopilot's over MAVLink, MAVROS or PX4's uXRCE-DDS "
        "(default: %(default)s)",
    )
    vehicle.add_argument(
        "--connect",
        metavar="ADDRESS",
        help="of a vehicle on MAVLink: tcp:HOST:PORT, udp:HOST:PORT (listens), udpout:HOST:PORT, "
        "serial:DEVICE:BAUD",
    )
    vehicle.add_argument(
        "--system",
        type=_whole(1, SYSTEM_MAX, f"a MAVLink system number from 1 to {SYSTEM_MAX}"),
        metavar="N",
        help="MAVLink system number of the vehicle, 1 to 255 (default: the only autopilot on the link)",
    )
    vehicle.add_argument(
        "--arm",
        action="store_true",
        help="set the mode, arm and take off; without it a pilot does the first two",
    )
    vehicle.add_argument(
        "--datum",
        metavar="here|last|LAT,LON,ALT",
        help="where the grid's corner lies: so that the vehicle stands at the scenario's start, as in the "
        "last flight, or there; needed with --arm (default: here)",
    )
    vehicle.add_argument(
        "--set",
        dest="settings",
        type=_setting,
        action="append",
        default=[],
        metavar="NODE.PARAMETER=VALUE",
        help="any parameter of a node, such as bridge.failsafe_action=land; repeatable",
    )
    recording = options.add_mutually_exclusive_group()
    recording.add_argument(
        "--bag", type=Path, metavar="DIR", help="folder of the new bag (default: a dated one in bags/)"
    )
    recording.add_argument("--no-record", action="store_true", help="fly without a bag")
    options.add_argument(
        "--namespace",
        type=cli.namespace,
        default="/",
        metavar="NS",
        help="namespace of the mission: several fly side by side on one network, each in its own",
    )
    options.add_argument(
        "--nodes",
        type=_names,
        metavar="A,B,...",
        help="nodes to start on this host, the others being started elsewhere (default: all)",
    )
    options.add_argument(
        "--compose",
        action=argparse.BooleanOptionalAction,
        help="world, channel monitor and policy in one process (default: in lockstep, where they only wait "
        "for one another)",
    )
    options.add_argument(
        "--live",
        type=_whole(0, PORT_MAX, f"a TCP port from 0 (any) to {PORT_MAX}"),
        nargs="?",
        const=LIVE_PORT,
        metavar="PORT",
        help="serve the mission to Foxglove over WebSocket (default port: %(const)s)",
    )
    options.add_argument(
        "--summary",
        type=Path,
        metavar="FILE",
        help="write the summary as JSON; into /dev/stdout, a FIFO or a device, too",
    )
    options.add_argument("--version", action="version", version=__version__)
    return options


def main(arguments: list[str] | None = None, prog: str = PROG) -> NoReturn:
    """Run the command, and exit."""
    has_flown = False

    def command() -> int:
        nonlocal has_flown
        config = _config(parser(prog).parse_args(arguments))
        from uav_dc_ros.nodes.ros import environment, fastdds

        environment.prepare(local_only=config.nodes is None)  # before ROS is imported
        from uav_dc_ros.nodes.framework import node_main
        from uav_dc_ros.runner.mission_runner import MissionRunner

        try:
            flight = MissionRunner(config)
            signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the terminal is gone: the mission goes on
            cli.on_stop(flight.interrupt)
            node_main.use_batch_scheduling()
            has_flown = True
            return flight.run()
        finally:
            fastdds.remove_leftovers()  # of nodes that were killed

    try:
        cli.run(command, prog)
    except SystemExit as ended:
        if has_flown and isinstance(ended.code, int):
            os._exit(ended.code)  # all is written, and Python takes a fifth of a second to clear up
        raise


def fly(config: RunConfig | None = None, *, show: bool = False) -> "tuple[Summary, ...]":
    """Fly missions as run_all does, from Python: start the nodes, wait for the end, close the bag.

    It has a ROS context of its own: a caller's rclpy, initialised or not, stays as it is. The variables that
    it sets for ROS in the environment are taken back at the end. In the main thread Ctrl-C stops the nodes in
    order and closes the bag first; in another thread no signal is handled. One run at a time in a process.

    Args:
        config: what is flown; the defaults fly one mission in ten seconds.
        show: are progress and summary printed?

    Returns:
        One summary for each mission. A mission that was aborted has the outcome `aborted`, and a reason.

    Raises:
        UavDcError: a value that cannot be flown, and nothing was started; or the missions were flown, and
            their bag is not whole.
        ImportError: ROS 2 is missing.
        KeyboardInterrupt: Ctrl-C, once the bag is closed.
    """
    config = config or RunConfig()
    before = dict(os.environ)
    in_main = threading.current_thread() is threading.main_thread()
    try:
        from uav_dc_ros.nodes.ros import environment, fastdds

        environment.prepare(local_only=config.nodes is None)  # before ROS is imported
        from uav_dc_ros.messages import Phase
        from uav_dc_ros.runner.mission_runner import MissionRunner

        flight = MissionRunner(config, show=show)
        handler = signal.signal(signal.SIGINT, flight.interrupt) if in_main else None
        try:
            status = flight.run()
        finally:
            if in_main:
                signal.signal(signal.SIGINT, handler)
            fastdds.remove_leftovers()
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)
    if flight.interrupted:
        raise KeyboardInterrupt
    summaries = tuple(flight.summaries)
    if status and all(one.outcome is not Phase.ABORTED for one in summaries):
        raise NodeError("; ".join(flight.errors))
    return summaries


def _config(options: argparse.Namespace) -> RunConfig:
    """What the command line says."""
    given = vars(options)
    settings = {f"{node}.{name}": value for node, name, value in given.pop("settings")}
    lockstep = paces.LOCKSTEP if options.pace is None else options.pace
    record = not given.pop("no_record")
    return RunConfig(**given | {"settings": settings, "pace": lockstep, "record": record})


def _pace(text: str) -> float | None:
    try:
        return paces.parse(text)
    except ParameterError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _setting(text: str) -> tuple[str, str, str]:
    where, equals, value = text.partition("=")
    node, dot, name = where.partition(".")
    if not (equals and dot and node and name):
        raise argparse.ArgumentTypeError(
            f"{text!r}; expected NODE.PARAMETER=VALUE, such as bridge.failsafe_action=land"
        )
    return node, name, value


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"{text!r}; expected names of nodes, each once, with ',' between")
    return names


def _whole(least: int, most: int, expected: str) -> Callable[[str], int]:
    """The type of an option that is a whole number within a range."""

    def whole(text: str) -> int:
        if not (text.isascii() and text.isdecimal() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text!r}; expected {expected}")
        return int(text)

    return whole


if __name__ == "__main__":
    main()
