"""The way up of a node, with replies that are lost, come late, or come twice; and what a silence means."""

from typing import Any

import pytest

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes import supervisor
from uav_dc_ros.nodes.supervisor import ANSWER_S, Supervised

CONFIGURE, ACTIVATE = 1, 3
STATES = {CONFIGURE: ("unconfigured", "inactive"), ACTIVATE: ("inactive", "active")}


class Reply:
    """A future."""

    def __init__(self) -> None:
        self.value: Any = None

    def done(self) -> bool:
        return self.value is not None

    def result(self) -> Any:
        return self.value


class Answer:
    """Of either service: what a test looks at is set."""

    def __init__(self, *, success: bool = True, state: str = "") -> None:
        self.success = success
        self.current_state = self
        self.label = state


class Client:
    """Of a service whose requests a test serves when it pleases."""

    def __init__(self) -> None:
        self.requests: list[tuple[Any, Reply]] = []

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request: Any) -> Reply:
        reply = Reply()
        self.requests.append((request, reply))
        return reply

    def remove_pending_request(self, reply: Reply) -> None:
        """A late reply to it finds nobody."""
        self.requests = [(request, each) for request, each in self.requests if each is not reply]


class Bench:
    """A supervised node, its services, and the time."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.now_s = 100.0
        patch.setattr(supervisor.time, "monotonic", lambda: self.now_s)
        self.get, self.change = Client(), Client()
        self.node = Supervised("policy", {}, self)  # type: ignore[arg-type]
        self.node.process = type("Process", (), {"last_line": "it cannot"})()  # type: ignore[assignment]
        self.state = "unconfigured"
        self.transitions: list[int] = []  # that were made
        self.refuses = False

    def create_client(self, kind: type, name: str) -> Client:
        return self.get if name.endswith("get_state") else self.change

    def serve(self, *, loses_replies: bool = False) -> None:
        """Serve what was requested, as a node does: a transition that its state does not have is refused."""
        for request, reply in self.change.requests:
            before, after = STATES[request.transition.id]
            success = self.state == before and not self.refuses
            if success:
                self.state = after
                self.transitions.append(request.transition.id)
            reply.value = None if loses_replies else Answer(success=success)
        for _, reply in self.get.requests:
            reply.value = None if loses_replies else Answer(state=self.state)
        self.change.requests.clear()
        self.get.requests.clear()

    def climb(self, seconds: float = 0.02) -> None:
        self.node.climb(may_activate=True)
        self.now_s += seconds


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A node that has just been started."""
    return Bench(monkeypatch)


def up(bench: Bench, turns: int = 40) -> int:
    """Climb until the node is active; how many turns it took."""
    for turn in range(turns):
        bench.climb(ANSWER_S / 2)
        bench.serve()
        if bench.node.state == "active":
            return turn
    raise AssertionError(f"still {bench.node.state} after {turns} turns; the node is {bench.state}")


def test_a_node_goes_up(bench: Bench) -> None:
    up(bench)
    assert bench.transitions == [CONFIGURE, ACTIVATE]


@pytest.mark.parametrize("lost", range(8))
def test_a_lost_reply_leaves_no_node_behind(bench: Bench, lost: int) -> None:
    """Whichever reply it is, the node comes up, and makes each transition once."""
    for _ in range(lost):
        bench.climb()
        bench.serve()
    bench.climb()
    bench.serve(loses_replies=True)
    up(bench)
    assert bench.transitions == [CONFIGURE, ACTIVATE]


@pytest.mark.parametrize("lost", range(8))
def test_a_lost_request_is_sent_again(bench: Bench, lost: int) -> None:
    for _ in range(lost):
        bench.climb()
        bench.serve()
    bench.climb()
    bench.change.requests.clear()
    bench.get.requests.clear()
    up(bench)
    assert bench.transitions == [CONFIGURE, ACTIVATE]


def test_a_late_reply_counts_once(bench: Bench) -> None:
    """The transition takes longer than anybody waits, and its reply comes with those about the state."""
    while not bench.change.requests:
        bench.climb()
        if not bench.change.requests:
            bench.serve()
    for _ in range(5):
        bench.climb(2 * ANSWER_S)  # the node loads; nothing is served
    bench.serve()
    up(bench)
    assert bench.transitions == [CONFIGURE, ACTIVATE]


def test_a_request_that_is_served_twice_is_no_refusal(bench: Bench) -> None:
    """The first was late, not lost: the second finds the transition made, and is refused by the node."""
    while not bench.change.requests:
        bench.climb()
        if not bench.change.requests:
            bench.serve()
    late = bench.change.requests.copy()
    bench.change.requests.clear()
    while not bench.change.requests:  # it is sent again, since the node reports the state that it had
        bench.climb(2 * ANSWER_S)
        for _, reply in bench.get.requests:
            reply.value = Answer(state=bench.state)
        bench.get.requests.clear()
    bench.change.requests[:0] = late
    bench.serve()
    up(bench)
    assert bench.transitions == [CONFIGURE, ACTIVATE]


def test_a_refusal_is_told_with_the_node_s_last_line(bench: Bench) -> None:
    bench.refuses = True
    with pytest.raises(NodeError, match="node policy could not be configured: it cannot"):
        up(bench)
    assert bench.transitions == []


def test_a_node_that_somebody_shut_down_is_told(bench: Bench) -> None:
    bench.state = "finalized"
    with pytest.raises(NodeError, match="node policy could not be used as finalized"):
        up(bench)
