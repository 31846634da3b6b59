"""A page: template, style, scripts, data and Plotly in one file that needs no network.

Plotly's JavaScript comes from the installed Python package and is compressed, as is all data: a browser
unpacks it while it opens the page. Base64 holds no `<`, so nothing that a bag says can end its script
element.
"""

import base64
import gzip
import html
import importlib.resources
import re
from typing import Any

import msgspec

from uav_dc_ros.errors import ParameterError

PAGE_MAX = 3_000_000  # bytes
FOLDER = importlib.resources.files("uav_dc_ros.recordings.pages")


class Page:
    """A page that is put together.

    Args:
        kind: `mission` or `compare`: the script that draws it.
        title: its title.

    Raises:
        ParameterError: Plotly is not installed.
    """

    def __init__(self, kind: str, title: str) -> None:
        scripts = ("common", "system", "vehicle", kind) if kind == "mission" else ("common", kind)
        self._parts = {
            "title": html.escape(title),
            "style": _text("style.css"),
            "script": "\n".join(_text(f"{script}.js") for script in scripts),
            "plotly": _packed(_plotly()),
        }
        self._data: list[str] = []
        self._size = len(self._whole())

    def room(self) -> int:
        """Bytes that a page may still take."""
        return PAGE_MAX - self._size

    def add(self, name: str, data: Any, least_room: int = 0) -> bool:
        """Add data under a name, if it fits and leaves some room; tells whether it did."""
        script = f'<script type="text/plain" id="{name}">{_packed(msgspec.json.encode(data))}</script>\n'
        if len(script) + least_room > self.room():
            return False
        self._data.append(script)
        self._size += len(script)
        return True

    def content(self) -> bytes:
        """The whole page, UTF-8."""
        return self._whole().encode()

    def _whole(self) -> str:
        parts = self._parts | {"data": "".join(self._data)}
        return re.sub(r"\{\{(\w+)\}\}", lambda name: parts[name[1]], _text("page.html"))


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
    """Compressed, as text; equal for equal content."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def _text(name: str) -> str:
    return (FOLDER / name).read_text("utf-8")
