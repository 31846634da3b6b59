"""The way up of a node: each transition is commanded once, whatever is reported meanwhile."""

from collections.abc import Callable

import pytest

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.control import NodeReport, command
from uav_dc_ros.nodes.supervisor import Supervised


class Process:
    """A process whose reports a test makes."""

    def __init__(self) -> None:
        self.reports: dict[str, NodeReport] = {}
        self.commands: list[bytes] = []

    def command(self, transition: str, node: str) -> None:
        """Note it."""
        self.commands.append(command(transition, node))


@pytest.fixture
def process() -> Process:
    """A process that has just been started."""
    return Process()


@pytest.fixture
def turn(process: Process) -> Callable[..., str | None]:
    """A turn of run_all, after the node has reported this."""
    node = Supervised("policy", {})
    node.begin(process)  # type: ignore[arg-type]

    def turn(*report: str, may_activate: bool = True) -> str | None:
        if report:
            process.reports["policy"] = NodeReport(*report)
        node.bring_up(may_activate)
        return node.state

    return turn


def test_a_node_goes_up_and_each_transition_is_commanded_once(
    process: Process, turn: Callable[..., str | None]
) -> None:
    assert turn() is None
    assert process.commands == [], "it has not started"
    for _ in range(3):
        assert turn("unconfigured") == "unconfigured"
    assert process.commands == [b"configure policy\n"]
    for _ in range(3):
        turn("inactive", may_activate=False)
    assert process.commands == [b"configure policy\n"], "others come first"
    for _ in range(3):
        turn("inactive")
    assert turn("active") == "active"
    assert process.commands == [b"configure policy\n", b"activate policy\n"]


def test_a_node_that_somebody_configured_is_activated(
    process: Process, turn: Callable[..., str | None]
) -> None:
    turn("inactive")
    assert process.commands == [b"activate policy\n"]


@pytest.mark.parametrize(("before", "told"), [("unconfigured", "configured"), ("inactive", "activated")])
def test_a_refusal_is_told_with_its_reason(turn: Callable[..., str | None], before: str, told: str) -> None:
    turn(before)
    with pytest.raises(NodeError, match=f"node policy could not be {told}: no policy 'x'"):
        turn(before, "no policy 'x'")


def test_a_node_that_somebody_shut_down_is_told(turn: Callable[..., str | None]) -> None:
    with pytest.raises(NodeError, match="node policy is finalized; expected some of unconfigured"):
        turn("finalized")
