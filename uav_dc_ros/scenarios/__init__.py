"""The shipped scenario files, and the loader of any scenario."""

from pathlib import Path
from typing import Any

from msgspec.structs import replace

from uav_dc_ros.core.propagation import gain_map
from uav_dc_ros.core.scenario import Scenario, from_values, read_values
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.scenarios.user_files import with_users
from uav_dc_ros.scenarios.zone_files import with_zones

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Names of the shipped scenarios."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def as_shipped(scenario: Scenario) -> Scenario:
    """The scenario, under the name of a shipped one that is the same world.

    Names have changed in version 0.2.0: a shipped name may be that of another world now. The scenario itself
    if its name is not a shipped one, or is that of the same world, or if no shipped one is the same.
    """
    if scenario.name not in names() or load(scenario.name).fingerprint == scenario.fingerprint:
        return scenario
    for name in names():
        renamed = replace(scenario, name=name)
        if load(name).fingerprint == renamed.fingerprint:
            return renamed
    return scenario


def find(name_or_path: str | Path) -> Path:
    """The TOML file of the scenario with a shipped name or a path; raises ScenarioError if there is none."""
    path = FOLDER / f"{name_or_path}.toml" if str(name_or_path) in names() else Path(name_or_path)
    if not path.is_file():
        raise ScenarioError(
            f"scenario {str(name_or_path)!r}: no such name or file; expected one of {', '.join(names())}, "
            "or the path of a TOML file"
        )
    return path


def load(name_or_path: str | Path) -> Scenario:
    """The scenario with a shipped name, or in the TOML file at a path, with the users of `users.file`
    and the obstacles of `zones`.

    Raises:
        ScenarioError: no such name or file, or a file that `core.scenario.parse`, `user_files` or
            `zone_files` rejects.
    """
    source = str(name_or_path)
    values = read_values(read(name_or_path), source)
    return from_values(with_files(values, find(name_or_path).parent, source), source)


def with_files(values: dict[str, Any], folder: Path, source: str) -> dict[str, Any]:
    """Plain values of a scenario with what is in its files, relative to `folder`; raises ScenarioError.

    A gain map stays in its file: the values get its absolute path and its SHA-256.
    """
    values = gain_map.with_absolute_path(values, folder, source)
    return with_users(with_zones(values, folder, source), folder, source)


def read(name_or_path: str | Path) -> str:
    """The text of a scenario's TOML file; raises ScenarioError for one that cannot be found or read."""
    try:
        return find(name_or_path).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{name_or_path}: cannot be read: {error}") from None
