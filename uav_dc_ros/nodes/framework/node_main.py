"""Runs one or several nodes as a process, from its command line to its exit."""

import argparse
import contextlib
import gc
import os
import select
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

import msgspec
import rclpy
from rclpy.signals import SignalHandlerOptions

from uav_dc_ros import cli
from uav_dc_ros.errors import ParameterError, UavDcError
from uav_dc_ros.nodes.framework import process_control
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.parameters import COMMON, Parameter
from uav_dc_ros.nodes.framework.process_control import (
    ACTIVATE,
    CONFIGURE,
    REASON_MAX,
    REPORTS,
    SHUT_DOWN,
    STATES,
    SUPERVISED,
)
from uav_dc_ros.nodes.ros import environment, fastdds, rclpy_private
from uav_dc_ros.nodes.ros.executor import DirectExecutor, shut_down

ROS_ARGUMENTS = "--ros-args"
DRAIN_S = 2.0
# From the stop request on, for messages that a node expects. Over a link that loses a fifth of its packets
# two of a thousand messages took longer than a second; each further tenth of a second nearly halves them. It
# outlasts publishers on another host, too: they leave `mission_node.ACKNOWLEDGE_S` after their own stop.
AWAIT_S = 3.0
AWAIT_POLL_S = 0.02  # between two checks
EXIT_TIMEOUT_S = 3.0  # for the middleware to close
BACKGROUND_NICENESS = 5  # of a node that no other waits for
# Exit statuses. Python's own 1 remains for unexpected errors: only after those a restart may help.
EXIT_NOT_STARTED = 2
EXIT_FAILED = 3


class StopMonitor:
    """Receives stop requests: SIGINT, SIGTERM, SIGHUP and, under run_all, the end of standard input.

    A waiting executor sleeps in C, where Python's signal handlers do not run: signals arrive through a file
    descriptor in a thread that wakes it.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self.requested = False  # whether a stop was requested
        self.commands: deque[str] = deque()  # lines of run_all that are not yet executed, the oldest first
        self._wake = wake
        self._receiver, self._sender = socket.socketpair()
        self._sender.setblocking(False)
        cli.on_stop(lambda *_: None)
        signal.set_wakeup_fd(self._sender.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._receive, daemon=True).start()

    @property
    def is_pending(self) -> bool:
        """Whether there is a stop request or a command."""
        return self.requested or bool(self.commands)

    def close(self) -> None:
        """Wake the executor no more."""
        self._wake = lambda: None

    def _receive(self) -> None:
        sources = [self._receiver.fileno(), *([0] if SUPERVISED in os.environ else [])]
        line = b""
        while True:
            for source in select.select(sources, [], [])[0]:
                received = os.read(source, 4096)
                *lines, line = (line + received).split(b"\n") if source == 0 else (line,)
                self.commands.extend(each.decode() for each in lines)
                self.requested |= source != 0 or not received
                if self.is_pending:
                    self._wake()
                if not received:
                    sources.remove(source)


def make_transition(node: MissionNode, transition: str) -> bool:
    """Make a transition of a node; returns whether it succeeded."""
    getattr(node, f"trigger_{transition}")()
    return node.state == STATES[transition]


class Reporter:
    """The nodes' end: makes the commanded transitions, and reports.

    A report is also a heartbeat: the executor's thread sends one every `PERIOD_S`. A callback that hangs
    stops them.
    """

    def __init__(self, nodes: Sequence[MissionNode], executor: DirectExecutor) -> None:
        self._nodes = {node.row.name: node for node in nodes}
        self._executor = executor
        self._refused: dict[str, str] = {}
        self._pipe: int | None = int(os.environ[REPORTS]) if REPORTS in os.environ else None
        if self._pipe is not None:
            os.set_blocking(self._pipe, False)

    def report(self) -> None:
        """Report all nodes."""
        if self._pipe is None:
            return
        reports = {
            name: process_control.NodeReport(node.state, self._refused.get(name), node.is_caught_up())
            for name, node in self._nodes.items()
        }
        # The pipe is full while run_all is suspended, and closed once it has ended: see StopMonitor.
        with contextlib.suppress(OSError):
            os.write(self._pipe, msgspec.json.encode(reports) + b"\n")

    def execute(self, line: str) -> None:
        """Make the transition that a line commands, and report."""
        transition, name = line.split()
        node = self._nodes[name]
        self._refused.pop(name, None)
        if transition == SHUT_DOWN and node.state == "active":
            drain([node], self._executor)
        if not make_transition(node, transition):
            self._refused[name] = str(node.failure or "it failed; see its log")[:REASON_MAX]
        self.report()


def drain(nodes: Sequence[MissionNode], executor: DirectExecutor) -> None:
    """Handle the last messages of active nodes that are about to be shut down, until there is a pause."""
    if quiet_s := max((node.drain_quiet_s for node in nodes), default=0.0):
        end_s = time.monotonic() + DRAIN_S
        executor.spin(lambda: time.monotonic() > end_s, quiet_s)


def split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Arguments before those for ROS, and those for ROS."""
    at = arguments.index(ROS_ARGUMENTS) if ROS_ARGUMENTS in arguments else len(arguments)
    return list(arguments[:at]), list(arguments[at:])


def parser(name: str, description: str) -> cli.Parser:
    """The command line of a node of the table, or of another program that runs one."""
    own = NODES[name].parameters if name in NODES else ()
    return cli.Parser(
        prog=f"python -m uav_dc_ros.nodes.{name}",
        usage="%(prog)s [-h] [--ros-args -p PARAMETER:=VALUE ... -r __ns:=/NAMESPACE ...]",
        description=description,
        epilog="\n".join(["parameters:", *map(_line, (*own, *COMMON))]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _line(row: Parameter) -> str:
    value = str(row.default).lower() if isinstance(row.default, bool) else row.default  # as ROS reads it
    default = "" if value == "" else f" (default: {value})"
    return f"  {row.name:<20}  {row.help}{default}"


def ros_arguments(description: str) -> list[str]:
    """The ROS arguments of a node's command line; exits with 2 if there are others: ROS ignores those."""
    others, for_ros = split(sys.argv[1:])
    command = parser(Path(sys.argv[0]).stem, description)
    _, unknown = command.parse_known_args(others)
    if unknown:
        command.error(f"{' '.join(unknown)!r}; expected {ROS_ARGUMENTS} first, and -p PARAMETER:=VALUE")
    return for_ros


def use_batch_scheduling() -> None:
    """Schedule this process as a batch job: a message that wakes its threads preempts no other thread.

    A mission's processes have more threads than most computers have cores: in lockstep a step takes an eighth
    less time this way. Call it before ROS is initialised, since the middleware's threads inherit it.
    """
    with contextlib.suppress(PermissionError):  # some containers forbid it
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def main(
    *makes: Callable[[], MissionNode], arguments: list[str] | None = None, batch_scheduling: bool = True
) -> NoReturn:
    """Run nodes until a stop request: the body of `python -m uav_dc_ros.nodes.NAME`.

    Several nodes start in the order of their constructors and share one executor, and so one thread.
    `arguments` are ROS arguments; default: those of the command line, which may have no others.
    """
    cli.open_streams()
    if arguments is None:
        arguments = ros_arguments(makes[0].__doc__ or "")
    if batch_scheduling:
        use_batch_scheduling()
    gc.disable()  # until the nodes are there: a start has no garbage that is worth the search for it
    rclpy_private.skip_message_generator()
    nodes: list[MissionNode] = []
    status = _run(makes, arguments, nodes)
    gc.unfreeze()
    shut_down(rclpy.get_default_context(), EXIT_TIMEOUT_S, nodes)
    os._exit(status)  # all is logged and written; the middleware may hang when it is shut down


def _run(makes: Sequence[Callable[[], MissionNode]], arguments: list[str], nodes: list[MissionNode]) -> int:
    """Run nodes, which are added to the list, from start to stop; returns the exit status."""
    status = EXIT_NOT_STARTED
    try:
        if SUPERVISED not in os.environ:
            environment.check()
        fastdds.select_transports()
        try:
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
            nodes += [make() for make in makes]
        except rclpy_private.INIT_ERRORS as error:
            raise ParameterError(f"{error}; expected ROS arguments after --ros-args") from None
        pause_s = min(node.pause_s for node in nodes)
        executor = DirectExecutor(pause_s)
        for node in nodes:
            executor.add_node(node)
            node.spin_once = executor.spin_once
        stop = StopMonitor(executor.wake)
        reporter = Reporter(nodes, executor)
        reporter.report()
        for node in nodes:
            node.prepare()
        nodes[0].create_timer(process_control.PERIOD_S, reporter.report, clock=nodes[0].steady)
        to_start = [node for node in nodes if node.values["autostart"]]
        transitions = ((node, name) for name in (CONFIGURE, ACTIVATE) for node in to_start)
        if all(make_transition(node, name) for node, name in transitions):
            gc.freeze()  # these objects stay: the collector need not scan them again
            gc.enable()
            if pause_s:
                os.nice(BACKGROUND_NICENESS)
            status = EXIT_FAILED
            status = _spin(nodes, executor, stop, reporter)
        stop.close()
    except UavDcError as error:
        cli.print_error(f"error: {error}")
    return status


def _spin(
    nodes: Sequence[MissionNode], executor: DirectExecutor, stop: StopMonitor, reporter: Reporter
) -> int:
    """Spin until a stop request; then, or when a callback failed, shut the nodes down."""
    try:
        while not stop.requested:
            executor.spin(lambda: stop.is_pending)
            while stop.commands and not stop.requested:
                reporter.execute(stop.commands.popleft())
        end_s = time.monotonic() + AWAIT_S
        active = [node for node in nodes if node.state == "active"]
        drain(active, executor)
        while any(node.is_awaiting() for node in active) and time.monotonic() < end_s:
            executor.spin_once(AWAIT_POLL_S)
    finally:
        for node in reversed(nodes):
            if node.state != "finalized":
                node.trigger_shutdown()
            if counts := node.statistics.rejected:
                rejected = ", ".join(f"{topic} {reason} {n}" for (topic, reason), n in counts.items())
                node.get_logger().warning(f"rejected messages: {rejected}")
        reporter.report()  # all nodes are finalized: see Supervisor.stop
    return 0 if all(node.failure is None for node in nodes) else EXIT_FAILED
