"""The page of the live view: one file, in the style of reports, that requests nothing but its own news."""

import importlib.resources

FOLDER = importlib.resources.files("uav_dc_ros.nodes.view.web")
SHARED = importlib.resources.files("uav_dc_ros.recordings.pages")  # style and elements
STYLES = ((SHARED, "style.css"), (FOLDER, "view.css"))
SCRIPTS = ((SHARED, "common.js"), (FOLDER, "scene.js"), (FOLDER, "charts.js"), (FOLDER, "view.js"))


def page() -> bytes:
    """The page, UTF-8."""
    style, script = (
        "\n".join((folder / name).read_text("utf-8") for folder, name in parts) for parts in (STYLES, SCRIPTS)
    )
    template = (FOLDER / "page.html").read_text("utf-8")
    return template.replace("{{style}}", style).replace("{{script}}", script).encode()
