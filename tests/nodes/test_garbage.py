"""Broken messages on every topic: refused, counted by reason, logged once; the mission goes on."""

import json
import re
from pathlib import Path

from tests.conftest import WITHOUT_VISUALIZER, Ros, finish, wait_for
from uav_dc_ros.nodes.framework.node_table import NODES

TIMES = 5
FLOWN = (*WITHOUT_VISUALIZER[1].split(","), "mission_monitor")

# topic -> (node that hears it, payloads with the reason for which each is refused); RUN: of the missions
GARBAGE = {
    "move": ("world", {'{"mission":0': "malformed", '{"mission":0,"step":0}': "invalid"}),
    "ready": ("world", {"": "malformed", '{"node":7}': "invalid"}),
    "users": (
        "channel_monitor",
        {
            "null": "invalid",
            '{"run":"RUN","mission":0,"step":3,"stamp_ns":0,"cluster":[0],"x_m":[NaN],"y_m":[]}': "malformed",
            '{"run":"RUN","mission":0,"step":3,"stamp_ns":0,"cluster":[0],"x_m":[1],"y_m":[2]}': "layout",
        },
    ),
    "rates": ("policy", {"[]": "invalid", "\x00": "malformed"}),
    "mission": (
        "policy",
        {
            "{}": "invalid",
            json.dumps(
                {
                    "run": "RUN",
                    "mission": 0,
                    "step": 3,
                    "phase": "ready",
                    "cell": [0, 0, 0],
                    "remaining_steps": 3,
                    "seed": 0,
                    "scenario": "small",
                    "fingerprint": "000000000000",
                }
            ): "scenario",
        },
    ),
}


def test_a_broken_message_changes_nothing(
    ros: Ros, small_scenario: Path, small_policy: Path, tmp_path: Path
) -> None:
    options = ["--scenario", small_scenario, "--policy", small_policy, "--compose", *WITHOUT_VISUALIZER]
    quiet, disturbed = tmp_path / "quiet.json", tmp_path / "disturbed.json"
    status, output = ros.run_all(
        *options, "--pace", "lockstep", "--bag", tmp_path / "quiet", "--summary", quiet
    )
    assert status == 0, output

    recorded = ("--pace", 40, "--bag", tmp_path / "bag", "--summary", disturbed)
    flight = ros.start("uav_dc_ros.run_all", *options, *recorded)
    assert flight.stdout is not None
    probe = ros.stranger("probe")
    assert probe.stdin is not None
    output = wait_for(flight.stdout, "mission: step 0/30")
    run = ros.run_id()
    commands = [
        {"topic": topic, "data": data.replace("RUN", run)}
        for topic, (_, payloads) in GARBAGE.items()
        for data in payloads
    ]
    commands += [{"topic": "pose", "pose": x, "frame": frame} for x, frame in (("nan", "map"), ("1", "odom"))]
    for command in commands:
        hearing = sum(command["topic"] in NODES[name].subscribes for name in FLOWN)
        probe.stdin.write((json.dumps(command | {"hearing": hearing}) + "\n") * TIMES)
    probe.stdin.close()
    status, rest = finish(flight)
    probe.wait(90)
    output += rest

    assert status == 0, output
    assert "Traceback" not in output
    assert json.loads(disturbed.read_text()) == json.loads(quiet.read_text()) | {"bag": str(tmp_path / "bag")}
    expected = {topic: (node, set(payloads.values())) for topic, (node, payloads) in GARBAGE.items()}
    expected["pose"] = ("channel_monitor", {"not_finite", "frame"})
    for topic, (node, reasons) in expected.items():
        for reason in reasons:
            warned = re.findall(
                rf"^container: WARN: {node}: {topic}: {reason}: .*logged once", output, re.MULTILINE
            )
            assert len(warned) == 1, output
            counts = re.search(rf"^container: WARN: {node}: rejected messages: .*", output, re.MULTILINE)
            assert counts is not None, output
            assert f"{topic} {reason} {TIMES}" in counts[0]
