"""A page: template, style, scripts, data and Plotly in one file without network access.

Plotly's JavaScript comes from the installed Python package. It is compressed, as is all data; the browser
decompresses it. Base64 holds no `<`, so no text of a bag can end its script element.
"""

import base64
import gzip
import html
import importlib.resources
import re
from typing import Any

import msgspec

from uav_dc_ros.core import channel, radio, reward
from uav_dc_ros.core.obstacles import Obstacle
from uav_dc_ros.core.obstacles.mesh import faces_m
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ParameterError

PAGE_MAX = 3_000_000  # bytes
FOLDER = importlib.resources.files("uav_dc_ros.recordings.pages")


class Page:
    """A page with a title; `kind`, `mission` or `compare`, names the script that draws it."""

    def __init__(self, kind: str, title: str) -> None:
        scripts = (
            ("common", "system", "vehicle", "flight_log", kind) if kind == "mission" else ("common", kind)
        )
        self._parts = {
            "title": html.escape(title),
            "style": _text("style.css"),
            "script": "\n".join(_text(f"{script}.js") for script in scripts),
            "plotly": _packed(_plotly()),
        }
        self._data: list[str] = []
        self._size = len(self.content())

    def add(self, name: str, data: Any, min_room: int = 0) -> bool:
        """Add data under a name; False if it does not fit with `min_room` bytes to spare."""
        script = f'<script type="text/plain" id="{name}">{_packed(msgspec.json.encode(data))}</script>\n'
        if self._size + len(script) + min_room > PAGE_MAX:
            return False
        self._data.append(script)
        self._size += len(script)
        return True

    def content(self) -> bytes:
        """The whole page, UTF-8."""
        parts = self._parts | {"data": "".join(self._data)}
        return re.sub(r"\{\{(\w+)\}\}", lambda name: parts[name[1]], _text("page.html")).encode()


def world_data(scenario: Scenario) -> dict[str, Any]:
    """The world as page data."""
    grid, mission = scenario.grid, scenario.mission
    top_m = grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m
    return {
        **msgspec.to_builtins(grid),
        **msgspec.to_builtins(mission),
        **msgspec.to_builtins(scenario.reward),
        "data_words": reward.DATA[scenario.reward.data],
        "reward_words": reward.MISSION_REWARD[scenario.reward.data],
        "name": scenario.name,
        "fingerprint": scenario.fingerprint,
        "channel": channel.title(scenario.radio),
        **({"battery_j": scenario.energy.battery_j} if scenario.energy else {}),
        "users": scenario.n_users,
        "clusters": scenario.cluster_centres_m,
        **({"cluster_names": names} if (names := scenario.users.cluster_names) else {}),
        "cluster_radii_m": [disc.radius_m for disc in scenario.users.clusters],
        "obstacles": [_obstacle_data(one, 1.15 * top_m) for one in scenario.obstacles],
        "top_m": top_m,
        "reach_m": radio.ground_reach_m(mission.d_cons_m, grid.altitude_min_m),
    }


def _obstacle_data(obstacle: Obstacle, ceiling_m: float) -> dict[str, Any]:
    """An obstacle as page data; `faces` are triangles of the corners in x, y and z."""
    faces = faces_m(obstacle, ceiling_m).reshape(-1, 3)
    altitudes = f"{obstacle.base_m:g} to {obstacle.height_m:g} m" if obstacle.height_m else "all altitudes"
    words = {"building": "building", "no_fly": "no-fly zone"}[obstacle.kind]
    return {
        "kind": obstacle.kind,
        "words": f"{words} {obstacle.name}, {altitudes}".replace(" ,", ","),
        "polygon_m": obstacle.polygon_m,
        **dict(zip("xyz", faces.T.tolist(), strict=True)),
    }


def _plotly() -> bytes:
    try:
        from plotly.offline import get_plotlyjs  # type: ignore[import-untyped]
    except ImportError:
        raise ParameterError(
            "a report needs plotly, which is not installed; expected the extra `report`: "
            "pip install 'uav_dc_ros[report]'"
        ) from None
    return str(get_plotlyjs()).encode()


def _packed(content: bytes) -> str:
    """Compressed text; equal for equal content."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def _text(name: str) -> str:
    return (FOLDER / name).read_text("utf-8")
