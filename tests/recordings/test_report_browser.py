"""Reports in a real browser: Chromium opens them from disk, without a screen and without a network."""

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.recordings import report_bags
from tests.recordings.test_flight_log import ardupilot
from tests.recordings.test_report import HOSTILE, report
from tests.support import flights
from tests.support.worlds import tiny
from uav_dc_ros import cdr, messages

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
if CHROMIUM is None:
    pytest.skip("no Chromium on this machine", allow_module_level=True)
playwright = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")

# WebGL without a GPU; the sandbox of a browser does not work for root, as in containers.
WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
ROOT = ("--no-sandbox",) if os.geteuid() == 0 else ()
DRAWN_MS = 200_000
DESKTOP, PHONE = {"width": 1010, "height": 600}, {"width": 360, "height": 640}
SMALL = {"width": 600, "height": 400}  # without a GPU, the time to draw in 3D grows with the pixels
# Position of the UAV in the scene, and of the line in a chart, as Plotly holds them.
UAV = """() => { const uav = document.getElementById("scene").data.find((trace) => trace.name === "UAV");
    return [uav.x[0], uav.y[0], uav.z?.[0]]; }"""
SHOWN = """() => ["not collected", "being served", "collected"].map((name) =>
    document.getElementById("scene").data.find((trace) => trace.name === name).x.length)"""
CURSOR = """() => document.getElementById("reward").layout.shapes[0].x0"""
WIDTHS = "() => [document.documentElement.scrollWidth, window.innerWidth]"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """What launches Chromium."""
    with playwright.sync_playwright() as started:
        yield started.chromium


@pytest.fixture(scope="module")
def browser(chromium: Any) -> Iterator[Any]:
    """Chromium without WebGL: it draws the scene as a map, in a tenth of the time."""
    launched = chromium.launch(executable_path=CHROMIUM, args=["--disable-3d-apis", *ROOT])
    yield launched
    launched.close()


@pytest.fixture
def browser_3d(chromium: Any) -> Iterator[Any]:
    """Chromium with software WebGL."""
    launched = chromium.launch(executable_path=CHROMIUM, args=[*WEBGL, *ROOT])
    yield launched
    launched.close()


@pytest.fixture(scope="module")
def mission_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of two missions of a bag whose every text is hostile."""
    folder = tmp_path_factory.mktemp("report")
    scenario = tiny(
        mission={"max_steps": 12, "r_min_bits": 4e6, "d_cons_m": 150.0}, energy={"battery_j": 5e4}
    )
    diagnostics = report_bags.diagnostics(
        HOSTILE, 2, HOSTILE, {HOSTILE: HOSTILE, "restarts": "3", "cpu [%]": "12"}
    )
    bag = report_bags.write(
        folder / "<script>window.hacked=1<",
        scenario,
        seeds=(5, 6),
        about={"policy": HOSTILE, "pace": HOSTILE},
        extra=(("/diagnostics", "", diagnostics), ("/diagnostics", "", diagnostics)),
    )
    assert report(bag, "--out", folder / "page.html") == 0
    return folder / "page.html"


@pytest.fixture(scope="module")
def comparison_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page that compares two bags."""
    folder = tmp_path_factory.mktemp("comparison")
    bags = [
        report_bags.write(folder / f"<img src=x onerror=window.hacked=1>{i}", tiny(), seeds=(1, 2, 3 + i))
        for i in range(2)
    ]
    assert report(*bags[:1], "--compare", *bags[1:], "--out", folder / "page.html") == 0
    return folder / "page.html"


class Opened:
    """A page in a browser.

    Attributes:
        wrong: errors that it logged, and addresses that it requested.
    """

    def __init__(self, browser: Any, path: Path, size: dict[str, int], **how: Any) -> None:
        self.wrong: list[str] = []
        self.context = browser.new_context(viewport=size, offline=True, **how)
        self.page = self.context.new_page()
        self.page.on("console", lambda message: message.type == "error" and self.wrong.append(message.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", self._requested)
        self.page.goto(path.as_uri())
        self.page.locator("main:not([aria-busy])").wait_for(timeout=DRAWN_MS)

    def _requested(self, request: Any) -> None:
        if not re.match(r"file:.*/page\.html$|data:|blob:", request.url):
            self.wrong.append(f"requested {request.url}")

    def check(self) -> None:
        """Nothing went wrong until now."""
        assert self.wrong == []
        assert self.page.evaluate("() => window.hacked ?? null") is None, "a text of the bag was executed"


@pytest.fixture(scope="module")
def desktop(browser: Any, mission_page: Path) -> Iterator[Opened]:
    """The page of a bag on a desk."""
    opened = Opened(browser, mission_page, DESKTOP, color_scheme="light")
    yield opened
    opened.context.close()


@pytest.fixture
def page(desktop: Opened) -> Iterator[Any]:
    """It at the first step of its first mission; nothing may go wrong in a test."""
    if desktop.page.get_by_label("Mission", exact=True).input_value() != "0":
        desktop.page.get_by_label("Mission", exact=True).select_option("0")
        desktop.page.locator("#about", has_text="mission 0, seed 5").wait_for()
    desktop.page.get_by_label("Step", exact=True).focus()
    desktop.page.keyboard.press("Home")
    yield desktop.page
    desktop.check()


def scene_kinds(page: Any) -> set[str]:
    """Kinds of Plotly's traces in the scene."""
    return set(page.evaluate("() => document.getElementById('scene').data.map((trace) => trace.type)"))


def luminance(page: Any, element: str, what: str) -> float:
    """How light an element's colour is, from 0 to 1 (WCAG's relative luminance)."""
    css = page.evaluate(f"() => getComputedStyle(document.querySelector('{element}')).{what}")
    parts = [int(part) / 255 for part in re.findall(r"\d+", css)[:3]]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(page: Any, element: str) -> float:
    """Of an element's text on the cards, by WCAG; 4.5 can be read."""
    light, dark = sorted((luminance(page, element, "color"), luminance(page, ".card", "backgroundColor")))
    return (dark + 0.05) / (light + 0.05)


def test_the_slider_moves_the_uav_and_colours_the_users(page, mission_page):
    course = report_bags.unpacked(mission_page)["mission-0"]["steps"]
    seen = set()
    for step, wanted in enumerate(course):
        assert page.evaluate(UAV)[:2] == wanted["uav_m"][:2], step
        assert page.evaluate(SHOWN) == [wanted["state"].count(code) for code in "012"]
        assert page.evaluate(CURSOR) == step
        assert f"step {step} of 12" in page.locator("#position").inner_text()
        seen.add(tuple(wanted["uav_m"]))
        page.keyboard.press("ArrowRight")
    assert len(seen) > 3, "the UAV flies"
    charges = [100.0 * wanted["state_of_charge"] for wanted in course]
    assert page.evaluate("() => document.getElementById('charge').data[0].y") == pytest.approx(charges)
    assert charges[0] == 100.0 > charges[-1] > 0.0


def test_play_flies_step_by_step_to_the_end(page):
    page.evaluate("""() => {
        window.seen = [];
        const output = document.getElementById("position");
        const note = () => window.seen.push(Number(output.textContent.match(/step (\\d+)/)[1]));
        new MutationObserver(note).observe(output, { childList: true });
    }""")
    page.get_by_role("button", name="Play").click()
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Play").click()
    page.locator("#position", has_text="step 12 of 12").wait_for()
    page.get_by_role("button", name="Play").wait_for()
    seen = page.evaluate("() => window.seen")
    assert seen == sorted(seen)
    assert set(seen) >= set(range(1, 13))


def test_another_mission_and_tables_in_order(page, mission_page):
    data = report_bags.unpacked(mission_page)
    page.get_by_label("Mission", exact=True).select_option("1")
    page.locator("#about", has_text="mission 1, seed 6").wait_for()
    assert page.evaluate(UAV)[:2] == data["mission-1"]["steps"][-1]["uav_m"][:2]
    table = data["mission-1"]["table"]
    wanted = sorted(table["user"], key=lambda user: (-table["data_bits"][user], user))
    head = page.get_by_role("region", name="Table of users").get_by_role("button", name="data")
    head.click()
    head.click()
    rows = page.locator("#users tbody tr")
    assert [int(user) for user in rows.locator("td:first-child").all_inner_texts()] == wanted
    assert page.locator("#users th[aria-sort]").get_attribute("aria-sort") == "descending"
    rows.first.click()
    chosen = "() => document.getElementById('scene').data.find((trace) => trace.name === 'chosen').x"
    users_m = data["mission-1"]["steps"][-1]["users_m"]
    assert page.evaluate(chosen) == [users_m[0][wanted[0]]]


def test_hostile_text_is_shown_as_text(page):
    assert HOSTILE in page.locator("#about").inner_text()
    assert page.get_by_role("region", name="Nodes").get_by_text(HOSTILE).count() >= 1
    assert page.get_by_role("region", name="Faults").get_by_text("restarts: 3").count() == 1
    assert page.locator("img").count() == 0
    assert "window.hacked" in page.locator("#cpu").inner_text()


def test_figures_follow_a_change_of_the_colours(page):
    ink = "() => document.getElementById('reward').layout.font.color"
    light, here = page.evaluate(ink), page.evaluate(UAV)
    page.emulate_media(color_scheme="dark")
    page.wait_for_timeout(300)
    assert page.evaluate(ink) != light
    assert page.evaluate(UAV) == here, "and time stands where it stood"


def check_on_a_phone(page: Any) -> None:
    """Nothing stands out to the side, figures fill the width, and text can be read, dark or light."""
    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)
        width, window = page.evaluate(WIDTHS)
        assert width <= window == PHONE["width"]
        paper = luminance(page, "body", "backgroundColor")
        assert paper < 0.02 if scheme == "dark" else paper > 0.8
        for element in ("h1", ".sub", ".note", ".legend", "thead th", "td", "footer"):
            assert contrast(page, element) >= 4.5, (scheme, element)
    for chart in page.locator(".chart, .scene").all():
        box = chart.bounding_box()
        assert PHONE["width"] > box["width"] > 250
        assert box["height"] > 60


def test_a_phone_shows_all_of_a_mission(browser, mission_page):
    opened = Opened(browser, mission_page, PHONE, color_scheme="dark", is_mobile=True, has_touch=True)
    check_on_a_phone(opened.page)
    opened.check()
    opened.context.close()


def test_the_scene_is_drawn_in_3d(browser_3d, mission_page):
    course = report_bags.unpacked(mission_page)["mission-0"]["steps"]
    opened = Opened(browser_3d, mission_page, SMALL)
    assert scene_kinds(opened.page) == {"scatter3d", "mesh3d"}
    opened.page.get_by_label("Step", exact=True).focus()
    for key, wanted in (("Home", course[0]), ("ArrowRight", course[1]), ("End", course[-1])):
        opened.page.keyboard.press(key)
        assert opened.page.evaluate(UAV) == wanted["uav_m"]
    opened.check()


def test_without_webgl_there_is_a_map(page):
    assert page.get_by_role("button", name="3D").is_disabled()
    assert scene_kinds(page) == {"scatter"}


@pytest.mark.long
def test_the_flight_of_a_real_vehicle(browser, tmp_path):
    """The page shows its reason and phases, and draws its path up to the slider's step."""
    scenario = tiny()
    flight = flights.Flight(scenario, beat=flights.FAULTS["battery"][0])
    texts = [cdr.decode_string(m.data) for m in flight.fly() if m.topic == "/mission"]
    statuses = [messages.decode(text, messages.Mission) for text in texts]
    recorded = [with_reason(m, statuses[-1], HOSTILE) for m in flight.told]
    bag = flights.write(tmp_path / "bag", recorded, flights.flown_about(scenario))
    assert report(bag, "--out", tmp_path / "page.html") == 0
    timeline = report_bags.unpacked(tmp_path / "page.html")["mission-0"]["timeline"]
    columns = (timeline["path"][axis] for axis in "sxyz")
    log = ardupilot(
        tmp_path / "f.bin", [(round(s * 1e6), np.array(at)) for s, *at in zip(*columns, strict=True)]
    )
    assert report(bag, "--out", tmp_path / "page.html", "--log", log) == 0
    opened = Opened(browser, tmp_path / "page.html", DESKTOP)
    page = opened.page
    deviation_m = page.evaluate("() => document.getElementById('log-deviation').data[0].y")
    assert 0 < max(filter(None, deviation_m)) < 0.2, "the page's path is thinned"
    assert page.evaluate("() => document.getElementById('log-battery').data.length") == 2
    events = page.get_by_role("region", name="Events of the log").locator("tbody tr")
    assert "GUIDED" in events.first.inner_text()
    assert page.locator("#why").inner_text() == f"aborted: {HOSTILE}"
    rows = page.get_by_role("region", name="Phases").locator("tbody tr")
    assert rows.count() == len(timeline["phases"]) == len(statuses)
    drawn = "() => document.getElementById('altitude').data.find((trace) => trace.name === 'flown').y"
    assert page.evaluate(drawn) == timeline["path"]["z"]
    flown_x = "() => document.getElementById('scene').data.find((trace) => trace.name === 'flown').x"
    assert page.evaluate(flown_x) == timeline["path"]["x"]
    page.get_by_label("Step", exact=True).focus()
    page.keyboard.press("Home")
    path, began_s = timeline["path"], timeline["cells"]["s"][0]
    climb = [x for x, s in zip(path["x"], path["s"], strict=True) if s <= began_s]
    assert page.evaluate(flown_x) == climb
    assert 0 < len(climb) < len(timeline["path"]["x"])
    page.set_viewport_size(PHONE)
    page.wait_for_function("() => document.querySelector('#altitude .main-svg').clientWidth < 360")
    check_on_a_phone(page)
    opened.check()
    opened.context.close()


def with_reason(message: Any, last: messages.Mission, reason: str) -> Any:
    """The message, with another reason if it is the last status."""
    if message.data != cdr.encode_string(messages.encode(last)):
        return message
    other = msgspec.structs.replace(last, reason=reason)
    return message._replace(data=cdr.encode_string(messages.encode(other)))


@pytest.mark.long
def test_a_comparison_is_drawn_and_fits_a_phone_too(browser_3d, comparison_page):
    groups = report_bags.unpacked(comparison_page)["data"]["groups"]
    opened = Opened(browser_3d, comparison_page, SMALL)
    page = opened.page
    drawn = page.evaluate("() => document.getElementById('scene').data.slice(-2).map((t) => t.x.length)")
    assert drawn == [sum(len(track[0]) + 1 for track in group["paths"]) for group in groups]
    row = page.get_by_role("region", name="Paired differences").locator("tbody tr td")
    assert row.nth(0).inner_text().strip() == groups[1]["label"]
    assert row.nth(1).inner_text() == "2"
    page.get_by_role("button", name="map").click()
    assert scene_kinds(page) == {"scatter"}
    page.set_viewport_size(PHONE)
    page.wait_for_function("() => document.querySelector('#reward .main-svg').clientWidth < 360")
    check_on_a_phone(page)
    opened.check()
    opened.context.close()


@pytest.mark.long
def test_a_browser_that_cannot_unpack_reports_it(browser, mission_page):
    context = browser.new_context(viewport=DESKTOP)
    context.add_init_script("delete window.DecompressionStream")
    page = context.new_page()
    page.goto(mission_page.as_uri())
    page.locator("#notice", has_text="too old").wait_for()
    context.close()
