"""Each node alone, as on a robot: started by hand, in a namespace, with ROS parameters."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import Ros, finish, wait_for

NAMESPACE = ("-r", "__ns:=/uav1")


def test_nodes_started_by_hand_fly_in_a_namespace(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    """World first, policy last: it waits for them. No recorder takes part, and a stranger listens."""
    probe = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("probe.py")), "/uav1/mission"],
        env=ros.environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert probe.stdin is not None
    assert probe.stdout is not None
    scenario, policy = f"scenario:={small_scenario}", f"policy:={small_policy}"
    nodes = [
        ros.start("uav_dc_ros.nodes.world", "--ros-args", "-p", scenario, *NAMESPACE),
        ros.start("uav_dc_ros.nodes.channel_monitor", "--ros-args", "-p", scenario, *NAMESPACE),
        ros.start("uav_dc_ros.nodes.policy", "--ros-args", "-p", policy, *NAMESPACE),
    ]
    heard = wait_for(probe.stdout, '\\"remaining_steps\\":0')
    missions = [json.loads(json.loads(line)["data"]) for line in heard.splitlines()]
    assert [m["step"] for m in missions] == list(range(31))
    assert missions[-1]["phase"] in ("landed", "timeout")
    for node in nodes:
        node.terminate()
        status, output = finish(node)
        assert status == 0, output
        assert "Traceback" not in output
    probe.stdin.close()
    probe.wait(10)
    probe.stdout.close()


@pytest.mark.parametrize(
    ("node", "parameters", "told"),
    [
        (
            "world",
            {"scenario": "mars"},
            "scenario 'mars': no such name or file; expected one of five_clusters",
        ),
        ("world", {"seed": -1}, "seed: -1; expected a whole number of at least 0"),
        ("world", {"missions": 0}, "missions: 0; expected a whole number of at least 1"),
        ("world", {"missions": "many"}, "missions: 'many'; expected a int"),
        ("world", {"pace": "slow"}, "pace: 'slow'; expected 'lockstep' or a number above 0"),
        ("world", {"pace": -3}, "pace: '-3'; expected 'lockstep' or a number above 0"),
        ("world", {"peers": ["pilot"]}, "peers: 'pilot'; expected some of world, channel_monitor"),
        ("channel_monitor", {"scenario": "mars"}, "scenario 'mars'"),
        ("policy", {"policy": "nobody"}, "policy 'nobody': no such name or folder"),
        ("policy", {"policy": "five_clusters_dueling", "scenario": "three_clusters"}, "does not fit"),
        ("recorder", {}, "bag: ''; expected the folder of a new bag"),
    ],
)
def test_a_parameter_that_makes_no_sense_is_one_line_and_status_2(
    ros: Ros, node: str, parameters: dict[str, object], told: str
) -> None:
    given = [f"{name}:={json.dumps(value)}" for name, value in parameters.items()]
    arguments = [argument for text in given for argument in ("-p", text)]
    status, output = ros.run(f"uav_dc_ros.nodes.{node}", "--ros-args", *arguments)
    assert status == 2, output
    assert len(output.splitlines()) == 1, output
    assert output.startswith("error: ")
    assert told in output
