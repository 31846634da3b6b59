"""Where the files that come with the package lie: inside it when installed, beside it in a checkout."""

from pathlib import Path

_PACKAGE = Path(__file__).parent


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
