"""The way up of a node: each transition is commanded once, whatever is reported meanwhile."""

from collections.abc import Callable
from pathlib import Path

import pytest

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.framework.process_control import NodeReport, command
from uav_dc_ros.runner.supervisor import SupervisedNode, Supervisor


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
    node = SupervisedNode("policy", {})
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


class Stopping:
    """A process that says its last some looks after it was asked to stop, and notes what is done with it."""

    def __init__(self, name: str, looks: int, told: list[str]) -> None:
        self.name, self._looks, self._told = name, looks, told

    def ask_to_stop(self) -> None:
        """Note it."""
        self._told.append(f"{self.name} asked")

    @property
    def is_silent(self) -> bool:
        """After so many looks."""
        self._looks -= 1
        if self._looks == 0:
            self._told.append(f"{self.name} silent")
        return self._looks <= 0

    def wait(self, deadline_s: float) -> int:
        """Note it."""
        self._told.append(f"{self.name} ended")
        return 0


def test_a_rank_is_asked_to_stop_when_the_one_above_is_silent(tmp_path: Path) -> None:
    told: list[str] = []
    names = ("world", "channel_monitor", "policy", "visualizer", "recorder")
    supervisor = Supervisor(
        "/", {name: {} for name in names}, (), tmp_path, lambda *line: None, lambda note: None
    )
    container = Stopping("container", 3, told)
    processes = {"visualizer": Stopping("visualizer", 2, told), "recorder": Stopping("recorder", 1, told)}
    for node in supervisor.nodes:
        node.begin(processes.get(node.row.name, container))  # type: ignore[arg-type]
    assert supervisor.stop(lambda: told.append("meanwhile")) == dict.fromkeys((*processes, "container"), 0)
    assert told[:6] == [
        *("container asked", "container silent", "visualizer asked", "visualizer silent"),
        *("recorder asked", "recorder silent"),
    ], "the recorder hears all of it"
    assert told[6] == "meanwhile"
    assert sorted(told[7:]) == ["container ended", "recorder ended", "visualizer ended"]
    assert supervisor.stop() == {}
