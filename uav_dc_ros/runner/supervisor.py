"""Brings nodes up in order, watches them, starts dead ones again, and takes them down in reverse."""

import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.framework.node_main import EXIT_FAILED, EXIT_NOT_STARTED
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.process_control import ACTIVATE, CONFIGURE
from uav_dc_ros.runner.node_process import NodeProcess

RESTART_WINDOW_S = 60.0  # deaths longer ago are forgiven
BACK_OFF_S = 0.2  # before the first restart; twice as long before each further one
BEGIN_S = 25.0  # a process may be silent for so long while it starts, or its nodes configure and activate
PASSED_MAX_S = 0.5  # from one look at reports to the next: more was a pause of this process itself
STOP_S = 10.0  # for a node to end after it was asked to: a bridge waits for its vehicle to obey
STOP_LOOK_S = 0.002  # from one look at a node that was asked to stop to the next
UP = ("unconfigured", "inactive", "active")  # the way up; each transition leads to the next
TRANSITIONS = {"unconfigured": CONFIGURE, "inactive": ACTIVATE}


class SupervisedNode:
    """One node: its process, which others may share, and how far it has come.

    Attributes:
        state: of its life cycle, as reported last; none before its process has reported. Once it is active,
            others may change it by the services of the life cycle: that is not undone.
        restarts: how often it was started again.
    """

    def __init__(self, name: str, parameters: Mapping[str, object]) -> None:
        self.row = NODES[name]
        self.parameters = dict(parameters)
        self.state: str | None = None
        self.restarts = 0
        self.process: NodeProcess | None = None
        self.start_s = 0.0  # when to start it, while there is no process
        self.deaths_s: deque[float] = deque()
        self._commanded: str | None = None  # the last transition

    def begin(self, process: NodeProcess) -> None:
        """Take charge of a new process."""
        self.process, self.state, self._commanded = process, None, None

    def bring_up(self, may_activate: bool) -> None:
        """Command the next transition on the way up, once.

        Raises:
            NodeError: the node refuses it, or is in a state from which no way leads up.
        """
        assert self.process is not None, "otherwise there is nobody to command"
        report = self.process.reports.get(self.row.name)
        if report is None:
            return
        self.state = report.state
        if report.refused is not None:
            wanted = {CONFIGURE: "configured", ACTIVATE: "activated"}[self._commanded or CONFIGURE]
            raise NodeError(f"node {self.row.name} could not be {wanted}: {report.refused}")
        if report.state not in UP:
            raise NodeError(f"node {self.row.name} is {report.state}; expected some of {', '.join(UP)}")
        transition = TRANSITIONS.get(report.state)
        if transition in (None, self._commanded) or (transition == ACTIVATE and not may_activate):
            return
        self._commanded = transition
        self.process.command(transition, self.row.name)


class Supervisor:
    """The nodes of a mission on this host; a context manager that leaves no process behind.

    Args:
        namespace: of the mission.
        parameters: ROS parameters of each node to run, by name.
        together: names of those that share a process. After its end each gets one of its own: the one that
            was to blame shows itself, and takes nobody with it.
        folder: for files of the processes.
        on_line: called, from threads, with each line that a node prints.
        on_note: called with what the user should know.

    Attributes:
        brought_up: were all nodes active at once?
    """

    def __init__(
        self,
        namespace: str,
        parameters: Mapping[str, Mapping[str, object]],
        together: Collection[str],
        folder: Path,
        on_line: Callable[[str, str], None],
        on_note: Callable[[str], None],
    ) -> None:
        self._namespace = namespace
        self._together, self._folder = together, folder
        self._on_line, self._on_note = on_line, on_note
        self.nodes = [SupervisedNode(name, values) for name, values in parameters.items()]
        self.brought_up = False
        self._ticked_s = time.monotonic()

    def __enter__(self) -> Self:
        """Start the processes."""
        shared = [node for node in self.nodes if node.row.name in self._together]
        for nodes in (shared, *([node] for node in self.nodes if node not in shared)):
            if nodes:
                self._start(nodes)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop whatever still runs."""
        self.stop()

    @property
    def restarts(self) -> dict[str, int]:
        """How often each node was started again."""
        return {node.row.name: node.restarts for node in self.nodes}

    @property
    def have_started(self) -> bool:
        """Has every node started so far that it reports."""
        return all(node.process is not None and bool(node.process.reports) for node in self.nodes)

    def _start(self, nodes: Sequence[SupervisedNode]) -> None:
        """Start a process of these nodes."""
        parameters = {
            node.row.name: {
                **node.parameters,
                **(node.row.restart_parameters if node.restarts else {}),
                "autostart": False,
            }
            for node in nodes
        }
        process = NodeProcess(parameters, self._namespace, nodes[0].restarts, self._folder, self._on_line)
        for node in nodes:
            node.begin(process)

    def tick(self, may_begin: bool) -> None:
        """Go on with whatever is to be done; to be called often.

        Args:
            may_begin: may the nodes be configured and activated by now?

        Raises:
            NodeError: a node that is needed refuses to start, gave up, or keeps dying.
        """
        self._watch_reports()
        for node in list(self.nodes):
            if node.process is None:
                if time.monotonic() >= node.start_s:
                    self._start([node])
            elif node.process.ended:
                self._bury(node.process)
            elif may_begin and node.state != "active":
                try:
                    node.bring_up(self.brought_up or self._lower_ranks_are_active(node))
                except NodeError as error:
                    self._lose(node, str(error))
        self.brought_up = self.brought_up or all(node.state == "active" for node in self.nodes)

    def _watch_reports(self) -> None:
        """Kill processes that hang: their ends are seen as any other."""
        now_s, before_s = time.monotonic(), self._ticked_s
        self._ticked_s = now_s
        for process in {node.process for node in self.nodes if node.process is not None}:
            process.watch(min(now_s - before_s, PASSED_MAX_S))
            nodes = [node for node in self.nodes if node.process is process]
            active = all(node.state == "active" for node in nodes)
            patience_s = max(node.row.hang_timeout_s for node in nodes) if active else BEGIN_S
            if process.silent_s > patience_s and not process.ended:
                process.kill(f"gave no sign of life for {patience_s:.0f} s")

    def _lower_ranks_are_active(self, node: SupervisedNode) -> bool:
        return all(
            other.state == "active"
            for other in self.nodes
            if other.row.rank < node.row.rank and (other.row.needed or other.row.on_request)
        )

    def _bury(self, process: NodeProcess) -> None:
        """A process has ended: start its nodes again later, each by itself, or give up."""
        told = f"{process.who} {process.how_it_ended()}"
        process.close()
        nodes = [node for node in self.nodes if node.process is process]
        for node in nodes:
            node.process, node.state = None, None
        if process.process.returncode in (EXIT_NOT_STARTED, EXIT_FAILED):  # it told why; it would do so again
            for node in nodes:
                self._lose(node, told)
            return
        if len(nodes) > 1:
            self._on_note(f"{told}; its nodes go on in processes of their own")
        for node in nodes:
            self._start_again_later(node, told if len(nodes) == 1 else f"node {node.row.name} ended with it")

    def _start_again_later(self, node: SupervisedNode, told: str) -> None:
        """Let a node that died rest for a while, or, if it has died too often, give up."""
        now_s, most = time.monotonic(), node.row.max_restarts
        node.deaths_s.append(now_s)
        while now_s - node.deaths_s[0] > RESTART_WINDOW_S:
            node.deaths_s.popleft()
        deaths = len(node.deaths_s)
        if deaths > most:
            self._lose(node, f"{told} ({deaths} times within {RESTART_WINDOW_S:.0f} s)")
            return
        node.restarts += 1
        node.start_s = now_s + BACK_OFF_S * 2 ** (deaths - 1)
        self._on_note(f"{told}; it is started again ({deaths} of {most} within {RESTART_WINDOW_S:.0f} s)")

    def _lose(self, node: SupervisedNode, why: str) -> None:
        """Do without a node from now on.

        Raises:
            NodeError: no mission can be flown without it.
        """
        if node.row.needed or (node.row.on_request and not self.brought_up):
            raise NodeError(why)
        self._on_note(f"{why}; the mission goes on without it")
        if node.process is not None:
            node.process.ask_to_stop()
            node.process.wait(time.monotonic() + STOP_S)
        self.nodes.remove(node)

    def stop(self, meanwhile: Callable[[], None] = lambda: None) -> dict[str, int]:
        """Stop all nodes, higher ranks of the node table first. Returns their exit statuses.

        A rank is asked to stop when those above it have said their last, so that the recorder hears all of
        it. The processes then end side by side.

        Args:
            meanwhile: called when all were asked to stop, before their ends are waited for.
        """
        statuses: dict[str, int] = {}
        asked: dict[NodeProcess, float] = {}  # and until when each may take its time, monotonic clock
        running = {node.row.name: node.process for node in self.nodes if node.process is not None}
        for rank in sorted({NODES[name].rank for name in running}, reverse=True):
            group = {process for name, process in running.items() if NODES[name].rank == rank}
            for process in group - asked.keys():
                process.ask_to_stop()
                asked[process] = time.monotonic() + STOP_S
            for process in group:
                while not process.is_silent:
                    if time.monotonic() > asked[process]:
                        process.kill("did not stop")
                        break
                    time.sleep(STOP_LOOK_S)
        meanwhile()
        for process, deadline_s in asked.items():
            statuses[process.name] = process.wait(deadline_s)
        self.nodes = []
        return statuses
