"""Several nodes in one process: what run_all puts there, and the container by itself.

That such a mission is the same as one with a process for each node, to the last bit, and what happens when
the container is killed: test_flight and test_kills. That a lockstep has one by default: test_faults, too.
"""

import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import PATIENCE_S, Ros, finish, read_bag, wait_for
from tests.runner.test_options import refused

COMPOSED = ("world", "channel_monitor", "policy")
ONLY_COMPOSED = ("--no-record", "--nodes", ",".join(COMPOSED))


@pytest.fixture
def flight(small_scenario: Path, small_policy: Path) -> list[object]:
    """Options of a small mission."""
    return ["--scenario", small_scenario, "--policy", small_policy]


def modules(ros: Ros) -> set[str]:
    """Names of the processes that run nodes."""
    commands = (command.split() for command in ros.processes().values())
    return {
        argument.removeprefix("uav_dc_ros.nodes.")
        for command in commands
        for argument in command
        if argument.startswith("uav_dc_ros.nodes.")
    }


def flying(ros: Ros, *options: object) -> tuple[subprocess.Popen[str], set[str]]:
    """A mission that has come to its fifth step, and the processes of its nodes."""
    process = ros.start("uav_dc_ros.run_all", *options, "--bag", "bag", "--summary", "summary.json")
    assert process.stdout is not None
    wait_for(process.stdout, "step 5/30")
    return process, modules(ros)


@pytest.mark.parametrize(
    ("options", "shares"),
    [
        pytest.param(("--pace", 100), False, marks=pytest.mark.long),
        pytest.param(("--pace", "lockstep", "--missions", 200), True, marks=pytest.mark.long),
        pytest.param(("--pace", 100, "--compose"), True, marks=pytest.mark.long),
        pytest.param(
            ("--pace", "lockstep", "--missions", 200, "--no-compose"), False, marks=pytest.mark.long
        ),
    ],
)
def test_who_shares_a_process(
    ros: Ros, flight: list[object], options: tuple[object, ...], shares: bool
) -> None:
    process, running = flying(ros, *flight, *options)
    process.send_signal(signal.SIGINT)
    status, output = finish(process)
    assert status == 130, output
    assert "Traceback" not in output
    assert running == {"recorder", "visualizer", *(["container"] if shares else COMPOSED)}


@pytest.mark.long
def test_a_composed_mission_says_who_shares_a_process(ros: Ros, flight: list[object]) -> None:
    process, _ = flying(ros, *flight, "--pace", 100, "--compose")
    status, output = finish(process)
    assert status == 0, output
    assert json.loads((ros.folder / "summary.json").read_text())["steps"] == 30
    ids: dict[str, set[str]] = {}
    for topic, message in read_bag(ros.folder / "bag"):
        if topic == "/diagnostics":
            for reported in message.status:
                values = {pair.key: pair.value for pair in reported.values}
                ids.setdefault(reported.name, set()).add(values["process id"])
    shared = {node: ids[node] for node in COMPOSED}
    assert len(set.union(*shared.values())) == 1
    assert len(set.union(*ids.values())) == len(ids) - len(COMPOSED) + 1


@pytest.mark.long
def test_the_page_stays_while_the_visualizer_beside_it_ends(ros: Ros, flight: list[object]) -> None:
    """A page that stays open in a terminal is served by a process in which the visualizer flew, too."""
    ours, theirs = os.openpty()
    options = (*flight, "--pace", "lockstep", "--missions", 3, "--view", 0, "--bag", "bag")
    terminal = subprocess.Popen(
        [sys.executable, "-m", "uav_dc_ros.run_all", *map(str, options)],
        env=ros.environment,
        cwd=ros.folder,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    )
    os.close(theirs)
    output = ""
    while not (stays := re.search(r"the page stays at (http://\S+) until Ctrl-C", output)):
        assert select.select([ours], [], [], PATIENCE_S)[0], output
        output += os.read(ours, 1 << 16).decode()
    running = list(ros.processes().values())
    assert sum("nodes.container visualizer web_view " in command for command in running) == 1, running
    assert not any("nodes.recorder" in command or "nodes.container world" in command for command in running)
    with urllib.request.urlopen(stays[1], timeout=PATIENCE_S) as answer:
        assert answer.status == 200
    paths = [message for topic, message in read_bag(ros.folder / "bag") if topic == "/path"]
    assert len(paths[-1].poses) == 31, "the last mission is drawn to its end"
    terminal.send_signal(signal.SIGINT)
    while select.select([ours], [], [], PATIENCE_S)[0]:
        try:
            output += os.read(ours, 1 << 16).decode()
        except OSError:  # the last process has closed the terminal
            break
    os.close(ours)
    assert terminal.wait(PATIENCE_S) == 0, output
    assert ros.gone()


def test_composing_what_cannot_be_composed(ros: Ros) -> None:
    reported = refused(ros, "--compose", "--nodes", "policy,recorder")
    assert (
        "--compose: expected two of world, channel_monitor, policy among --nodes policy,recorder" in reported
    )


@pytest.mark.parametrize(
    ("given", "reported"),
    [
        pytest.param((), "the following arguments are required: NODE", marks=pytest.mark.long),
        (("recorder",), "argument NODE: invalid choice: 'recorder' (choose from "),
        pytest.param(
            ("world", "policy", "--ros-args", "-p"),
            "expected ROS arguments after --ros-args",
            marks=pytest.mark.long,
        ),
        (("world", "policy", "--ros-args", "-p", "seed:=1"), "seed: no such parameter of node policy"),
    ],
)
def test_mistakes(ros: Ros, given: tuple[str, ...], reported: str) -> None:
    status, output = ros.run_fork("uav_dc_ros.nodes.container", *given)
    assert status == 2, output
    assert reported in output
    assert "Traceback" not in output


def parameters(folder: Path, **of_nodes: dict[str, Any]) -> Path:
    """A file of parameters, as ROS reads it."""
    path = folder / "mission.yaml"
    path.write_text(
        json.dumps({f"/**/{node}": {"ros__parameters": values} for node, values in of_nodes.items()})
    )
    return path


def test_alone_it_flies_a_mission(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    """Started by hand, with the recorder and run_all's own eyes elsewhere."""
    world = {"scenario": str(small_scenario), "peers": [*COMPOSED, "recorder", "mission_monitor"]}
    file = parameters(
        ros.folder,
        world={**world, "pace": "lockstep"},
        channel_monitor=world,
        policy={**world, "policy": str(small_policy)},
    )
    given = ("policy", "world", "channel_monitor", "--ros-args", "--params-file", file, "-r", "__ns:=/uav1")
    container = ros.start("uav_dc_ros.nodes.container", *given, "-r", "/clock:=clock")
    seen = ("--namespace", "/uav1", "--nodes", "recorder", "--pace", "lockstep", "--bag", "bag")
    given = ("--scenario", small_scenario, "--policy", small_policy, *seen)
    status, output = ros.run_all(*given)
    assert status == 0, output
    container.send_signal(signal.SIGTERM)
    status, output = finish(container)
    assert status == 0, output
    missions = [message for topic, message in read_bag(ros.folder / "bag") if topic == "/uav1/mission"]
    assert [mission["step"] for mission in missions] == list(range(31))


def test_one_node_that_cannot_begin_lets_none_begin(ros: Ros, small_policy: Path) -> None:
    """The policy is for another world."""
    file = parameters(
        ros.folder,
        world={"scenario": "three_clusters_hover"},
        channel_monitor={"scenario": "three_clusters_hover"},
        policy={"scenario": "three_clusters_hover", "policy": str(small_policy)},
    )
    given = ("--ros-args", "--params-file", file)
    status, output = ros.run_fork("uav_dc_ros.nodes.container", *COMPOSED, *given)
    assert status == 2, output
    assert "[policy]: policy " in output
    assert "Traceback" not in output


def test_a_line_of_a_shared_process_says_whose_it_is(ros: Ros, flight: list[object]) -> None:
    given = (*flight, *ONLY_COMPOSED, "--pace", "lockstep", "--set", "channel_monitor.journal=/dev/full")
    status, output = ros.run_all(*given)
    assert status == 1, output
    reported = "journal /dev/full: it is no file; expected one, or a new one"
    assert f"container: ERROR: channel_monitor: {reported}" in output
    assert f"error: node channel_monitor could not be configured: {reported}" in output


def test_a_node_that_gives_up_takes_the_others_with_it(ros: Ros, flight: list[object]) -> None:
    """The channel monitor's journal comes to a limit on the size of files; no recorder meets it first."""
    process = ros.start(
        "uav_dc_ros.run_all",
        *(*flight, *ONLY_COMPOSED, "--pace", "lockstep"),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, 8_000)),
    )
    status, output = finish(process)
    assert status == 1, output
    reported = "error: the container of world, channel_monitor, policy ended with 3: error: journal "
    assert reported in output
    assert "File too large" in output
    assert "Traceback" not in output
