"""The web server of the live view: who may see the page, and that no page holds up the mission."""

import contextlib
import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import PATIENCE_S, Ros
from tests.nodes.view.test_web_feed import Flight
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.view.web import server
from uav_dc_ros.nodes.view.web.page import page
from uav_dc_ros.nodes.view.web.server import PAGES_MAX, ViewServer

PAGE = page()


@contextlib.contextmanager
def serving(token: str = "") -> Iterator[tuple[Flight, ViewServer]]:
    flight = Flight()
    running = ViewServer(flight.feed, PAGE, address="127.0.0.1", port=0, token=token)
    try:
        yield flight, running
    finally:
        running.stop()


def answer(port: int, path: str, host: str | None = None) -> tuple[int, bytes, str]:
    """Status, body and content policy."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{port}"})
    response = connection.getresponse()
    body = response.read() if response.getheader("Content-Length") else response.fp.readline()
    connection.close()
    return response.status, body, response.getheader("Content-Security-Policy") or ""


def stream(port: int) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.request("GET", "/news")
    return connection.getresponse()


def test_the_page_is_whole_and_may_ask_nobody_else() -> None:
    with serving() as (_, running):
        status, body, policy = answer(running.port, "/")
        assert (status, body) == (200, PAGE)
        assert "default-src 'none'" in policy
        assert "connect-src 'self'" in policy
        assert answer(running.port, "/etc/passwd")[0] == 404
    text = PAGE.decode()
    assert "{{" not in text.replace("${{", "")
    assert "http://" not in text
    assert "https://" not in text


@pytest.mark.parametrize(
    ("token", "path", "host", "status"),
    [
        ("", "/", "localhost:8766", 200),
        ("", "/", "[::1]:8766", 200),
        ("", "/", "evil.example:8766", 403),
        ("", "/news", "evil.example", 403),
        ("secret", "/?token=secret", "drone.example:8766", 200),
        ("secret", "/", "localhost", 403),
        ("secret", "/news?token=secreT", "localhost", 403),
        ("secret", "/news?token=", "localhost", 403),
        ("secret", "/news?token=%ff%00", "localhost", 403),
        ("secret", "/news?token=secret", "localhost", 200),
    ],
)
def test_only_who_may_sees_it(token: str, path: str, host: str, status: int) -> None:
    with serving(token) as (_, running):
        found, body, _ = answer(running.port, path, host)
        assert found == status
        assert (PAGE[:100] in body or body.startswith(b"data: ")) == (status == 200)


def test_other_machines_need_a_token() -> None:
    assert [server.is_local(one) for one in ("127.0.0.1", "127.8.8.8", "::1", "localhost")] == [True] * 4
    assert [server.is_local(one) for one in ("0.0.0.0", "::", "192.168.1.5", "drone.example")] == [False] * 4
    assert server.token_for("127.0.0.1", "") == ""
    assert server.token_for("127.0.0.1", "mine") == server.token_for("0.0.0.0", "mine") == "mine"
    drawn = server.token_for("0.0.0.0", "")
    assert len(drawn) >= 16
    assert drawn != server.token_for("0.0.0.0", "")
    assert server.url("0.0.0.0", 8766, drawn) == f"http://{socket.gethostname()}:8766/?token={drawn}"
    assert server.url("::1", 1, "") == "http://[::1]:1/"


def test_a_page_reads_the_news_until_the_run_ends() -> None:
    with serving() as (flight, running):
        response = stream(running.port)
        first = json.loads(response.fp.readline().removeprefix(b"data: "))
        assert first == {"keys": [], "missions": []}
        flight.step(0, collected=1)
        flight.update()
        assert response.fp.readline() == b"\n"
        (mission,) = json.loads(response.fp.readline().removeprefix(b"data: "))["missions"]
        assert mission["steps"][0]["n_collected"] == 1
        flight.step(1)
        flight.update()
    rest = response.fp.read()
    assert rest.endswith(b"event: end\ndata:\n\n")
    assert b'"step":1' in rest, "what came last is sent before the end"


def test_a_page_that_does_not_read_delays_nothing() -> None:
    with serving() as (flight, running):
        slow = socket.create_connection(("127.0.0.1", running.port))
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.sendall(b"GET /news HTTP/1.1\r\nHost: localhost\r\n\r\n")
        quick = stream(running.port)
        started_s, step = time.thread_time(), 0
        for _ in range(20):
            for _ in range(50):
                flight.step(step)
                step += 1
            flight.update()
        assert time.thread_time() - started_s < 5.0
        seen = -1
        while seen < step - 1:
            line = quick.fp.readline()
            if line.startswith(b"data: "):
                news = json.loads(line.removeprefix(b"data: "))["missions"]
                seen = max([seen, *(one["step"] for each in news for one in each.get("steps", []))])
        slow.close()


def test_too_many_pages_are_refused_and_closed_ones_make_room() -> None:
    with serving() as (flight, running):
        open_ones = [stream(running.port) for _ in range(PAGES_MAX)]
        assert all(one.status == 200 for one in open_ones)
        assert answer(running.port, "/news")[0] == 503
        for one in open_ones:
            one.close()
        deadline_s = time.monotonic() + 60
        while answer(running.port, "/news")[0] == 503:
            flight.step(running.pages)
            flight.update()  # what is sent to a closed page ends it
            assert time.monotonic() < deadline_s
    assert threading.active_count() < PAGES_MAX


def test_a_port_in_use_is_one_clear_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        expected = f"port: {port} at address '127.0.0.1': Address already in use; expected a free port"
        with pytest.raises(ParameterError, match=expected):
            server.check(address="127.0.0.1", port=port)
        with pytest.raises(ParameterError, match=expected):
            ViewServer(Flight().feed, PAGE, address="127.0.0.1", port=port)
    with pytest.raises(ParameterError, match=r"port: 0 at address '192\.0\.2\.1': "):
        server.check(address="192.0.2.1", port=0)
    server.check(address="127.0.0.1", port=server.free_port("127.0.0.1"))


def test_run_all_refuses_a_port_in_use(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, output = ros.run_all(
            *("--scenario", small_scenario, "--policy", small_policy, "--view", port, "--no-record")
        )
    assert status == 2, output
    assert len(output.splitlines()) == 1, output
    assert f"port: {port} at address '127.0.0.1': " in output
