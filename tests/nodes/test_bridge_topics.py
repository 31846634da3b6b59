"""Whole missions of all nodes beside MAVROS, and PX4 on its own topics: over DDS, with stand-ins that fly."""

import json
import time
from pathlib import Path

import pytest

from tests.conftest import Ros, finish, read_bag, wait_for
from tests.nodes import px4_messages
from tests.support.fake_autopilot.mavros_flight import fake

RUN_ALL = "uav_dc_ros.run_all"


def phases(bag: Path) -> list[str]:
    told = [payload["phase"] for topic, payload in read_bag(bag) if topic == "/mission"]
    return [phase for i, phase in enumerate(told) if i == 0 or phase != told[i - 1]]


FLOWN = ["takeoff", *["ready", "moving"] * 7, "landing"]


@pytest.mark.long
def test_a_mission_beside_mavros(ros: Ros, low: tuple[object, ...]) -> None:
    """Standard messages alone: a pilot arms, and lands; between, the policy flies."""
    with fake(ros, "px4", "--speed", 3) as mavros:
        process = ros.start("uav_dc_ros.run_all", *low, "--vehicle", "mavros", "--bag", "bag")
        assert process.stdout is not None
        shown = wait_for(process.stdout, "waiting for a pilot")
        mavros.do("arm")
        for _ in range(60):
            if "takeoff" in shown:
                break
            time.sleep(0.3)
            mavros.do("mode OFFBOARD")  # which it refuses until it has seen a second of setpoints
            if mavros.all("mode"):
                shown += wait_for(process.stdout, "takeoff")
        shown += wait_for(process.stdout, "a pilot has to set")
        mavros.do("mode AUTO.LAND")
        status, output = finish(process)
        assert status == 0, shown + output
        assert not mavros.report()["armed"]
    assert phases(ros.folder / "bag")[-len(FLOWN) - 1 :] == [*FLOWN, "landed"]


def test_arming_through_mavros_needs_its_messages(ros: Ros) -> None:
    status, output = ros.run_fork(RUN_ALL, "--vehicle", "mavros", "--arm", "--datum", "here", "--no-record")
    assert status == 2, output
    assert len(output.splitlines()) == 1
    assert "mavros_msgs" in output


@pytest.mark.long
def test_a_mission_on_px4_s_topics(
    ros: Ros, low: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory
) -> None:
    if px4_messages.compilers() is None:
        pytest.skip("px4_msgs is made with compilers for C and C++, and Python's headers; some are missing")
    messages = px4_messages.build(tmp_path_factory.mktemp("px4") / "messages")
    ros.environment["PYTHONPATH"] += f":{messages}"
    px4 = ros.stranger("px4", messages, 8, "/", folder="support/fake_autopilot")
    assert px4.stdin is not None
    try:
        summary = ros.folder / "summary.json"
        options = ("--vehicle", "px4", "--arm", "--datum", "here", "--bag", "bag", "--summary", summary)
        status, output = ros.run_all(*low, *options)
        assert px4.poll() is None
    finally:
        px4.stdin.close()
        px4.wait(90)
    assert status == 0, output
    assert "Traceback" not in output
    told = json.loads(summary.read_text())
    assert (told["outcome"], told["steps"]) == ("landed", 7)
    assert phases(ros.folder / "bag")[-len(FLOWN) - 1 :] == [*FLOWN, "landed"]


def test_px4_s_topics_need_its_messages(ros: Ros) -> None:
    status, output = ros.run_fork(RUN_ALL, "--vehicle", "px4", "--no-record")
    assert status == 2, output
    assert len(output.splitlines()) == 1
    assert "px4_msgs" in output
