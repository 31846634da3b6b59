"""The page of a scenario in a real browser, without a network."""

from pathlib import Path
from typing import Any

import pytest

from tests.recordings.test_report_browser import PHONE, WIDTHS, Opened, browser, chromium
from tests.support.worlds import changed
from uav_dc_ros.experiments.scenarios import page
from uav_dc_ros.experiments.scenarios.rate_map import rate_map

__all__ = ["browser", "chromium"]  # fixtures
TILES = """() => document.getElementById("scene").data.find((trace) => trace.name === "rate").z"""


def test_a_page_draws_each_layer_and_lists_problems(browser: Any, tmp_path: Path) -> None:
    centres_m = [[300.0, 300.0], [1150.0, 700.0]]
    zone = {"kind": "no_fly", "polygon_m": [[600.0, 0.0], [700.0, 0.0], [700.0, 60.0], [600.0, 60.0]]}
    users = {"cluster_centres_m": centres_m, "users_per_cluster": 3}
    scenario = changed("five_clusters_hover", users=users, obstacles=[zone])
    path = tmp_path / "page.html"
    path.write_bytes(page.content(scenario))
    opened = Opened(browser, path, PHONE)
    rates = rate_map(scenario)
    shown = []
    for layer in rates.layers:
        opened.page.get_by_role("button", name=f"{layer.altitude_m:.0f} m", exact=True).click()
        shown.append(opened.page.evaluate(TILES))
        assert f"Altitude {layer.altitude_m:.0f} m" in opened.page.locator("#layer").inner_text()
        assert shown[-1][3][2] == pytest.approx(layer.sum_rate_bps[2, 3] / 1e6, rel=1e-3)  # north, then east
    assert len({str(z) for z in shown}) == 3
    legend = opened.page.locator(".legend li").all_inner_texts()
    assert [text.strip() for text in legend[4:6]] == ["cluster", "no-fly zone"], "it names what is drawn"
    assert "88% of its disc" in opened.page.locator(".warning").inner_text()
    assert opened.page.locator("tbody tr").count() == 2
    scroll, width = opened.page.evaluate(WIDTHS)
    assert scroll <= width
    opened.check()
    opened.context.close()
