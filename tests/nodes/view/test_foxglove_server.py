"""The server alone, with a client that speaks its protocol by hand."""

import socket
import sys
import threading
import time
from collections.abc import Iterator

import pytest
from websockets.exceptions import ConnectionClosed

from tests.nodes.view.foxglove_client import FoxgloveClient, is_free
from uav_dc_ros import cdr, messages
from uav_dc_ros.errors import NodeError, ParameterError
from uav_dc_ros.nodes.view.foxglove_server import FoxgloveServer, check
from uav_dc_ros.topics import TOPICS

ROWS = {f"/{row.name}": row for row in TOPICS.values()}


def serve(port: int = 0, address: str = "127.0.0.1") -> FoxgloveServer:
    return FoxgloveServer(name="test", address=address, port=port, topics=ROWS)


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    server = serve()
    yield server
    server.stop()


def client(server: FoxgloveServer) -> FoxgloveClient:
    return FoxgloveClient(server.port, len(ROWS))


def test_a_client_gets_every_topic_with_its_type(server: FoxgloveServer) -> None:
    with client(server) as viewer:
        assert viewer.server["name"] == "test"
        assert viewer.server["capabilities"] == []  # viewers cannot publish
        assert set(viewer.channels) == set(ROWS)
        for name, channel in viewer.channels.items():
            found = channel["encoding"], channel["schemaEncoding"], channel["schemaName"]
            if (kind := messages.PAYLOADS.get(name[1:])) is not None:
                assert found == ("json", "jsonschema", f"uav_dc_ros.{kind.__name__}")
            else:
                assert found == ("cdr", "ros2msg", ROWS[name].type)


def test_bytes_and_time_arrive_as_they_were(server: FoxgloveServer) -> None:
    with client(server) as viewer:
        viewer.open("/mission")
        server.send("/mission", cdr.encode_string(b'"now"'), 1_700_000_000_123_456_789)
        (message,) = viewer.read_until(lambda received: len(received) == 1, 60.0)
    assert message.content == "now"
    assert message.time_ns == 1_700_000_000_123_456_789


def test_who_comes_late_gets_the_last_message_of_latched_topics_only(server: FoxgloveServer) -> None:
    for text in (b'"old"', b'"newest"'):
        for topic in ("/users", "/mission", "/move"):
            server.send(topic, cdr.encode_string(text), 7)
    with client(server) as first:
        first.open("/users", "/mission", "/move", "/rates")
        received = [(m.topic, m.content, m.time_ns) for m in first.read_until(lambda h: len(h) == 2, 60.0)]
        assert sorted(received) == [("/mission", "newest", 7), ("/users", "newest", 7)]
        assert first.read(0.3) is None
        with client(server) as second:
            second.open("/users")
            (message,) = second.read_until(lambda h: len(h) == 1, 60.0)
            assert message.content == "newest"


def test_clients_that_come_and_go_while_much_is_sent(server: FoxgloveServer) -> None:
    """The SDK calls from its own threads: nothing may wait for itself, and no older message come last."""
    stop = threading.Event()

    def send() -> None:
        n = 0
        while not stop.is_set():
            n += 1
            server.send("/mission", cdr.encode_string(b"%d" % n), n)
            time.sleep(0.0005)
        server.send("/mission", cdr.encode_string(b'"last"'), n + 1)

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    with client(server) as watcher:
        watcher.open("/mission")
        for _ in range(10):
            with client(server) as visitor:
                visitor.open("/mission")
                assert visitor.read(60.0) is not None
        stop.set()
        sender.join(60.0)
        assert not sender.is_alive()
        received = watcher.read_until(lambda h: bool(h) and h[-1].content == "last", 60.0)
    times = [message.time_ns for message in received]
    assert times == sorted(times)


def test_a_stopped_server_is_gone(server: FoxgloveServer) -> None:
    with client(server) as viewer:
        assert not is_free(server.port)
        server.stop()
        with pytest.raises(ConnectionClosed):
            viewer.read(60.0)
    assert is_free(server.port)


def test_a_port_in_use_is_named(server: FoxgloveServer) -> None:
    message = rf"port: {server.port} at .*in use.*expected a free port"
    with pytest.raises(ParameterError, match=message):
        serve(server.port)
    with pytest.raises(ParameterError, match=message):
        check(address="127.0.0.1", port=server.port)


@pytest.mark.parametrize("address", ["192.0.2.1", "no such host"])
def test_an_address_that_is_not_this_machine_s_is_named(address: str) -> None:
    message = rf"'{address}'.*expected a free port of this machine"
    with pytest.raises(ParameterError, match=message):
        serve(address=address)
    with pytest.raises(ParameterError, match=message):
        check(address=address, port=0)


def test_a_port_that_was_only_checked_is_free_still() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    check(address="127.0.0.1", port=port)
    serve(port).stop()
    deadline_s = time.monotonic() + 60.0
    while not is_free(port) and time.monotonic() < deadline_s:  # a port is let go of a moment later
        time.sleep(0.02)
    check(address="127.0.0.1", port=port)


def test_without_the_sdk_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    message = r"no module foxglove; pip install 'uav_dc_ros\[live\]'"
    with pytest.raises(NodeError, match=message):
        serve()
    with pytest.raises(NodeError, match=message):
        check(address="127.0.0.1", port=0)
