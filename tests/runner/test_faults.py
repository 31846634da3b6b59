"""Processes that really get killed: always an end, never a stray process, always a readable bag."""

import json
import os
import re
import resource
import signal
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import PATIENCE_S, WITHOUT_VISUALIZER, Ros, each_once, finish, read_bag, wait_for
from tests.runner.test_container import modules

# Each fixture `ros` asserts at its end that no process of the test is left.

FLYING = "mission: step 5/30"


LATCHED = ("/mission", "/users", "/rates")
COMPOSED = ("--compose",)  # where it is not about one of the nodes: fewer processes to start


@pytest.fixture
def arguments(small_scenario: Path, small_policy: Path, tmp_path: Path) -> list[object]:
    """A mission of twelve seconds, which no test waits for."""
    return [
        *WITHOUT_VISUALIZER,
        *("--scenario", small_scenario, "--policy", small_policy, "--pace", 25),
        *("--bag", tmp_path / "bag", "--summary", tmp_path / "summary.json"),
    ]


def test_ctrl_c_stops_everything_and_leaves_a_readable_bag(
    ros: Ros, arguments: list[object], tmp_path: Path
) -> None:
    process = ros.start("uav_dc_ros.run_all", *arguments, *COMPOSED)
    assert process.stdout is not None
    wait_for(process.stdout, FLYING)
    process.send_signal(signal.SIGINT)
    status, output = finish(process)
    assert status == 130, output
    assert "Traceback" not in output
    messages = read_bag(tmp_path / "bag")
    missions = [message for name, message in messages if name == "/mission"]
    assert [m["step"] for m in missions[:6]] == [0, 1, 2, 3, 4, 5]
    assert missions[-1]["phase"] == "aborted"
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["outcome"] == "aborted"
    assert summary["steps"] == missions[-1]["step"]
    assert (tmp_path / "bag" / "metadata.yaml").is_file()


@pytest.mark.parametrize(
    "node",
    [
        pytest.param("world", marks=pytest.mark.long),
        pytest.param("channel_monitor", marks=pytest.mark.long),
        "policy",
        pytest.param("recorder", marks=pytest.mark.long),
    ],
)
def test_a_node_that_is_killed_is_started_again_and_the_vehicle_hovers_meanwhile(
    ros: Ros, arguments: list[object], tmp_path: Path, node: str
) -> None:
    process = ros.start("uav_dc_ros.run_all", *arguments, "--pace", 60)  # steps of a sixth of a second
    assert process.stdout is not None
    wait_for(process.stdout, FLYING)
    os.kill(ros.node(node), signal.SIGKILL)
    status, output = finish(process)
    assert status == 0, output
    assert f"note: node {node} was killed by SIGKILL" in output
    assert "it is restarted (1 of 3 within 60 s)" in output
    assert "Traceback" not in output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["steps"] == 30
    assert summary["outcome"] in ("landed", "timeout")
    messages = read_bag(tmp_path / "bag")
    missions = {m["step"]: m for name, m in messages if name == "/mission"}
    assert list(missions) == list(range(31))  # also what a recorder missed: `mission` is latched
    if node == "policy":
        assert "steps were hovered: no move came in time" in output
    if node == "channel_monitor":
        data = [sum(m["data_bits"]) for name, m in messages if name == "/rates"]
        assert data == sorted(data), "what was collected is not forgotten"


def test_nodes_end_with_a_launcher_that_is_killed(ros: Ros, arguments: list[object], tmp_path: Path) -> None:
    process = ros.start("uav_dc_ros.run_all", *arguments)
    assert process.stdout is not None
    wait_for(process.stdout, FLYING)
    process.kill()
    finish(process)
    assert ros.gone()
    assert len(read_bag(tmp_path / "bag")) > 20  # the recorder closed it on its own


WITH_LIMIT = """import sys
from uav_dc_ros import run_all
from uav_dc_ros.runner import mission_runner, supervisor
mission_runner.RECORDER_S, supervisor.BACK_OFF_S = float(sys.argv.pop(1)), 4.0
run_all.main()"""


@pytest.mark.long
@pytest.mark.parametrize("limit_s", [PATIENCE_S, 0.0])
def test_a_mission_that_is_over_waits_for_its_recorder(
    ros: Ros, arguments: list[object], tmp_path: Path, limit_s: float
) -> None:
    """The rest of the mission takes less time than the pause before the restart."""
    process = ros.start_command(
        *(sys.executable, "-c", WITH_LIMIT, limit_s, *arguments, *COMPOSED, "--pace", 100)
    )
    assert process.stdout is not None
    wait_for(process.stdout, FLYING)
    os.kill(ros.node("recorder"), signal.SIGKILL)
    status, output = finish(process)
    assert "Traceback" not in output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["outcome"], summary["steps"]) == ("timeout", 30)
    steps = {name: {m["step"] for at, m in read_bag(tmp_path / "bag") if at == name} for name in LATCHED}
    if limit_s:
        assert status == 0, output
        assert "bag_lacks" not in summary
        assert all(found == set(range(31)) for found in steps.values()), steps
    else:
        assert status == 1, output
        recorded = steps["/mission"]  # none, where the recorder was killed before it wrote
        last = f"step {max(recorded)} of mission 0" if recorded else "the start"
        lacks = f"the messages after {last}: the recorder had not caught up after 0 s"
        assert summary["bag_lacks"] == lacks
        assert f"lacks {lacks}" in output


@pytest.mark.long
def test_a_second_mission_on_the_same_network_is_refused_or_unharmed(
    ros: Ros, arguments: list[object], small_scenario: Path, small_policy: Path, tmp_path: Path
) -> None:
    """Discovery takes its time: a short mission may be over before the two know of each other."""
    second = [*("--scenario", small_scenario, "--policy", small_policy), *("--seed", 99, "--no-record")]
    alone, disturbed = tmp_path / "alone.json", tmp_path / "disturbed.json"
    status, output = ros.run_all(*second, "--pace", "lockstep", "--summary", alone)
    assert status == 0, output

    process = ros.start("uav_dc_ros.run_all", *arguments)
    assert process.stdout is not None
    wait_for(process.stdout, FLYING)
    status, output = ros.run_all(*second, "--pace", "lockstep", "--summary", disturbed)
    process.send_signal(signal.SIGINT)
    finish(process)
    if status == 0:
        assert json.loads(disturbed.read_text()) == json.loads(alone.read_text()), output
    else:
        assert status == 1, output
        assert "another mission is being flown here" in output


def test_ctrl_c_while_the_nodes_start(ros: Ros, arguments: list[object]) -> None:
    process = ros.start("uav_dc_ros.run_all", *arguments, *COMPOSED)
    ros.node("recorder")
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    status, output = finish(process)
    assert status == 130, output
    assert "Traceback" not in output


def test_a_full_disk_ends_the_mission_with_its_reason(ros: Ros, arguments: list[object]) -> None:
    """A limit on the size of files stands in for the disk; the kernel's signal is ignored, as Python does."""
    process = ros.start(
        "uav_dc_ros.run_all",
        *arguments,
        *("--missions", 200, "--pace", "lockstep"),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000)),
    )
    status, output = finish(process)
    assert status == 1, output
    assert "error: node recorder ended with 3: error: bag" in output
    assert "cannot be written any further: File too large" in output
    assert "Traceback" not in output


@pytest.mark.long
def test_a_closed_pipe_ends_no_mission(ros: Ros, arguments: list[object], tmp_path: Path) -> None:
    process = ros.start("uav_dc_ros.run_all", *arguments, *("--pace", 100, "--missions", 2))
    assert process.stdout is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(60) == 0
    summaries = json.loads((tmp_path / "summary.json").read_text())
    assert [summary["steps"] for summary in summaries] == [30, 30]


def test_a_summary_names_no_bag_that_was_never_made(
    ros: Ros, arguments: list[object], tmp_path: Path
) -> None:
    process = ros.start("uav_dc_ros.run_all", *arguments)
    ros.node("world")
    process.send_signal(signal.SIGINT)
    status, output = finish(process)
    assert status == 130, output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["bag"] is not None) == (tmp_path / "bag").is_dir()


@pytest.mark.long  # a subscriber that stands still: test_acknowledgements
def test_a_lockstep_waits_for_who_is_held_up(ros: Ros, arguments: list[object], tmp_path: Path) -> None:
    """The recorder, then run_all, stopped for as long as it takes to fly more steps than messages are kept.

    While the recorder stands still, who shares a process can be seen: the flight cannot end meanwhile.
    """
    missions = 56
    process = ros.start("uav_dc_ros.run_all", *arguments, "--pace", "lockstep", "--missions", missions)
    assert process.stdout is not None
    recorder = ros.node("recorder")
    for mission, held_up in ((5, recorder), (28, process.pid)):
        wait_for(process.stdout, f"mission {mission} of")
        os.kill(held_up, signal.SIGSTOP)
        time.sleep(0.8)
        running = modules(ros)
        os.kill(held_up, signal.SIGCONT)
        assert running == {"container", "recorder"}
    status, output = finish(process)
    assert status == 0, output
    # Of the drawings only the newest is kept.
    assert not re.search(r"dropped messages: .*/(users|rates|mission|move|pose|target) ", output), output
    messages = read_bag(tmp_path / "bag")
    expected = [(mission, step) for mission in range(missions) for step in range(31)]
    for topic in ("users", "rates", "mission"):
        told = each_once([(m["mission"], m["step"]) for name, m in messages if name == f"/{topic}"])
        assert told == expected, topic
    assert sum(name == "/pose" for name, _ in messages) >= len(expected)
    summaries = json.loads((tmp_path / "summary.json").read_text())
    assert [summary["steps"] for summary in summaries] == [30] * missions
    rates = [m["sum_rate_bps"] for name, m in messages if name == "/rates" and m["mission"] == missions - 1]
    assert summaries[-1]["sum_rate_bps"] == pytest.approx(sum(rates[-30:]) / 30)
