"""Runs a node as a process, or several in one: from the start to the last word."""

import contextlib
import gc
import os
import select
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import NoReturn

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.signals import SignalHandlerOptions

from uav_dc_ros import cli
from uav_dc_ros.errors import ParameterError, UavDcError
from uav_dc_ros.nodes.framework import node_cli, process_control
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.process_control import SUPERVISED
from uav_dc_ros.nodes.ros import environment, fastdds
from uav_dc_ros.nodes.ros.executor import DirectExecutor

DRAIN_S = 2.0
DRAIN_QUIET_S = 0.2  # a message that was lost on the way is sent again within a tenth
LEAVE_S = 3.0  # for the middleware to close
BACKGROUND = 5  # niceness of a node that nobody waits for
# Exit statuses. Python's own 1 is left to what nobody thought of: only that is worth another try.
NOT_BEGUN = 2
GAVE_UP = 3


class StopMonitor:
    """Turns SIGINT, SIGTERM, SIGHUP and, under run_all, the end of standard input into a request to stop.

    A waiting executor sleeps in C, where Python's handlers do not run: signals arrive through a file
    descriptor in a thread that wakes it.

    Attributes:
        requested: was it requested to stop?
        commands: lines of run_all, in the order in which they came, that are still to be obeyed.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self.requested = False
        self.commands: deque[str] = deque()
        self._wake = wake
        self._ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        self._theirs = theirs
        cli.on_stop(lambda *_: None)
        signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._watch, daemon=True).start()

    @property
    def is_due(self) -> bool:
        """Is there anything to be done: a stop, or a command."""
        return self.requested or bool(self.commands)

    def close(self) -> None:
        """Wake no more: nothing waits, and what would be woken is to end."""
        self._wake = lambda: None

    def _watch(self) -> None:
        sources = [self._ours.fileno(), *([0] if SUPERVISED in os.environ else [])]
        line = b""
        while True:
            for source in select.select(sources, [], [])[0]:
                received = os.read(source, 4096)
                *lines, line = (line + received).split(b"\n") if source == 0 else (line,)
                self.commands.extend(each.decode() for each in lines)
                self.requested |= source != 0 or not received
                if self.is_due:
                    self._wake()
                if not received:
                    sources.remove(source)


def give_way() -> None:
    """Interrupt no other thread when a message wakes one of this process, but wait until it is done.

    A mission's processes have more threads than most computers have cores, and each message wakes some of
    them: in lockstep a step takes an eighth less time this way. To be called before ROS is initialised, since
    the middleware's threads inherit it.
    """
    with contextlib.suppress(PermissionError):  # some containers forbid it
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def main(
    *makes: Callable[[], MissionNode], arguments: list[str] | None = None, gives_way: bool = True
) -> NoReturn:
    """Run nodes until they are asked to stop: the body of `python -m uav_dc_ros.nodes.NAME`.

    Several have one executor, and so one thread: their callbacks never run at the same time.

    Args:
        makes: each makes a node; those that are to be started first stand first.
        arguments: ROS arguments; those of the command line, which may have no others, unless given.
        gives_way: see `give_way`.
    """
    cli.open_streams()
    if arguments is None:
        arguments = node_cli.ros_arguments(makes[0].__doc__ or "")
    if gives_way:
        give_way()
    status = _flown(makes, arguments)
    # All is logged and written. The middleware was seen to hang while several of its participants leave at
    # once: that must not turn a good ending into a killed process, and costs its shared memory at most.
    threading.Timer(LEAVE_S, os._exit, (status,)).start()
    gc.unfreeze()
    gc.collect()  # the middleware's part of a node ends with the last reference to it, and not before
    rclpy.try_shutdown()
    rclpy.get_default_context().destroy()
    os._exit(status)


def _flown(makes: Sequence[Callable[[], MissionNode]], arguments: list[str]) -> int:
    """Run nodes from the first to the last; returns the exit status. Leaves no reference to any of them."""
    status = NOT_BEGUN
    nodes: list[MissionNode] = []
    try:
        if SUPERVISED not in os.environ:
            environment.check()
        fastdds.use_profiles()
        nodes = _made(makes, arguments)
        rest_s = min(node.rest_s for node in nodes)
        executor = DirectExecutor(rest_s)
        for node in nodes:
            executor.add_node(node)
            node.serve = executor.spin_once
        stopper = StopMonitor(executor.wake)
        reporter = process_control.Reporter(nodes)
        reporter.report()
        for node in nodes:
            node.prepare()
        nodes[0].create_timer(process_control.PERIOD_S, reporter.report, clock=nodes[0].steady)
        if _begin([node for node in nodes if node.values["autostart"]]):
            gc.freeze()  # what is there by now stays: no need to look at it again and again
            if rest_s:
                os.nice(BACKGROUND)
            status = GAVE_UP
            status = _run(nodes, executor, stopper, reporter)
        stopper.close()
    except UavDcError as error:
        cli.print_error(f"error: {error}")
    for node in nodes:
        node.destroy_node()
    return status


def _made(makes: Iterable[Callable[[], MissionNode]], arguments: list[str]) -> list[MissionNode]:
    """Initialise ROS and make the nodes.

    Raises:
        ParameterError: what stands after --ros-args makes no sense.
    """
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        return [make() for make in makes]
    except (_rclpy.RCLInvalidROSArgsError, _rclpy.UnknownROSArgsError, _rclpy.RCLError) as error:
        raise ParameterError(f"{error}; expected ROS arguments after --ros-args") from None


def _begin(nodes: Sequence[MissionNode]) -> bool:
    """Configure and activate nodes that start by themselves; did all come so far."""
    for node in nodes:
        node.trigger_configure()
        if node.state != "inactive":
            return False
    for node in nodes:
        node.trigger_activate()
        if node.state != "active":
            return False
    return True


def _run(
    nodes: Sequence[MissionNode],
    executor: DirectExecutor,
    stopper: StopMonitor,
    reporter: process_control.Reporter,
) -> int:
    """Spin until the nodes are asked to stop, and stop them safely, also when a callback failed."""
    try:
        while not stopper.requested:
            executor.spin(lambda: stopper.is_due)
            while stopper.commands and not stopper.requested:
                reporter.obey(stopper.commands.popleft())
        if any(node.drains and node.state == "active" for node in nodes):
            deadline_s = time.monotonic() + DRAIN_S
            executor.spin(lambda: time.monotonic() > deadline_s, DRAIN_QUIET_S)
    finally:
        for node in reversed(nodes):
            _shut_down(node)
        reporter.report()  # all was said: see Supervisor.stop
    return 0 if all(node.failure is None for node in nodes) else GAVE_UP


def _shut_down(node: MissionNode) -> None:
    if node.state != "finalized":
        node.trigger_shutdown()
    if node.meter.rejected:
        told = ", ".join(f"{topic} {reason} {n}" for (topic, reason), n in node.meter.rejected.items())
        node.get_logger().warning(f"rejected messages: {told}")
