"""`run_all --live`: a mission over real DDS, and a client that speaks Foxglove's protocol by hand."""

import json
import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from websockets.exceptions import ConnectionClosed

from tests.conftest import Ros, finish, wait_for
from tests.nodes.view.foxglove_client import FoxgloveClient, Received, is_free
from uav_dc_ros import cli, messages
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.topics import TOPICS

SERVED = NODES["live_view"].subscribes
PUBLISHED = [name for name in SERVED if not TOPICS[name].optional]  # in the small world
LATCHED = [name for name in PUBLISHED if TOPICS[name].latched]
LINE = re.compile(r"live view: ws://127\.0\.0\.1:(\d+) \(Foxglove: .*\); layout: (\S+)")


def start(ros: Ros, scenario: Path, policy: Path, *options: object) -> tuple[subprocess.Popen[str], int, str]:
    """A flight with a live view on any port: its process, the port, and the layout's path."""
    given = ("--scenario", scenario, "--policy", policy, "--pace", 100, "--no-record", "--live", 0)
    flight = ros.start("uav_dc_ros.run_all", *given, *options)
    assert flight.stdout is not None
    match = LINE.search(wait_for(flight.stdout, "live view: "))
    assert match is not None
    return flight, int(match[1]), match[2]


def test_a_client_sees_the_mission(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    flight, port, layout = start(ros, small_scenario, small_policy, "--missions", 100)
    try:
        assert "3D!mission" in json.loads(Path(layout).read_text())["configById"]
        with FoxgloveClient(port, len(SERVED)) as viewer:
            assert viewer.server["name"] == "uav_dc_ros"
            assert {name: row["schemaName"] for name, row in viewer.channels.items()} == {
                f"/{name}": f"uav_dc_ros.{name.capitalize()}"
                if name in messages.PAYLOADS
                else TOPICS[name].type
                for name in SERVED
            }
            viewer.open(*viewer.channels)
            expected = {f"/{name}" for name in PUBLISHED}
            received = viewer.read_until(lambda h: {m.topic for m in h} == expected, 60.0)
            with FoxgloveClient(port, len(SERVED)) as late:
                late.open(*(f"/{name}" for name in LATCHED))
                late.read_until(lambda h: {m.topic for m in h} == {f"/{name}" for name in LATCHED}, 60.0)
    finally:
        flight.send_signal(signal.SIGINT)
        status, output = finish(flight)
    assert status == cli.INTERRUPTED, output
    assert "Traceback" not in output
    assert is_free(port)

    schemas = {
        name: json.loads(row["schema"]) for name, row in viewer.channels.items() if row["encoding"] == "json"
    }
    assert set(schemas) == {f"/{name}" for name in messages.PAYLOADS if name in SERVED}
    first: dict[str, Any] = {}
    for message in received:
        assert abs(message.time_ns - time.time_ns()) < 120e9  # the wall clock's
        if message.topic in schemas and message.topic[1:] not in first:
            jsonschema.validate(message.content, schemas[message.topic])
        first.setdefault(message.topic[1:], message.content)
    for name, kind in messages.PAYLOADS.items():
        if name in SERVED:
            messages.decode(json.dumps(first[name]), kind)
    mission = first["mission"]
    assert mission["scenario"] == "small"
    assert len(first["users"]["x_m"]) == 4
    assert first["pose"].header.frame_id == first["path"].header.frame_id == "map"
    assert first["path"].poses
    assert {marker.ns for marker in first["markers"].markers} >= {"users", "clusters", "uav"}
    assert first["diagnostics"].status[0].name in NODES
    assert first["clock"].clock.sec >= 0


def until_closed(viewer: FoxgloveClient) -> Iterator[Received]:
    """All messages, until the server closes the connection."""
    try:
        while True:
            message = viewer.read(60.0)
            assert message is not None, "the mission stands still, or the server did not end with it"
            yield message
    except ConnectionClosed:
        return


@pytest.mark.long
def test_topics_are_called_as_in_the_graph_and_the_server_ends_with_the_mission(
    ros: Ros, small_scenario: Path, small_policy: Path
) -> None:
    flight, port, _ = start(ros, small_scenario, small_policy, "--namespace", "/uav1", "--missions", 3)
    with FoxgloveClient(port, len(SERVED)) as viewer:
        assert viewer.server["name"] == "uav_dc_ros /uav1"
        assert set(viewer.channels) == {f"/uav1/{name}" for name in SERVED}
        viewer.open("/uav1/mission")
        received = list(until_closed(viewer))
    status, output = finish(flight)
    assert status == 0, output
    last = received[-1].content
    assert (last["mission"], last["remaining_steps"]) == (2, 0)
    assert is_free(port)


def test_a_port_in_use_is_one_line_and_status_2(ros: Ros) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, output = ros.run_fork("uav_dc_ros.nodes.live_view", "--ros-args", "-p", f"port:={port}")
    assert status == 2, output
    assert len(output.splitlines()) == 1, output
    assert f"port: {port} at address '127.0.0.1': " in output
