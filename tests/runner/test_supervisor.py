"""The way up of a node: each transition is commanded once, whatever is reported meanwhile."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.framework.node_main import EXIT_FAILED
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
    node.process = process  # type: ignore[assignment]

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


def test_a_node_that_was_configured_is_activated(process: Process, turn: Callable[..., str | None]) -> None:
    turn("inactive")
    assert process.commands == [b"activate policy\n"]


@pytest.mark.parametrize(("before", "wanted"), [("unconfigured", "configured"), ("inactive", "activated")])
def test_a_refusal_is_reported_with_its_reason(
    turn: Callable[..., str | None], before: str, wanted: str
) -> None:
    turn(before)
    with pytest.raises(NodeError, match=f"node policy could not be {wanted}: no policy 'x'"):
        turn(before, "no policy 'x'")


def test_a_node_that_was_shut_down_is_reported(turn: Callable[..., str | None]) -> None:
    with pytest.raises(NodeError, match="node policy is finalized; expected some of unconfigured"):
        turn("finalized")


class Stopping:
    """A process whose nodes are finalized some polls after SIGTERM, and which logs what is done with it."""

    def __init__(self, name: str, polls: int, log: list[str]) -> None:
        self.name, self._polls, self._log = name, polls, log

    def terminate(self) -> None:
        """Note it."""
        self._log.append(f"{self.name} terminated")

    @property
    def is_finalized(self) -> bool:
        """After so many polls."""
        self._polls -= 1
        if self._polls == 0:
            self._log.append(f"{self.name} finalized")
        return self._polls <= 0

    def wait(self, deadline_s: float) -> int:
        """Note it."""
        self._log.append(f"{self.name} ended")
        return 0


def test_a_rank_is_terminated_when_the_one_above_is_finalized(tmp_path: Path) -> None:
    log: list[str] = []
    names = ("world", "channel_monitor", "policy", "visualizer", "recorder")
    supervisor = Supervisor(
        "/", {name: {} for name in names}, (), tmp_path, lambda *line: None, lambda note: None
    )
    container = Stopping("container", 3, log)
    processes = {"visualizer": Stopping("visualizer", 2, log), "recorder": Stopping("recorder", 1, log)}
    for node in supervisor.nodes:
        node.process = processes.get(node.row.name, container)  # type: ignore[assignment]
    assert supervisor.stop(lambda: log.append("meanwhile")) == dict.fromkeys((*processes, "container"), 0)
    assert log[:6] == [
        *("container terminated", "container finalized", "visualizer terminated", "visualizer finalized"),
        *("recorder terminated", "recorder finalized"),
    ], "the recorder receives all messages"
    assert log[6] == "meanwhile"
    assert sorted(log[7:]) == ["container ended", "recorder ended", "visualizer ended"]
    assert supervisor.stop() == {}


class Failed:
    """The ended process of several nodes."""

    description, has_ended = "the container of visualizer, web_view", True

    def __init__(self) -> None:
        self.process = SimpleNamespace(returncode=EXIT_FAILED)

    def exit_description(self) -> str:
        """How it ended."""
        return "ended with 3: a reason"

    def close(self) -> None:
        """Nothing to close."""


def test_views_of_a_process_that_failed_get_their_own(tmp_path: Path) -> None:
    notes: list[str] = []
    names = ("visualizer", "web_view")
    supervisor = Supervisor(
        "/", {name: {} for name in names}, [names], tmp_path, lambda *_: None, notes.append
    )
    process = Failed()
    for node in supervisor.nodes:
        node.process = process  # type: ignore[assignment]
    supervisor._handle_exit(process)  # type: ignore[arg-type]
    assert [(node.row.name, node.process, node.restarts) for node in supervisor.nodes] == [
        ("visualizer", None, 1),
        ("web_view", None, 1),
    ]
    assert notes[0].endswith("ended with 3: a reason; its nodes go on in processes of their own")
