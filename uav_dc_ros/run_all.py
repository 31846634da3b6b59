"""Fly recorded missions: start the nodes, monitor the flight, close the bag, print a summary.

python -m uav_dc_ros.run_all --scenario five_clusters --seed 3
python -m uav_dc_ros.run_all --vehicle mavlink --connect tcp:127.0.0.1:5760 --arm --datum here
"""

import argparse
import gc
import os
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from uav_dc_ros import __version__, cli
from uav_dc_ros.core import pace as paces
from uav_dc_ros.errors import NodeError, ParameterError
from uav_dc_ros.run_config import PORT_MAX, SEARCH_MAX, SEARCH_TIME_S, RunConfig
from uav_dc_ros.topics import SIMULATED, SYSTEM_MAX, VEHICLES

if TYPE_CHECKING:  # the command line is parsed before slow imports
    from uav_dc_ros.mission_summary import Summary

PROG = "python -m uav_dc_ros.run_all"
LIVE_PORT = 8765  # Foxglove's default
VIEW_PORT = 8766


def parser(prog: str = PROG) -> cli.Parser:
    """The command line."""
    description = (
        "Fly recorded missions with a trained policy or a planner: world, channel monitor, policy and "
        "recorder as separate ROS 2 nodes."
    )
    options = cli.Parser(prog=prog, description=description)
    add = options.add_argument
    scenario = "shipped scenario, a TOML file, or the random field of a seed (default: %(default)s)"
    add("--scenario", default="five_clusters", metavar="NAME|FILE|random:SEED", help=scenario)
    policy = (
        "shipped policy, its folder, or a planner: random, nearest, fixed_tour, tour or search (default: the "
        "scenario's name with '_dueling')"
    )
    add("--policy", metavar="NAME|DIR", help=policy)
    weight = cli.number(0.0, 1.0, "a weight between 0 (time only) and 1 (users only)")
    objective = "weight w of the users in the objective, for what depends on it, 0 to 1 (default: 10/11)"
    add("--objective", type=weight, metavar="W", help=objective)
    search = f"missions that a policy flies in a model before each move, 0 to {SEARCH_MAX} (default: 0)"
    number = cli.whole_number(0, SEARCH_MAX, f"a whole number from 0 to {SEARCH_MAX}")
    add("--search", type=number, default=0, metavar="N", help=search)
    limit = (
        "time of a search, after which the policy's own move is taken (default: half of a step's time); not "
        "in lockstep, which waits"
    )
    seconds = cli.number(*SEARCH_TIME_S, "a number of seconds from {:g} to {:g}".format(*SEARCH_TIME_S))
    add("--search-time-limit", type=seconds, metavar="SECONDS", help=limit)
    seed = "seed of the users (default: %(default)s)"
    add("--seed", type=cli.whole_number(0), default=0, metavar="N", help=seed)
    missions = "missions, with seeds N, N+1, ... (default: %(default)s)"
    add("--missions", type=cli.count, default=1, metavar="N", help=missions)
    pace = (
        "as fast as the nodes can, or how many times faster than real time (default: %(default)g); not for a "
        "real vehicle"
    )
    add("--pace", type=_pace, default=paces.WATCHABLE, metavar="lockstep|FACTOR", help=pace)
    real = options.add_argument_group("a real vehicle, or one of another simulator").add_argument
    vehicle = (
        "what flies: the world node's own, or an autopilot's over MAVLink, MAVROS or PX4's uXRCE-DDS "
        "(default: %(default)s)"
    )
    real("--vehicle", choices=(SIMULATED, *VEHICLES), default=SIMULATED, help=vehicle)
    connect = (
        "of a vehicle on MAVLink: tcp:HOST:PORT, udp:HOST:PORT (listens), udpout:HOST:PORT, "
        "serial:DEVICE:BAUD"
    )
    real("--connect", metavar="ADDRESS", help=connect)
    number = cli.whole_number(1, SYSTEM_MAX, f"a MAVLink system number from 1 to {SYSTEM_MAX}")
    system = "MAVLink system number of the vehicle, 1 to 255 (default: the only autopilot on the link)"
    real("--system", type=number, metavar="N", help=system)
    arm = "set the mode, arm and take off; without it a pilot does the first two"
    real("--arm", action="store_true", help=arm)
    datum = (
        "position of the grid's corner: such that the vehicle stands at the scenario's start, that of "
        "the last flight, or coordinates (default: the scenario's datum_deg; without one here, and with "
        "--arm the option is required)"
    )
    real("--datum", metavar="here|last|LAT,LON,ALT", help=datum)
    fence = "upload the fence to the autopilot before take-off; with --vehicle mavlink only"
    real("--upload-fence", action="store_true", help=fence)
    setting = "any parameter of a node, such as bridge.failsafe_action=land; repeatable"
    form = "NODE.PARAMETER=VALUE"
    real("--set", dest="settings", type=_setting, action="append", default=[], metavar=form, help=setting)
    recording = options.add_mutually_exclusive_group().add_argument
    recording("--bag", type=Path, metavar="DIR", help="folder of the new bag (default: a dated one in bags/)")
    recording("--no-record", action="store_true", help="fly without a bag")
    namespace = "namespace of the mission: several fly side by side on one network, each in its own"
    cli.add_namespace(options, namespace)
    nodes = "nodes to start on this host, the others being started elsewhere (default: all)"
    add("--nodes", type=cli.names("names of nodes"), metavar="A,B,...", help=nodes)
    compose = "share processes: world, channel monitor, policy; visualizer, web view (default: in lockstep)"
    add("--compose", action=argparse.BooleanOptionalAction, help=compose)
    port = cli.whole_number(0, PORT_MAX, f"a TCP port from 0 (any) to {PORT_MAX}")
    live = "serve the mission to Foxglove over WebSocket (default port: %(const)s)"
    add("--live", type=port, nargs="?", const=LIVE_PORT, metavar="PORT", help=live)
    view = "show the missions on a page in a browser, on this machine only (default port: %(const)s)"
    add("--view", type=port, nargs="?", const=VIEW_PORT, metavar="PORT", help=view)
    summary = "write the summary as JSON, also to /dev/stdout, a FIFO or a device"
    add("--summary", type=Path, metavar="FILE", help=summary)
    add("--version", action="version", version=__version__)
    return options


def main(arguments: list[str] | None = None, prog: str = PROG) -> NoReturn:
    """Run the command, and exit."""
    has_flown = False

    def command() -> int:
        nonlocal has_flown
        config = _config(parser(prog).parse_args(arguments))
        gc.disable()  # imports leave no garbage
        from uav_dc_ros.nodes.ros import environment, fastdds

        environment.prepare(local_only=config.nodes is None)
        fastdds.select_transports()
        from uav_dc_ros.nodes.framework import node_main
        from uav_dc_ros.nodes.ros import rclpy_private
        from uav_dc_ros.runner.mission_runner import MissionRunner

        rclpy_private.skip_message_generator()
        runner = MissionRunner(config)
        gc.freeze()
        gc.enable()
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the mission continues without its terminal
        cli.on_stop(runner.interrupt)
        node_main.use_batch_scheduling()
        has_flown = True
        return runner.run()

    try:
        cli.run(command, prog)
    except SystemExit as exited:
        if has_flown and isinstance(exited.code, int):
            os._exit(exited.code)  # all output is written, and Python's own exit takes a fifth of a second
        raise
    finally:
        gc.enable()  # also for a caller in this process whose options were refused


def fly(config: RunConfig | None = None, *, show: bool = False) -> "tuple[Summary, ...]":
    """Fly missions as run_all does: start the nodes, wait for the end, close the bag.

    It uses its own ROS context: the caller's rclpy is unchanged. The environment variables that it sets are
    restored at the end. In the main thread Ctrl-C stops the nodes in order and closes the bag; other threads
    handle no signal. A process can have one run at a time.

    The default `config` is one mission of ten seconds. Progress and summary are printed if `show`. Returns a
    summary per mission. That of an aborted mission has the outcome `aborted`, and a reason.

    Raises:
        UavDcError: a value that cannot be flown (nothing was started), or an incomplete bag.
        ImportError: ROS 2 is missing.
        KeyboardInterrupt: Ctrl-C, after the bag was closed.
    """
    config = config or RunConfig()
    before = dict(os.environ)
    in_main = threading.current_thread() is threading.main_thread()
    try:
        from uav_dc_ros.nodes.ros import environment

        # The nodes select their transports themselves. In this process Fast DDS may have been loaded before.
        environment.prepare(local_only=config.nodes is None)
        from uav_dc_ros.messages import Phase
        from uav_dc_ros.runner.mission_runner import MissionRunner

        runner = MissionRunner(config, show=show)
        handler = signal.signal(signal.SIGINT, runner.interrupt) if in_main else None
        try:
            status = runner.run()
        finally:
            if in_main:
                signal.signal(signal.SIGINT, handler)
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)
    if runner.interrupted:
        raise KeyboardInterrupt
    if status and all(summary.outcome is not Phase.ABORTED for summary in runner.summaries):
        raise NodeError("; ".join(runner.errors))
    return tuple(runner.summaries)


def _config(options: argparse.Namespace) -> RunConfig:
    """The run of a command line."""
    given = vars(options)
    settings = dict(given.pop("settings"))
    pace = paces.LOCKSTEP if options.pace is None else options.pace
    record = not given.pop("no_record")
    return RunConfig(**given | {"settings": settings, "pace": pace, "record": record})


def _pace(text: str) -> float | None:
    try:
        return paces.parse(text)
    except ParameterError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _setting(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (equals and all(key.partition("."))):
        expected = "NODE.PARAMETER=VALUE, such as bridge.failsafe_action=land"
        raise argparse.ArgumentTypeError(f"{text!r}; expected {expected}")
    return key, value


if __name__ == "__main__":
    main()
