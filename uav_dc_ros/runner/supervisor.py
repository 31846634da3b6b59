"""Starts and stops nodes in the order of their ranks, monitors them, and restarts those that end."""

import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Self

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.framework.node_main import EXIT_FAILED, EXIT_NOT_STARTED
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.process_control import ACTIVATE, CONFIGURE, FINALIZED, SHUT_DOWN
from uav_dc_ros.runner.node_process import NodeProcess

RESTART_WINDOW_S = 60.0  # the limit on restarts counts exits within this time
BACK_OFF_S = 0.2  # before the first restart; doubles with each further one
STARTUP_S = 25.0  # longest time without a report until all nodes of a process are active
PASSED_MAX_S = 0.5  # between two checks of reports: run_all itself was suspended for the rest
STOP_POLL_S = 0.002
UP = ("unconfigured", "inactive", "active")  # states, in order
TRANSITIONS = {"unconfigured": CONFIGURE, "inactive": ACTIVATE}


class SupervisedNode:
    """A node, and its process, which other nodes may share.

    A change of its state through ROS services after it was active is not reverted.
    """

    def __init__(self, name: str, parameters: Mapping[str, object]) -> None:
        self.row = NODES[name]
        self.parameters = dict(parameters)
        self.state: str | None = None  # as last reported; None before the first report
        self.restarts = 0
        self.process: NodeProcess | None = None
        self.start_s = 0.0  # time of the next start, without a process
        self.exits_s: deque[float] = deque()
        self.commanded: str | None = None  # last transition

    def bring_up(self, may_activate: bool) -> None:
        """Command the next transition towards active, once; raises NodeError if the node rejects it."""
        assert self.process is not None
        report = self.process.reports.get(self.row.name)
        if report is None:
            return
        self.state = report.state
        if report.refused is not None:
            wanted = {CONFIGURE: "configured", ACTIVATE: "activated"}[self.commanded or CONFIGURE]
            raise NodeError(f"node {self.row.name} could not be {wanted}: {report.refused}")
        if report.state not in UP:
            raise NodeError(f"node {self.row.name} is {report.state}; expected some of {', '.join(UP)}")
        transition = TRANSITIONS.get(report.state)
        if transition in (None, self.commanded) or (transition == ACTIVATE and not may_activate):
            return
        self.commanded = transition
        self.process.command(transition, self.row.name)


class Supervisor:
    """The nodes of a mission on this host, with ROS parameters by name; a context manager that stops them.

    The nodes of each group in `composed` share a process. After its end each gets its own, which isolates a
    faulty node. `folder` is for parameter files. Threads call `on_line` with the name of a process and a line
    of its output.
    """

    def __init__(
        self,
        namespace: str,
        parameters: Mapping[str, Mapping[str, object]],
        composed: Sequence[Collection[str]],
        folder: Path,
        on_line: Callable[[str, str], None],
        on_note: Callable[[str], None],
    ) -> None:
        self._namespace = namespace
        self._composed, self._folder = composed, folder
        self._on_line, self._on_note = on_line, on_note
        self.nodes = [SupervisedNode(name, values) for name, values in parameters.items()]
        self.brought_up = False  # whether all nodes have been active at once
        self._checked_s = time.monotonic()

    def __enter__(self) -> Self:
        alone = list(self.nodes)
        for names in self._composed:
            shared = [node for node in alone if node.row.name in names]
            alone = [node for node in alone if node not in shared]
            self._start(shared)
        for node in alone:
            self._start([node])
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def restarts(self) -> dict[str, int]:
        """Number of restarts by node name."""
        return {node.row.name: node.restarts for node in self.nodes}

    def is_catching_up(self, name: str) -> bool:
        """Whether a node has ended, or was restarted and has not yet received what others have latched."""
        for node in self.nodes:
            if node.row.name == name and node.restarts:
                report = None if node.process is None else node.process.reports.get(name)
                return report is None or not report.caught_up
            if node.row.name == name:
                return node.process is None or node.process.has_ended
        return False

    @property
    def have_started(self) -> bool:
        """Whether all processes report."""
        return all(node.process is not None and bool(node.process.reports) for node in self.nodes)

    def _start(self, nodes: Sequence[SupervisedNode]) -> None:
        parameters = {}
        for node in nodes:
            restarted = node.row.restart_parameters if node.restarts else {}
            parameters[node.row.name] = {**node.parameters, **restarted, "autostart": False}
        process = NodeProcess(parameters, self._namespace, nodes[0].restarts, self._folder, self._on_line)
        for node in nodes:
            node.process, node.state, node.commanded = process, None, None

    def tick(self, may_bring_up: bool) -> None:
        """Bring nodes up, if they may be, and restart them; raises NodeError if the mission loses one."""
        self._check_reports()
        for node in list(self.nodes):
            if node.process is None:
                if time.monotonic() >= node.start_s:
                    self._start([node])
            elif node.process.has_ended:
                self._handle_exit(node.process)
            elif may_bring_up and node.state != "active":
                try:
                    node.bring_up(self.brought_up or self._lower_ranks_are_active(node))
                except NodeError as error:
                    self._drop(node, str(error))
        self.brought_up = self.brought_up or all(node.state == "active" for node in self.nodes)

    def _check_reports(self) -> None:
        """Kill processes that hang."""
        now_s, before_s = time.monotonic(), self._checked_s
        self._checked_s = now_s
        for process in {node.process for node in self.nodes if node.process is not None}:
            process.receive_reports(min(now_s - before_s, PASSED_MAX_S))
            nodes = [node for node in self.nodes if node.process is process]
            active = all(node.state == "active" for node in nodes)
            timeout_s = max(node.row.hang_timeout_s for node in nodes) if active else STARTUP_S
            if process.silent_s > timeout_s and not process.has_ended:
                process.kill(f"gave no sign of life for {timeout_s:.0f} s")

    def _lower_ranks_are_active(self, node: SupervisedNode) -> bool:
        lower = (other for other in self.nodes if other.row.rank < node.row.rank)
        return all(other.state == "active" for other in lower if other.row.needed or other.row.on_request)

    def _handle_exit(self, process: NodeProcess) -> None:
        """Schedule restarts of the nodes of an ended process, each in its own, or drop them."""
        reason = f"{process.description} {process.exit_description()}"
        process.close()
        nodes = [node for node in self.nodes if node.process is process]
        for node in nodes:
            node.process, node.state = None, None
        fails_again = process.process.returncode in (EXIT_NOT_STARTED, EXIT_FAILED)
        # Which of several nodes failed shows when each has its own process; a mission that needs them ends.
        if fails_again and (len(nodes) == 1 or any(node.row.needed for node in nodes)):
            for node in nodes:
                self._drop(node, reason)
            return
        if len(nodes) > 1:
            self._on_note(f"{reason}; its nodes go on in processes of their own")
        for node in nodes:
            self._schedule_restart(node, reason if len(nodes) == 1 else f"node {node.row.name} ended with it")

    def _schedule_restart(self, node: SupervisedNode, reason: str) -> None:
        now_s, maximum = time.monotonic(), node.row.max_restarts
        node.exits_s.append(now_s)
        while now_s - node.exits_s[0] > RESTART_WINDOW_S:
            node.exits_s.popleft()
        exits = len(node.exits_s)
        if exits > maximum:
            self._drop(node, f"{reason} ({exits} times within {RESTART_WINDOW_S:.0f} s)")
            return
        node.restarts += 1
        node.start_s = now_s + BACK_OFF_S * 2 ** (exits - 1)
        self._on_note(f"{reason}; it is restarted ({exits} of {maximum} within {RESTART_WINDOW_S:.0f} s)")

    def _drop(self, node: SupervisedNode, reason: str) -> None:
        """Continue without a node; raises NodeError if the mission requires it."""
        if node.row.needed or (node.row.on_request and not self.brought_up):
            raise NodeError(reason)
        self._on_note(f"{reason}; the mission goes on without it")
        if node.process is not None:
            node.process.terminate()
            node.process.wait(time.monotonic() + node.row.stop_timeout_s)
        self.nodes.remove(node)

    def release(self, name: str) -> NodeProcess | None:
        """Supervise a node no more: the caller stops its process. None: it does not run.

        Other nodes of its process are shut down.
        """
        released = next((node for node in self.nodes if node.row.name == name), None)
        if released is None:
            return None
        self.nodes.remove(released)
        process = released.process
        for node in [node for node in self.nodes if process is not None and node.process is process]:
            self._shut_down(node)
            self.nodes.remove(node)
        return process

    def _shut_down(self, node: SupervisedNode) -> None:
        """Shut down one node of a process."""
        process, deadline_s = node.process, time.monotonic() + node.row.stop_timeout_s
        assert process is not None
        process.command(SHUT_DOWN, node.row.name)
        while not process.has_ended and time.monotonic() < deadline_s:
            process.receive_reports(0.0)
            report = process.reports.get(node.row.name)
            if report is not None and report.state == FINALIZED:
                return
            time.sleep(STOP_POLL_S)

    def stop(self, meanwhile: Callable[[], None] = lambda: None) -> dict[str, int]:
        """Stop all nodes, higher ranks first; returns exit statuses by process name.

        A rank gets SIGTERM when all higher ranks are finalized, so that the recorder receives their last
        messages. The processes then end in parallel; `meanwhile` is called before their ends are waited for.
        """
        deadlines_s: dict[NodeProcess, float] = {}
        running = [(node.row, node.process) for node in self.nodes if node.process is not None]
        for rank in sorted({row.rank for row, _ in running}, reverse=True):
            group = {process: row.stop_timeout_s for row, process in running if row.rank == rank}
            for process in group.keys() - deadlines_s.keys():
                process.terminate()
                deadlines_s[process] = time.monotonic() + group[process]
            for process in group:
                while not process.is_finalized:
                    if time.monotonic() > deadlines_s[process]:
                        process.kill("did not stop")
                        break
                    time.sleep(STOP_POLL_S)
        meanwhile()
        statuses = {process.name: process.wait(deadline_s) for process, deadline_s in deadlines_s.items()}
        self.nodes = []
        return statuses
