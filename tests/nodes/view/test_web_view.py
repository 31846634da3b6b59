"""`run_all --view`: a mission over real DDS on its page, for a client of the stream and for Chromium."""

import http.client
import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import PATIENCE_S, Ros, finish, wait_for
from tests.nodes.conftest import python
from tests.nodes.view.foxglove_client import is_free
from uav_dc_ros import scenarios

LINE = re.compile(r"live view: http://127\.0\.0\.1:(\d+)/\n")
STEPS = 30  # of the small world
SHIPPED = "three_clusters_hover"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ROOT = ("--no-sandbox",) if os.geteuid() == 0 else ()
# Where the UAV is drawn, and how much of the canvas is.
UAV = "(namespace) => window.view.panels.get(namespace)?.scene.drawn?.uav ?? null"
INKED = """() => { const canvas = document.querySelector("canvas.scene3d");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return data.filter((value) => value).length; }"""


def start(ros: Ros, scenario: Path, policy: Path, *options: object) -> tuple[subprocess.Popen[str], int]:
    """A flight with a page at any port: its process, and the port."""
    given = ("--scenario", scenario, "--policy", policy, "--no-record", "--view", 0)
    flight = ros.start("uav_dc_ros.run_all", *given, *options)
    assert flight.stdout is not None
    match = LINE.search(wait_for(flight.stdout, "live view: "))
    assert match is not None
    return flight, int(match[1])


def test_a_page_receives_the_mission_and_ends_with_it(
    ros: Ros, small_scenario: Path, small_policy: Path
) -> None:
    flight, port = start(ros, small_scenario, small_policy, "--pace", 100, "--namespace", "uav1", "--seed", 7)
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.request("GET", "/news")
    lines = connection.getresponse().read().decode().split("\n")  # until the end of the run
    status, output = finish(flight)
    assert status == 0, output
    assert "Traceback" not in output
    assert is_free(port), "without a terminal nothing stays"
    assert "event: end" in lines
    news = [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: {")]
    missions = [one for each in news for one in each["missions"]]
    steps = [step["step"] for one in missions for step in one.get("steps", [])]
    assert steps == list(range(STEPS + 1)), "each step once, the first and the last, too"
    (head,) = [one["head"] for one in missions if "head" in one]
    assert (head["namespace"], head["seed"], head["world"]["name"]) == ("/uav1", 7, "small")
    assert len(news) >= 10, "while it flew"
    assert missions[-1]["now"]["over"]


SLOW_VIEW = """
import sys
from uav_dc_ros.nodes import web_view
from uav_dc_ros.nodes.framework import node_main
web_view.WebViewNode.pause_s = 2.0
node_main.main(web_view.WebViewNode)
"""


def test_a_page_receives_the_steps_that_the_view_had_not_handled(
    ros: Ros, small_scenario: Path, small_policy: Path
) -> None:
    """A mission passes while the view pauses, and then it is stopped."""
    arguments = ("--ros-args", "-p", f"scenario:={small_scenario}", "-p", "port:=0")
    with python(ros, SLOW_VIEW, *arguments, stderr=subprocess.PIPE) as view:
        assert view.stderr is not None
        match = LINE.search(wait_for(view.stderr, "live view: "))
        assert match is not None
        connection = http.client.HTTPConnection("127.0.0.1", int(match[1]), timeout=PATIENCE_S)
        connection.request("GET", "/news")
        response = connection.getresponse()
        given = ("--scenario", small_scenario, "--policy", small_policy, "--pace", "lockstep", "--no-record")
        status, output = ros.run_all(*given)
        view.terminate()
        lines = response.read().decode().split("\n")
    assert status == 0, output
    shown = [one for line in lines if line.startswith("data: {") for one in json.loads(line[6:])["missions"]]
    assert shown[-1]["now"]["over"]
    assert [step["step"] for one in shown for step in one.get("steps", [])][-1] == STEPS


class Opened:
    """A page in a browser; `wrong`: errors that it logged, and requests to others than its server."""

    def __init__(self, browser: Any, port: int, **how: Any) -> None:
        self.wrong: list[str] = []
        self.context = browser.new_context(**how)
        self.page = self.context.new_page()
        self.page.on("console", lambda message: message.type == "error" and self.wrong.append(message.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        own = re.compile(rf"http://127\.0\.0\.1:{port}/|data:")
        self.page.on("request", lambda asked: own.match(asked.url) or self.wrong.append(asked.url))
        self.page.goto(f"http://127.0.0.1:{port}/")
        self.page.locator("canvas.scene3d").first.wait_for(timeout=1000 * PATIENCE_S)

    def wait(self, expression: str, argument: Any = None) -> None:
        self.page.wait_for_function(expression, arg=argument, timeout=1000 * PATIENCE_S)


@pytest.mark.long
def test_a_browser_sees_two_uavs_move_and_goes_back_in_time(ros: Ros) -> None:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    given = ("--scenario", SHIPPED, "--pace", 15, "--no-record")
    flight, port = start(ros, SHIPPED, f"{SHIPPED}_dueling", "--pace", 15, "--namespace", "uav1")
    other = ros.start("uav_dc_ros.run_all", *given, "--seed", 5, "--missions", 9, "--namespace", "uav2")
    begin = ",".join(f"{value:g}" for value in scenarios.load(SHIPPED).mission.start_m)
    try:
        with playwright.sync_playwright() as started:
            browser = started.chromium.launch(executable_path=CHROMIUM, args=ROOT)
            desktop = Opened(browser, port, viewport={"width": 1280, "height": 800}, color_scheme="light")
            for namespace in ("/uav1", "/uav2"):
                desktop.wait(f"(n) => ({UAV})(n)", namespace)
                first = desktop.page.evaluate(UAV, namespace)
                desktop.wait(f"([n, at]) => String(({UAV})(n)) !== String(at)", [namespace, first])
            assert desktop.page.evaluate(INKED) > 1000
            desktop.page.get_by_label("Step", exact=True).focus()
            desktop.page.keyboard.press("Home")
            desktop.wait("() => window.view.state.step === 0")
            desktop.wait(f"() => String(({UAV})('/uav1')) === '{begin}'")
            assert desktop.page.locator("#position").inner_text().startswith("step 0 of")
            desktop.page.get_by_role("button", name="Live").click()
            desktop.wait(f"() => String(({UAV})('/uav1')) !== '{begin}'")

            phone = Opened(browser, port, viewport={"width": 360, "height": 640}, color_scheme="dark")
            phone.wait(f"() => ({UAV})('/uav1')")
            wide, window = phone.page.evaluate("() => [document.documentElement.scrollWidth, innerWidth]")
            assert wide <= window
            assert (
                phone.page.evaluate("() => getComputedStyle(document.body).backgroundColor")
                == "rgb(17, 22, 28)"
            )

            status, output = finish(flight)
            assert status == 0, output
            for opened in (desktop, phone):
                opened.page.locator("#link", has_text="The run has ended").wait_for(timeout=1000 * PATIENCE_S)
            desktop.page.get_by_label("Step", exact=True).focus()
            desktop.page.keyboard.press("Home")
            desktop.wait(f"() => String(({UAV})('/uav1')) === '{begin}'")
            assert desktop.wrong == phone.wrong == []
            browser.close()
    finally:
        other.send_signal(signal.SIGINT)
        finish(other)


@pytest.mark.long
def test_on_a_terminal_the_page_stays_until_ctrl_c(
    ros: Ros, small_scenario: Path, small_policy: Path
) -> None:
    terminal, end = pty.openpty()
    command = [sys.executable, "-m", "uav_dc_ros.run_all", "--scenario", str(small_scenario), "--policy"]
    command += [str(small_policy), "--no-record", "--pace", "lockstep", "--view", "0"]
    environment = {name: value for name, value in ros.environment.items() if "DISPLAY" not in name}
    flight = subprocess.Popen(
        command, stdin=end, stdout=end, stderr=end, env=environment, start_new_session=True, cwd=ros.folder
    )
    os.close(end)
    shown = ""
    deadline_s = time.monotonic() + 120
    while "until Ctrl-C" not in shown:
        assert time.monotonic() < deadline_s, shown
        shown += os.read(terminal, 4096).decode(errors="replace")
    match = re.search(r"http://127\.0\.0\.1:(\d+)/ until Ctrl-C", shown)
    assert match is not None, shown
    connection = http.client.HTTPConnection("127.0.0.1", int(match[1]), timeout=PATIENCE_S)
    connection.request("GET", "/news")
    response = connection.getresponse()
    news = json.loads(response.fp.readline().removeprefix(b"data: "))
    assert news["missions"][0]["now"]["over"]
    flight.send_signal(signal.SIGINT)
    assert flight.wait(60) == 0, "the mission's own status"
    os.close(terminal)
    assert is_free(int(match[1]))
