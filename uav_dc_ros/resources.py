"""Where the files that come with the package lie: inside it when installed, beside it in a checkout."""

from pathlib import Path

# Resolved: `colcon build --symlink-install` reaches the package, and nothing beside it, through a link.
_PACKAGE = Path(__file__).resolve().parent


def folder(name: str) -> Path:
    """The folder `policies`, `msgs_json` or one in `share`.

    Raises:
        FileNotFoundError: an installation without it.
    """
    places = (_PACKAGE / name, _PACKAGE.parent / name)
    for place in places:
        if place.is_dir():
            return place
    raise FileNotFoundError(f"no folder {name}: expected it at {' or '.join(map(str, places))}")
