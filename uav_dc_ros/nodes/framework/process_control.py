"""How run_all controls the processes of its nodes: commands through standard input, reports through a pipe.

run_all does not use the lifecycle services: ROS finds a service by its name, so a request may reach a node of
another mission in the same namespace. A pipe connects two processes only, and neither loses nor repeats.
"""

import contextlib
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from uav_dc_ros.nodes.framework.lifecycle_node import ManagedNode

SUPERVISED = "UAV_DC_ROS_SUPERVISED"  # set by run_all: how often this process has been restarted
REPORTS = "UAV_DC_ROS_REPORTS"  # set by run_all: the file descriptor for the reports
PERIOD_S = 0.25  # of the reports
CONFIGURE, ACTIVATE = "configure", "activate"
STATES = {CONFIGURE: "inactive", ACTIVATE: "active"}  # after each transition
FINALIZED = "finalized"  # the state in which a node publishes no more
REASON_MAX = 1000  # characters; a report is shorter than what a pipe writes atomically


class NodeReport(msgspec.Struct, frozen=True):
    """State of a node's life cycle, and why its last transition failed (None: it did not)."""

    state: str
    refused: str | None = None


decode = msgspec.json.Decoder(dict[str, NodeReport]).decode  # a line of reports, by name of the node


def command(transition: str, node: str) -> bytes:
    """A line that commands a transition of a node."""
    return f"{transition} {node}\n".encode()


def make_transition(node: "ManagedNode", transition: str) -> bool:
    """Make a transition of a node; returns whether it succeeded."""
    if transition == CONFIGURE:
        node.trigger_configure()
    else:
        node.trigger_activate()
    return node.state == STATES[transition]


class Reporter:
    """The nodes' end: makes the commanded transitions, and reports.

    A report is also a heartbeat: the executor's thread sends one every `PERIOD_S`. A callback that hangs
    stops them.
    """

    def __init__(self, nodes: "Sequence[ManagedNode]") -> None:
        self._nodes = {node.row.name: node for node in nodes}
        self._refused: dict[str, str] = {}
        self._pipe: int | None = int(os.environ[REPORTS]) if REPORTS in os.environ else None
        if self._pipe is not None:
            os.set_blocking(self._pipe, False)

    def report(self) -> None:
        """Report all nodes."""
        if self._pipe is None:
            return
        reports = {
            name: NodeReport(node.state, self._refused.get(name)) for name, node in self._nodes.items()
        }
        # The pipe is full while run_all is suspended, and closed once it has ended: see StopMonitor.
        with contextlib.suppress(OSError):
            os.write(self._pipe, msgspec.json.encode(reports) + b"\n")

    def execute(self, line: str) -> None:
        """Make the transition that a line commands, and report."""
        transition, name = line.split()
        node = self._nodes[name]
        self._refused.pop(name, None)
        if not make_transition(node, transition):
            self._refused[name] = str(node.failure or "it failed; see its log")[:REASON_MAX]
        self.report()
