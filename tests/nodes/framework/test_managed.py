"""The life cycle and the parameters of each node, by the services that every ROS tool uses."""

import json
import math
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest
from rclpy.parameter import Parameter

from tests.conftest import PATIENCE_S, Ros, finish
from tests.support.fake_autopilot.mavros_flight import node_in
from uav_dc_ros.nodes.framework.node_table import NODES, WORLD_BESIDE_BRIDGE
from uav_dc_ros.nodes.framework.parameters import COMMON
from uav_dc_ros.nodes.world import WorldNode

PROCESSES = [name for name, row in NODES.items() if row.process and name not in ("live_view", "web_view")]
NO_AUTOPILOT = "tcp:127.0.0.1:9"  # nothing listens there


class ServiceClient:
    """Calls services of nodes, in a process of its own."""

    def __init__(self, ros: Ros) -> None:
        self.process = ros.stranger("framework/service_client")

    def call(self, **command: Any) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer

    def close(self) -> None:
        self.process.communicate(timeout=PATIENCE_S)


@pytest.fixture
def client(ros: Ros) -> Iterator[ServiceClient]:
    """Calls services of the nodes of this test."""
    client = ServiceClient(ros)
    yield client
    client.close()


def waiting(ros: Ros, node: str, *arguments: str) -> subprocess.Popen[str]:
    """Start a node that waits for a lifecycle manager."""
    given = ["-p", "autostart:=false", *arguments]
    return ros.start(f"uav_dc_ros.nodes.{node}", "--ros-args", *given)


def ended(process: subprocess.Popen[str]) -> str:
    """Stop a node that a test started; what it printed."""
    process.terminate()
    status, output = finish(process)
    assert status == 0, output
    assert "Traceback" not in output
    return output


def test_a_bad_policy_fails_at_configure_with_its_reason_and_a_good_one_heals_it(
    ros: Ros, client: ServiceClient
) -> None:
    node = waiting(ros, "policy", "-p", "policy:=nobody")
    refused = {"success": False, "state": "unconfigured"}
    assert client.call(node="/policy", do="configure") == refused
    assert client.call(node="/policy", do="activate") == refused  # not a transition of this state
    given = client.call(node="/policy", set={"policy": "five_clusters_dueling"})
    assert given["policy"]["success"]
    assert client.call(node="/policy", do="configure") == {"success": True, "state": "inactive"}
    output = ended(node)
    assert (
        "policy 'nobody': no such name or folder; expected one of farm_dueling, five_clusters_dueling"
        in output
    )


def check_parameters(client: ServiceClient, name: str) -> None:
    """Every parameter of a node is described, with unit and range."""
    reported = client.call(node=f"/{name}")
    for row in (*COMMON, *NODES[name].parameters):
        unit = f" [{row.unit}]" if row.unit else ""
        choices = f"; one of {', '.join(row.choices)}" if row.choices else ""
        assert reported[row.name] == {
            "description": f"{row.description}{unit}{choices}",
            "expected": row.expected,
            "read_only": row.read_only,
            "range": [] if row.min is None else [[row.min, row.max]],
        }
    own = {row.name for row in (*COMMON, *NODES[name].parameters)}
    assert {n for n in reported if not n.startswith(("use_sim_time", "start_type_"))} == own


def test_every_node_describes_its_parameters_and_goes_all_ways_twice(ros: Ros, client: ServiceClient) -> None:
    given = {
        "recorder": ["-p", f"bag:={ros.folder / 'recorder'}"],
        "bridge": ["-p", f"connect:={NO_AUTOPILOT}"],
    }
    nodes = {name: waiting(ros, name, *given.get(name, [])) for name in PROCESSES}
    for name in nodes:
        check_parameters(client, name)
    for turn in range(2):
        for name in nodes:
            for transition, state in (
                ("configure", "inactive"),
                ("activate", "active"),
                ("deactivate", "inactive"),
                *((("activate", "active"), ("deactivate", "inactive")) if name != "recorder" else ()),
                ("cleanup", "unconfigured"),
            ):
                expected = {"success": True, "state": state}
                assert client.call(node=f"/{name}", do=transition) == expected, (name, turn, transition)
            if name == "recorder":
                client.call(node="/recorder", set={"bag": str(ros.folder / "another")})
    assert client.call(node="/world", do="shutdown") == {"success": True, "state": "finalized"}
    for process in nodes.values():
        ended(process)
    assert {path.name for path in ros.folder.glob("*/metadata.yaml")} == {"metadata.yaml"}
    assert (ros.folder / "another" / "metadata.yaml").is_file()


def test_a_closed_bag_is_not_recorded_into_again(ros: Ros, client: ServiceClient) -> None:
    node = waiting(ros, "recorder", "-p", f"bag:={ros.folder / 'bag'}")
    for transition in ("configure", "activate", "deactivate"):
        assert client.call(node="/recorder", do=transition)["success"]
    assert client.call(node="/recorder", do="activate") == {"success": False, "state": "inactive"}
    assert f"bag: {ros.folder / 'bag'} is closed" in ended(node)


def test_parameters_are_refused_with_their_reason(ros: Ros, client: ServiceClient) -> None:
    node = waiting(ros, "world")

    def reason(**values: Any) -> str:
        (answer,) = client.call(node="/world", set=values).values()
        assert not answer["success"]
        return str(answer["reason"])

    assert "seed" in reason(seed=-1)
    assert "missions" in reason(missions=0)
    assert "pace: 'fast'; expected 'lockstep' or a number above 0" in reason(pace="fast")
    assert "seed: 'three'; expected a whole number from 0 to" in reason(seed="three")
    assert "read-only" in reason(autostart=True)
    assert reason(sead=3)
    assert client.call(node="/world", set={"seed": 3})["seed"]["success"]
    assert client.call(node="/world", do="configure")["success"]
    assert "seed: the node is inactive; expected it to be unconfigured" in reason(seed=4)
    ended(node)


def test_a_world_that_is_configured_anew_has_the_topics_of_its_vehicle(ros: Ros) -> None:
    with node_in(ros):
        world = WorldNode()
        for vehicle, row in (("external", WORLD_BESIDE_BRIDGE), ("simulated", NODES["world"])):
            world.set_parameters([Parameter("vehicle", value=vehicle)])
            world.trigger_configure()
            assert set(world.publishers_of) == set(row.publishes), vehicle
            world.trigger_cleanup()
        world.destroy_node()


def test_a_whole_number_is_a_real_one_wherever_it_is_given(ros: Ros, client: ServiceClient) -> None:
    """On the command line, in a file of parameters, and set while the node runs."""
    file = ros.folder / "whole.yaml"
    file.write_text("bridge: {ros__parameters: {fault_timeout_s: 10, datum: '-35,149,584'}}")
    given = ("-p", "min_battery:=0", "-p", "policy_timeout_steps:=3", "--params-file", str(file))
    node = waiting(ros, "bridge", "-p", f"connect:={NO_AUTOPILOT}", *given)
    real = [row for row in NODES["bridge"].parameters if isinstance(row.default, float)]
    whole = {row.name: math.ceil(row.min or 0) for row in real}
    reported = client.call(node="/bridge", set=whole)
    assert all(answer["success"] for answer in reported.values()), reported
    refused = client.call(
        node="/bridge",
        set={"fault_timeout_s": "long", "arm": 1, "command_retry_s": True, "failsafe_action": "stay"},
    )
    assert {name: answer["reason"] for name, answer in refused.items()} == {
        "fault_timeout_s": "fault_timeout_s: 'long'; expected a number from 0.1 to 600.0 s",
        "arm": "arm: 1; expected true or false",
        "command_retry_s": "command_retry_s: True; expected a number from 0.5 to 60.0 s",
        "failsafe_action": "failsafe_action: 'stay'; expected one of return, land",
    }
    assert client.call(node="/bridge", do="configure") == {"success": True, "state": "inactive"}
    ended(node)


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("-p", "sead:=3"), "error: sead: no such parameter of node world; did you mean 'seed'?"),
        (("-p", "seed:=1.5"), "error: seed: 1.5; expected a whole number from 0 to"),
        (("-p", "use_sim_time:=1"), "error: Trying to set parameter 'use_sim_time' to '1'"),
        (("-p", "wind_mps:=3"), "error: wind_mps: no such parameter of node world; expected some of autosta"),
        (
            ("-p", "qos_overrides./moves.subscription.depth:=5"),
            "qos_overrides./moves.subscription.depth: no such parameter of node world; did you mean",
        ),
        (
            ("-p", "qos_overrides./move.subscription.reliability:=often"),
            "qos_overrides of move: Unexpected QoS override for policy `reliability`: `often`",
        ),
        (
            ("-p", "qos_overrides./pose.publisher.depth:=deep"),
            "qos_overrides of pose: Trying to set parameter",
        ),
    ],
)
def test_a_parameter_that_no_node_has(ros: Ros, arguments: tuple[str, ...], reported: str) -> None:
    status, output = ros.run_fork("uav_dc_ros.nodes.world", "--ros-args", *arguments)
    assert status == 2, output
    assert reported in output
    assert "Traceback" not in output
