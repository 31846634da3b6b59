"""Nodes that hang, here by SIGSTOP for good: killed, started again, and the mission goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import PATIENCE_S, WITHOUT_VISUALIZER, Ros, finish, read_bag, until, wait_for
from tests.support.fake_autopilot.flight import fake
from uav_dc_ros.runner.node_process import Silence, waits_for_disk

NODES = ("world", "channel_monitor", "policy", "recorder", "visualizer")
AT_A_PACE = ("--pace", 15)  # twenty seconds: longer than the recorder is waited for
IN_LOCKSTEP = ("--pace", "lockstep", "--missions", 500)


def flown_with_hangs(ros: Ros, options: list[object], names: tuple[str, ...], *how: object) -> str:
    """Fly, and stop nodes for good at the fifth step; what run_all printed."""
    flight = ros.start("uav_dc_ros.run_all", *options, *how, "--bag", "bag", "--summary", "summary.json")
    assert flight.stdout is not None
    printed = wait_for(flight.stdout, "step 5/30")
    for name in names:
        os.kill(ros.node(name), signal.SIGSTOP)
    status, output = finish(flight, 6 * PATIENCE_S)  # five hundred missions on a busy computer
    assert status == 0, output
    assert "Traceback" not in output
    for name in names:
        who = "the container of world, channel_monitor, policy" if name == "container" else f"node {name}"
        assert f"note: {who} gave no sign of life for " in output, output
    assert output.count("no sign of life") == len(names), "no other node"
    told = json.loads((ros.folder / "summary.json").read_text())
    assert {each["steps"] for each in (told if isinstance(told, list) else [told])} == {30}
    return printed + output


# A parent waits for the child of vfork in the same state of the kernel as for a disk.
WAITS_IN_THE_KERNEL = "import ctypes, signal; ctypes.CDLL(None).vfork(); signal.pause()"


def test_a_process_that_waits_for_the_disk_does_not_hang() -> None:
    waiting = subprocess.Popen([sys.executable, "-c", WAITS_IN_THE_KERNEL], start_new_session=True)
    stopped = subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"])
    try:
        until(lambda: waits_for_disk(waiting.pid))
        stopped.send_signal(signal.SIGSTOP)
        until(lambda: not waits_for_disk(stopped.pid))  # it may read its own program from the disk, before
    finally:
        os.killpg(waiting.pid, signal.SIGKILL)
        stopped.kill()
        waiting.wait()
        stopped.wait()
    assert not waits_for_disk(waiting.pid)


BUSY = "while True: pass"


def test_a_process_that_waits_for_a_cpu_does_not_hang() -> None:
    """A process among busy ones on a CPU, then stopped: two seconds without a sign of life each time."""
    cpu = min(os.sched_getaffinity(0))
    starved, *busy = (subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(3))

    def silent_s() -> float:
        silence = Silence(starved.pid)
        last_s = began_s = time.monotonic()
        while last_s < began_s + 2.0:
            time.sleep(0.02)
            now_s = time.monotonic()
            silence.add(now_s - last_s)
            last_s = now_s
        return silence.silent_s

    try:
        for process in (starved, *busy):
            os.sched_setaffinity(process.pid, {cpu})
        os.setpriority(os.PRIO_PROCESS, starved.pid, 19)
        assert silent_s() < 1.0
        for process in busy:
            process.kill()
        starved.send_signal(signal.SIGSTOP)
        until(lambda: ") T " in Path(f"/proc/{starved.pid}/stat").read_text())
        assert silent_s() >= 2.0
    finally:
        for process in (starved, *busy):
            process.kill()
            process.wait()


@pytest.fixture
def options(small_scenario: Path, small_policy: Path) -> list[object]:
    """A small mission."""
    return ["--scenario", small_scenario, "--policy", small_policy]


@pytest.mark.long
def test_a_node_that_hangs_is_started_again(ros: Ros, options: list[object]) -> None:
    output = flown_with_hangs(ros, options, ("policy",), *AT_A_PACE, *WITHOUT_VISUALIZER)
    assert "steps were hovered: no move came in time" in output
    missions = {m["step"] for name, m in read_bag(ros.folder / "bag") if name == "/mission"}
    assert missions == set(range(31))


@pytest.mark.long
@pytest.mark.parametrize("name", NODES)
@pytest.mark.parametrize("how", [AT_A_PACE, (*IN_LOCKSTEP, "--no-compose")], ids=["at a pace", "lockstep"])
def test_each_node_in_turn(ros: Ros, options: list[object], name: str, how: tuple[object, ...]) -> None:
    flown_with_hangs(ros, options, (name,), *how)


@pytest.mark.long
def test_a_container(ros: Ros, options: list[object]) -> None:
    flown_with_hangs(ros, options, ("container",), *IN_LOCKSTEP)


@pytest.mark.long
def test_a_bridge_takes_the_mission_up_again(ros: Ros, low: tuple[object, ...]) -> None:
    """The vehicle hovers where it was sent last, meanwhile."""
    with fake("ardupilot", speed=4.0) as autopilot:
        options = ("--vehicle", "mavlink", "--connect", autopilot.address, "--datum", "here", "--arm")
        flight = ros.start("uav_dc_ros.run_all", *low, *options, "--bag", "bag", "--summary", "summary.json")
        until(lambda: any(sent["ned"][1] > 50.0 for sent in autopilot.all("setpoint")))
        armed = autopilot.n_arms  # more than one where an acknowledgement came late
        os.kill(ros.node("bridge"), signal.SIGSTOP)
        status, output = finish(flight)
    assert status == 0, output
    assert "note: node bridge gave no sign of life for " in output, output
    assert autopilot.n_arms == armed >= 1, "the second bridge does not arm"
    assert json.loads((ros.folder / "summary.json").read_text())["outcome"] == "landed"
