"""Services of the simulated vehicle and of recorders, called from outside the mission."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from std_srvs.srv import Trigger

from tests.conftest import PATIENCE_S, Ros, finish, read_bag
from tests.nodes.record.test_recorder import numbers, published, record, stop, talk
from tests.support.fake_autopilot.mavros_flight import node_in
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.world import WorldNode

RUN_ALL = "uav_dc_ros.run_all"


class World:
    """The world's node in this process, with no peer."""

    def __init__(self, node: WorldNode, executor: Any) -> None:
        self.node, self._executor = node, executor

    def call(self, service: str) -> tuple[bool, str]:
        """Call a service over ROS."""
        client = self.node.create_client(Trigger, service)
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        self.node.destroy_client(client)
        return future.result().success, future.result().message

    def until(self, done: Any) -> None:
        """Spin until something is so."""
        for _ in range(4000):
            if done():
                return
            self._executor.spin_once(0.005)
        raise AssertionError("this never came to be")


@pytest.fixture
def world(ros: Ros, small_scenario: Path) -> Iterator[World]:
    """Two missions in lockstep, whose moves a test gives, and which wait for the service `start`."""
    given = ["peers:=[world]", f"scenario:={small_scenario}", "pace:=lockstep", "missions:=2"]
    given += ["wait_for_start:=true", f"journal:={ros.folder / 'journal'}"]
    with node_in(ros, *(part for one in given for part in ("-p", one))) as (_, executor):
        node = WorldNode()
        node.spin_once = executor.spin_once
        executor.add_node(node)
        node.trigger_configure()
        node.trigger_activate()
        assert node.state == "active"
        yield World(node, executor)
        if node.state != "finalized":
            node.trigger_shutdown()
        node.destroy_node()


def test_missions_start_and_end_by_services_also_after_a_restart(world: World) -> None:
    node = world.node
    world.until(lambda: node.all_ready)
    assert node._phase is None
    assert world.call("start") == (True, "mission 0 begins")
    assert not world.call("start")[0]
    node._fly()  # a step without a move: it hovers
    assert world.call("stop") == (True, "mission 0 ends after step 1")
    assert node._phase is Phase.READY
    node._fly()
    assert (node._phase, node._step, node._mission) == (Phase.ABORTED, 2, 0)
    assert node._status().reason == "stopped by a service call"
    success, text = world.call("abort")
    assert not success
    assert text == "the missions are over (aborted); expected one in progress"
    node._until_inactive.close()  # killed
    node.trigger_deactivate()
    node.trigger_activate()
    assert (node._phase, node._step) == (Phase.ABORTED, 2), "it is not flown on"


def test_an_abort_before_the_start_is_the_end(world: World) -> None:
    node = world.node
    assert world.call("abort") == (True, "mission 0 is aborted at step 0")
    world.until(lambda: node.all_ready)
    world.until(lambda: node.statistics.published["clock"] + 1)
    assert (node._phase, node._step) == (Phase.ABORTED, 0)
    assert not world.call("start")[0] or node._phase is Phase.ABORTED


def test_a_recorder_s_services(ros: Ros) -> None:
    recorder = record(ros, "--keep-last", 60)
    talker = talk(ros, {"topic": "/a", "n": 40, "hz": 400}, {"topic": "/b", "latched": True, "n": 2})
    counts = published(talker, leave=False)
    client = ros.stranger("framework/service_client")
    assert client.stdin is not None
    assert client.stdout is not None

    def call(service: str) -> dict[str, Any]:
        client.stdin.write(json.dumps({"call": f"/bag_record/{service}"}) + "\n")
        client.stdin.flush()
        response: dict[str, Any] = json.loads(client.stdout.readline())
        return response

    saved = call("snapshot")
    assert saved["success"], saved
    assert int(saved["message"].split()[0]) >= 42
    assert [call(name)["success"] for name in ("pause", "pause", "resume", "split", "split")] == [
        *(True, False, True, True, False)
    ]
    client.communicate()
    talker.communicate(timeout=PATIENCE_S)
    output = stop(recorder)
    assert "service snapshot: " in output
    bag = ros.folder / "bag"
    assert numbers(bag, "/a") == list(range(counts["/a"]))
    assert numbers(bag, "/b")[-1] == 1
    with BagReader(bag) as reader:
        assert {"keep_last_s", "saved_1", "paused_1"} <= reader.about.keys()


@pytest.mark.long
@pytest.mark.parametrize("service", ["stop", "abort"])
def test_run_all_ends_when_a_service_ends_the_mission(ros: Ros, service: str) -> None:
    process = ros.start(
        RUN_ALL, "--missions", 3, "--pace", 20, "--bag", "bag", "--set", "recorder.keep_last_s=5"
    )
    ros.run_id()  # the mission has begun
    client = ros.stranger("framework/service_client")
    assert client.stdin is not None
    assert client.stdout is not None
    time.sleep(1.0)
    client.stdin.write(json.dumps({"call": f"/{service}"}) + "\n")
    client.stdin.flush()
    assert json.loads(client.stdout.readline())["success"]
    client.communicate()
    begun_s = time.monotonic()
    status, output = finish(process)
    assert time.monotonic() - begun_s < 25.0, "no timeout of a next mission"
    assert status == 1, output
    what = "stopped" if service == "stop" else "aborted"
    assert "mission 0 was aborted at step " in output
    assert f": {what} by a service call" in output
    last = [payload for topic, payload in read_bag(ros.folder / "bag", "/mission")][-1]
    assert (last["phase"], last["reason"]) == ("aborted", f"{what} by a service call")


@pytest.mark.long
def test_run_all_waits_for_the_start(ros: Ros) -> None:
    given = ("--pace", "lockstep", "--no-record", "--set", "world.wait_for_start=true")
    process = ros.start(RUN_ALL, *given)
    client = ros.stranger("framework/service_client")
    assert client.stdin is not None
    assert client.stdout is not None
    response = {"success": False, "message": ""}
    deadline_s = time.monotonic() + PATIENCE_S
    while not response["success"]:
        assert time.monotonic() < deadline_s, response
        client.stdin.write(json.dumps({"call": "/start"}) + "\n")
        client.stdin.flush()
        response = json.loads(client.stdout.readline())
        time.sleep(0.2)
    client.communicate()
    status, output = finish(process)
    assert status == 0, output


def test_the_services_are_those_of_the_table() -> None:
    """A service of a row is a method of its node."""
    from uav_dc_ros.nodes.bridge import AutopilotBridge
    from uav_dc_ros.nodes.record.bag_record import BagRecorder
    from uav_dc_ros.nodes.recorder import RecorderNode

    classes = {
        "world": WorldNode,
        "bridge": AutopilotBridge,
        "recorder": RecorderNode,
        "bag_record": BagRecorder,
    }
    with_services = {row.name: row.services for row in NODES.values() if row.services}
    assert with_services.keys() == classes.keys()
    for name, services in with_services.items():
        found = {method.removeprefix("call_") for method in dir(classes[name]) if method.startswith("call_")}
        assert found == {service.removeprefix("~/") for service in services}
