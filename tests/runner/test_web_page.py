"""The page of `run_all --view`: when a browser opens it, when it stays, and which address it has."""

import socket
import threading
from typing import Any

import pytest

from uav_dc_ros import RunConfig
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.runner import web_page
from uav_dc_ros.runner.run_options import composed, nodes
from uav_dc_ros.runner.web_page import WebPage


class Process:
    """A node's process that ends after some checks."""

    def __init__(self, checks: int) -> None:
        self.checks, self.log = checks, list[str]()

    @property
    def has_ended(self) -> bool:
        self.checks -= 1
        return self.checks < 0

    def terminate(self) -> None:
        self.log.append("terminated")

    def wait(self, deadline_s: float) -> None:
        self.log.append("ended")


def test_the_address_is_known_before_the_node_starts() -> None:
    page = WebPage(0, {})
    assert page.url == f"http://127.0.0.1:{page.parameters['port']}/"
    assert page.parameters["token"] == ""
    other = WebPage(0, {"address": "0.0.0.0"})
    assert (
        other.url
        == f"http://{socket.gethostname()}:{other.parameters['port']}/?token={other.parameters['token']}"
    )
    assert len(str(other.parameters["token"])) >= 16
    assert WebPage(0, {"token": "mine"}).url.endswith("/?token=mine")
    with pytest.raises(ParameterError, match=r"port: 0 at address '192\.0\.2\.9'"):
        WebPage(0, {"address": "192.0.2.9"})


def test_a_page_is_a_node_of_this_host() -> None:
    assert "web_view" not in nodes(RunConfig())
    assert "web_view" in nodes(RunConfig(view=0))
    assert nodes(RunConfig(view=0, nodes=("policy",))) == ["policy", "web_view"]
    with pytest.raises(ParameterError, match="view: 65536; expected a whole number from 0 to 65535"):
        RunConfig(view=65536)


def test_it_shares_a_process_with_the_visualizer_in_lockstep() -> None:
    def shared(**how: Any) -> list[list[str]]:
        config = RunConfig(view=0, **how)
        return composed(config, nodes(config))

    steps = ["world", "channel_monitor", "policy"]
    assert shared(pace="lockstep") == [steps, ["visualizer", "web_view"]]
    assert shared(pace=90.0) == shared(pace="lockstep", compose=False) == []
    assert shared(pace="lockstep", nodes=(*steps, "recorder")) == [steps]


@pytest.mark.parametrize(
    ("attended", "display", "opens"), [(True, ":0", True), (False, ":0", False), (True, "", False)]
)
def test_a_browser_opens_on_a_desktop_only(
    monkeypatch: pytest.MonkeyPatch, attended: bool, display: str, opens: bool
) -> None:
    opened, done = list[str](), threading.Event()

    def open_browser(url: str) -> None:
        opened.append(url)
        done.set()

    monkeypatch.setattr(web_page.webbrowser, "open", open_browser)
    monkeypatch.setattr(web_page, "is_attended", lambda: attended)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    page = WebPage(0, {})
    page.open_browser()
    assert not opens or done.wait(60)
    assert opened == ([page.url] if opens else [])


@pytest.mark.parametrize("ends", ["interrupt", "terminal", "process"])
def test_the_page_stays_until_one_of_these(monkeypatch: pytest.MonkeyPatch, ends: str) -> None:
    checks = dict.fromkeys(("interrupt", "terminal", "process"), 1000) | {ends: 3}

    def passed(name: str) -> bool:
        checks[name] -= 1
        return checks[name] < 0

    monkeypatch.setattr(web_page, "POLL_S", 0.0)
    monkeypatch.setattr(web_page, "is_attended", lambda: not passed("terminal"))
    process: Any = Process(checks["process"])
    WebPage(0, {}).keep(process, lambda: passed("interrupt"))
    assert process.log == ["terminated", "ended"]
