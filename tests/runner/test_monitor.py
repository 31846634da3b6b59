"""The mission monitor: missions of its run, whose end may come before their rates, and of other runs."""

import json
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import rclpy

from tests.conftest import Ros
from uav_dc_ros import cdr, messages, scenarios
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.framework import other_publishers
from uav_dc_ros.nodes.framework.other_publishers import AnotherMissionError
from uav_dc_ros.runner import monitor
from uav_dc_ros.runner.monitor import (
    ALONE_S,
    CHECK_S,
    IDENTIFY_S,
    STARTED_S,
    MissionMonitor,
    MonitoredMission,
)

STEPS = 3
MBIT = 1e6
RUN, OTHER = "0123456789abcdef", "fedcba9876543210"


def mission(scenario: Scenario, step: int) -> messages.Mission:
    """The state at a step of a mission that goes east, and is aborted after a few."""
    return messages.Mission(
        run=RUN,
        mission=0,
        step=step,
        phase=Phase.READY if step < STEPS else Phase.ABORTED,
        cell=(min(step, 2), 0, 0),
        remaining_steps=scenario.mission.max_steps - step,
        seed=0,
        scenario=scenario.name,
        fingerprint=scenario.fingerprint,
    )


def rates(scenario: Scenario, step: int) -> messages.Rates:
    """A megabit of the first user in each step."""
    nothing = [0.0] * scenario.n_users
    return messages.Rates(
        run=RUN,
        mission=0,
        step=step,
        sum_rate_bps=MBIT if step else 0.0,
        sinr=nothing,
        rate_bps=nothing,
        data_bits=[step * MBIT, *nothing[1:]],
        served=[False] * scenario.n_users,
        collected=[False] * scenario.n_users,
    )


class Bench:
    """Monitors in this process, with the graph and the time of a test."""

    def __init__(self, scenario: Scenario, patch: pytest.MonkeyPatch) -> None:
        self.scenario = scenario
        self.now_s = 1000.0
        self.ends: list[MonitoredMission] = []
        self.notes: list[str] = []
        self.publishers: dict[str, list[str]] = {}  # by topic
        self.nodes: list[MissionMonitor] = []
        patch.setattr(monitor.time, "monotonic", lambda: self.now_s)
        patch.setattr(other_publishers, "publishers", lambda node: self.publishers)

    def monitor(self, run: str = RUN) -> MissionMonitor:
        """A monitor of run_all, on the vehicle's host if it has a run."""
        node = MissionMonitor(
            *(self.scenario, 0 if run else None, run, ["world", "policy"]),
            ["world", "policy"] if run else ["policy"],
            *(lambda _: None, lambda _: None, self.ends.append),
            self.notes.append,
        )
        self.nodes.append(node)
        node.trigger_configure()
        node.trigger_activate()
        return node

    def checks(self, node: MissionMonitor, seconds: float, *, have_started: bool = True) -> None:
        """Check for other publishers, more often than run_all does."""
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            self.now_s += 0.05
            node.check_publishers(have_started)


@pytest.fixture
def bench(ros: Ros, small_scenario: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Monitors of small missions."""
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOG_DIR"):
        monkeypatch.setenv(name, ros.environment[name])
    rclpy.init()
    bench = Bench(scenarios.load(small_scenario), monkeypatch)
    yield bench
    for node in bench.nodes:
        node.trigger_shutdown()
        node.destroy_node()
    rclpy.shutdown()


@pytest.mark.parametrize("received", [STEPS + 1, 2, 0])
def test_the_end_is_received_before_the_rates(bench: Bench, received: int) -> None:
    """A monitor receives topic by topic, and a lockstep may fly a mission between two turns."""
    node = bench.monitor()
    for step in range(STEPS + 1):
        node.on_mission(mission(bench.scenario, step))
    for step in range(received):
        node.on_rates(rates(bench.scenario, step))
    bench.now_s += 10.0
    node.report_ends(waited_s=5.0)
    (ended,) = bench.ends
    summary = ended.summary(bench.scenario, "policy", None)
    last = max(received - 1, 0)
    assert (summary.outcome, summary.steps, summary.data_bits) == (Phase.ABORTED, STEPS, last * MBIT)
    assert summary.sum_rate_bps == (MBIT if last else 0.0), "the mean of the steps with rates"
    if received == STEPS + 1:
        assert bench.notes == []
    else:
        of = f"those of step {last}" if received else "unknown"
        missed = f"mission 0: rates of step {STEPS} were not received; its users and data are {of}"
        assert bench.notes == [missed]
    assert summary.distance_m == 100.0 * min(last, 2)


def test_nodes_begin_after_a_while_without_another_mission(bench: Bench) -> None:
    node = bench.monitor()
    bench.checks(node, ALONE_S / 2)
    assert not node.is_alone
    bench.checks(node, ALONE_S)
    assert node.is_alone


def test_nodes_that_start_slowly_are_waited_for(bench: Bench) -> None:
    """Discovery takes long, too, then."""
    node = bench.monitor()
    bench.checks(node, 10 * ALONE_S, have_started=False)
    assert not node.is_alone
    bench.checks(node, STARTED_S / 2)
    assert not node.is_alone
    bench.checks(node, STARTED_S + CHECK_S)
    assert node.is_alone


def test_another_mission_is_refused_by_the_names_of_its_nodes_and_its_run(bench: Bench) -> None:
    node = bench.monitor()
    bench.publishers = {"mission": ["/world"], "move": ["/policy"]}
    bench.checks(node, IDENTIFY_S / 2)
    with pytest.raises(MessageError, match="belongs to run"):
        node.check_run("mission", OTHER)
    with pytest.raises(AnotherMissionError, match=rf"flown here by /world, /policy \(run {OTHER}\): give"):
        bench.checks(node, 0.2)


@pytest.mark.parametrize("silent", [True, False])
def test_another_mission_is_refused_when_only_half_of_that_is_known(bench: Bench, silent: bool) -> None:
    node = bench.monitor()
    if silent:
        bench.publishers = {"mission": ["/world"]}
    else:
        with pytest.raises(MessageError):
            node.check_run("rates", OTHER)
    who = " by /world" if silent else rf" \(run {OTHER}\)"
    with pytest.raises(AnotherMissionError, match=f"another mission is being flown here{who}: give"):
        bench.checks(node, IDENTIFY_S + 0.2)


def test_a_mission_that_has_begun_is_not_ended_by_a_player(bench: Bench) -> None:
    node = bench.monitor()
    bench.checks(node, ALONE_S + 0.1)
    node.on_mission(mission(bench.scenario, 0))
    bench.publishers = {"mission": ["/world", "/player"], "pose": ["/world", "/player"]}
    for topic in ("mission", "rates"):
        with pytest.raises(MessageError):
            node.check_run(topic, OTHER)
    bench.checks(node, 5.0)
    assert [note.partition(" here")[0] for note in bench.notes] == ["/player publishes mission, pose"]


def test_a_host_without_the_vehicle_adopts_its_run(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    node = bench.monitor(run="")
    monkeypatch.setattr(node, "count_publishers", lambda topic: 1)
    node.check_run("mission", RUN)
    assert node.run == RUN
    monkeypatch.setattr(node, "count_publishers", lambda topic: 2)
    with pytest.raises(MessageError):
        node.check_run("mission", OTHER)
    monkeypatch.setattr(node, "count_publishers", lambda topic: 1)
    node.check_run("mission", OTHER)  # the vehicle was started anew: it is the only one
    assert node.run == OTHER


def test_a_host_without_the_vehicle_adopts_no_player_s(bench: Bench) -> None:
    node = bench.monitor(run="")
    node.check_run("mission", OTHER)
    bench.publishers = {"mission": ["/player"]}
    with pytest.raises(AnotherMissionError, match="/player publishes mission here, and is no node of"):
        bench.checks(node, IDENTIFY_S + 0.2)


def test_who_keeps_messages_as_bytes_knows_those_of_another_run(bench: Bench) -> None:
    """What is no payload is not another run's: who decodes it refuses it, and a recorder keeps it."""
    node = bench.monitor()
    ours = json.loads(messages.encode(mission(bench.scenario, 0)))
    reordered = dict(reversed(ours.items()))
    for text, expected in (
        (messages.encode(mission(bench.scenario, 0)).decode(), False),
        (json.dumps(reordered), False),
        (json.dumps(ours | {"run": OTHER}), True),
        (json.dumps({name: value for name, value in ours.items() if name != "run"}), True),
        ('{"run": 7}', False),
        ('{"run":', False),
    ):
        assert node.is_of_another_run("mission", cdr.encode_string(text.encode())) is expected, text
    assert node.statistics.rejected["mission", "another_run"] == 2
    assert not node.is_of_another_run("path", b"")


def test_a_lie_about_the_seed_ends_no_mission(bench: Bench) -> None:
    node = bench.monitor()
    with pytest.raises(MessageError, match="mission 0 has seed 7; expected 0"):
        node.on_mission(msgspec.structs.replace(mission(bench.scenario, 1), seed=7))
