"""How run_all controls the processes of its nodes: commands through standard input, reports through a pipe.

run_all does not use the lifecycle services: ROS finds a service by its name, so a request may reach a node of
another mission in the same namespace. A pipe connects two processes only, and neither loses nor repeats.
"""

import msgspec

SUPERVISED = "UAV_DC_ROS_SUPERVISED"  # set by run_all: how often this process has been restarted
REPORTS = "UAV_DC_ROS_REPORTS"  # set by run_all: the file descriptor for the reports
PERIOD_S = 0.25  # of the reports
CONFIGURE, ACTIVATE, SHUT_DOWN = "configure", "activate", "shutdown"
FINALIZED = "finalized"  # the state in which a node publishes no more
STATES = {CONFIGURE: "inactive", ACTIVATE: "active", SHUT_DOWN: FINALIZED}  # after each transition
REASON_MAX = 1000  # characters; a report is shorter than what a pipe writes atomically


class NodeReport(msgspec.Struct, frozen=True):
    """State of a node's life cycle, and why its last transition failed (None: it did not).

    `caught_up`: see `MissionNode.is_caught_up`.
    """

    state: str
    refused: str | None = None
    caught_up: bool = False


decode = msgspec.json.Decoder(dict[str, NodeReport]).decode  # a line of reports, by name of the node


def command(transition: str, node: str) -> bytes:
    """A line that commands a transition of a node."""
    return f"{transition} {node}\n".encode()
