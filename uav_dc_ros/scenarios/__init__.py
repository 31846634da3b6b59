"""Scenario files that come with the package, and the way to any other."""

from importlib.resources import files
from pathlib import Path

from uav_dc_ros.core.scenario import Scenario, parse
from uav_dc_ros.errors import ScenarioError


def names() -> list[str]:
    """Names of the shipped scenarios."""
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in files(__package__).iterdir()
        if entry.name.endswith(".toml")
    )


def load(name_or_path: str | Path) -> Scenario:
    """The scenario with a shipped name, or in the TOML file at a path.

    Raises:
        ScenarioError: no such name or file, or a file that `parse` refuses.
    """
    wanted = str(name_or_path)
    if wanted in names():
        return parse((files(__package__) / f"{wanted}.toml").read_text("utf-8"), wanted)
    path = Path(name_or_path)
    try:
        if path.is_file():
            return parse(path.read_text("utf-8"), wanted)
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{wanted}: cannot be read: {error}") from None
    raise ScenarioError(
        f"scenario {wanted!r}: no such name or file; expected one of {', '.join(names())}, "
        "or the path of a TOML file"
    )
