"""Each node alone, as on a robot: started by hand, in a namespace, with ROS parameters."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Ros, finish, wait_for
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.parameters import COMMON

RUN = "fedcba9876543210"
NAMESPACE = ("-r", "__ns:=/uav1")


def test_nodes_started_by_hand_fly_in_a_namespace(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    """World first, policy last: it waits for them. No recorder takes part, and a probe subscribes."""
    probe = ros.stranger("probe", "/uav1/mission")
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
    probe.wait(90)
    probe.stdout.close()


def test_a_lockstep_that_stands_still_repeats_its_step(ros: Ros, small_scenario: Path) -> None:
    """A probe plays the policy, and lets the vehicle wait: nothing is flown or booked twice."""
    heard = [f"/{topic}" for topic in ("mission", "rates")]
    probe = ros.stranger("probe", "name=policy", *heard)
    assert probe.stdin is not None
    assert probe.stdout is not None

    def publish(topic: str, payload: dict[str, object], hearing: int = 1) -> None:
        command = {"topic": f"/{topic}", "data": json.dumps({"run": RUN} | payload), "hearing": hearing}
        probe.stdin.write(json.dumps(command) + "\n")
        probe.stdin.flush()

    def next_rates() -> dict[str, Any]:
        line = wait_for(probe.stdout, '"/rates"').splitlines()[-1]
        return json.loads(json.loads(line)["data"])

    given = [
        "--ros-args",
        "-p",
        f"scenario:={small_scenario}",
        "-p",
        'peers:=["world", "channel_monitor", "policy"]',
        "-p",
        f"run:={RUN}",
    ]
    nodes = [ros.start(f"uav_dc_ros.nodes.{node}", *given) for node in ("world", "channel_monitor")]
    # This creates the publisher that the world waits for.
    publish("move", {"mission": 9, "step": 9, "action": "hover"})
    publish("ready", {"node": "policy"})
    assert next_rates()["step"] == 0
    publish("move", {"mission": 0, "step": 0, "action": "right"})
    first = next_rates()
    assert first["step"] == 1
    assert sum(first["data_bits"]) > 0
    assert next_rates() == first  # after the world's patience, without a new move
    publish("move", {"mission": 0, "step": 0, "action": "right"})  # late: it was flown already
    publish("move", {"mission": 0, "step": 1, "action": "forward"})
    while (second := next_rates()) == first:
        pass
    assert second["step"] == 2
    probe.stdin.close()
    for node in nodes:
        node.terminate()
    output = finish(nodes[0])[1]
    finish(nodes[1])
    probe.wait(90)
    probe.stdout.close()
    assert "move wrong_step 2" in output


@pytest.mark.parametrize(
    ("node", "parameters", "told"),
    [
        (
            "world",
            {"scenario": "mars"},
            "scenario 'mars': no such name or file; expected one of farm, five_clusters",
        ),
        ("world", {"seed": -1}, "seed: -1; expected a whole number from 0 to "),
        ("world", {"missions": 0}, "missions: 0; expected a whole number from 1 to "),
        ("world", {"missions": "many"}, "missions: 'many'; expected a whole number"),
        ("world", {"pace": "slow"}, "pace: 'slow'; expected 'lockstep' or a number above 0"),
        ("world", {"pace": -3}, "pace: '-3'; expected 'lockstep' or a number above 0"),
        ("world", {"peers": ["pilot"]}, "peers: 'pilot'; expected some of world, bridge, channel_monitor"),
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
    status, output = ros.run_fork(f"uav_dc_ros.nodes.{node}", "--ros-args", *arguments)
    assert status == 2, output
    assert len(output.splitlines()) == 1, output
    assert output.startswith(("error: ", "[ERROR] "))  # a value, or what was found when it was loaded
    assert told in output


def test_help_tells_the_parameters(ros: Ros) -> None:
    status, output = ros.run_fork("uav_dc_ros.nodes.world", "--help")
    assert status == 0, output
    assert output.startswith("usage: python -m uav_dc_ros.nodes.world [-h] [--ros-args -p PARAMETER:=VALUE")
    for row in (*NODES["world"].parameters, *COMMON):
        assert re.search(rf"^  {row.name} +{re.escape(row.description)}", output, re.MULTILINE), row.name


def test_arguments_that_ros_would_ignore_are_refused(ros: Ros) -> None:
    status, output = ros.run_fork("uav_dc_ros.nodes.world", "--seed", "3", "--ros-args", "-p", "seed:=4")
    assert status == 2, output
    assert output == (
        "python -m uav_dc_ros.nodes.world: '--seed 3'; expected --ros-args first, and -p PARAMETER:=VALUE\n"
    )
