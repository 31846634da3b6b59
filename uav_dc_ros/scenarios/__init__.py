"""The shipped scenario files, and the loader of any scenario.

A scenario is named by the name of a shipped one, by the path of a TOML file, or as `random:SEED`: the random
field of a seed, as the command `scenario random --seed SEED` writes it.
"""

import importlib
import re
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from uav_dc_ros.core.propagation import gain_map
from uav_dc_ros.core.scenario import Scenario, from_values, read_values
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.scenarios.user_files import with_users
from uav_dc_ros.scenarios.zone_files import with_zones

FOLDER = Path(__file__).parent
RANDOM = "random:"  # before the seed of a random field
_RANDOM_FIELD = re.compile(rf"{RANDOM}([0-9]{{1,18}})")


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
            f"{RANDOM}SEED with a whole number, or the path of a TOML file"
        )
    return path


def folder(name_or_path: str | Path) -> Path:
    """The folder to which the files that a scenario names are relative; raises ScenarioError as `find`."""
    return Path() if _seed(name_or_path) is not None else find(name_or_path).parent


def from_anywhere(name_or_path: str | Path) -> str:
    """The same scenario for a process in another folder: its name, or the absolute path of its file."""
    text = str(name_or_path)
    return text if text in names() or _seed(text) is not None else str(Path(text).absolute())


def load(name_or_path: str | Path) -> Scenario:
    """The scenario with a shipped name, of a random field, or in the TOML file at a path, with the users of
    `users.file` and the obstacles of `zones`.

    Raises:
        ScenarioError: no such name or file, or a file that `core.scenario.parse`, `user_files` or
            `zone_files` rejects.
        ParameterError: no field of the seed can be flown.
    """
    source = str(name_or_path)
    values = read_values(read(name_or_path), source)
    return from_values(with_files(values, folder(name_or_path), source), source)


def with_files(values: dict[str, Any], folder: Path, source: str) -> dict[str, Any]:
    """Plain values of a scenario with what is in its files, relative to `folder`; raises ScenarioError.

    A gain map stays in its file: the values get its absolute path and its SHA-256.
    """
    values = gain_map.with_absolute_path(values, folder, source)
    return with_users(with_zones(values, folder, source), folder, source)


def read(name_or_path: str | Path) -> str:
    """The text of a scenario's TOML file; raises ScenarioError for one that cannot be found or read.

    Also ParameterError, see `load`.
    """
    if (seed := _seed(name_or_path)) is not None:
        # By its name: otherwise whatever trains in a scenario would depend on the code that draws fields.
        generation = importlib.import_module("uav_dc_ros.scenarios.generation.random_field")
        text: str = generation.text(seed)
        return text
    try:
        return find(name_or_path).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{name_or_path}: cannot be read: {error}") from None


def _seed(name_or_path: str | Path) -> int | None:
    """The seed of a random field; None: it is none."""
    match = _RANDOM_FIELD.fullmatch(str(name_or_path))
    return int(match[1]) if match else None
