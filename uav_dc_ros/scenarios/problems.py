"""Every problem of a scenario file at once, each with its line, where `parse` reports the first.

After a problem the value is replaced by a valid one, so that the next problem shows. Whether values fit
together is checked once all that matter for it are valid.
"""

import copy
import difflib
import itertools
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias, get_args, get_origin, get_type_hints

import msgspec

from uav_dc_ros.core import scenario as core
from uav_dc_ros.core.keys import path_of
from uav_dc_ros.core.propagation import gain_map
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ScenarioError, UnknownKeyError
from uav_dc_ros.scenarios import with_files
from uav_dc_ros.scenarios.lines import Lines
from uav_dc_ros.scenarios.user_files import with_users
from uav_dc_ros.scenarios.zone_files import with_zones

PROBLEMS_MAX = 50
# Valid for some key each, beside the choices of the keys that have some.
_STAND_INS: tuple[Any, ...] = (
    {},
    1,
    1.0,
    1e9,
    "a",
    [],
    [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
    [1.0, 1.0],
    [1.0, 1.0, 1.0],
    True,
)
Key: TypeAlias = tuple[str | int, ...]
# Arrays of tables that may come from a file, and the key with its name.
_FILES: dict[Key, Key] = {("users", "user"): ("users", "file"), ("obstacles",): ("zones",)}
# Values in these do not decide whether others fit together.
_APART = ("name", "reward")


class Problem(NamedTuple):
    """One problem of a file."""

    line: int | None  # counted from 1; None: a table or key that the file lacks, at its top level
    text: str  # key, value and what was expected

    def within(self, source: str) -> str:
        """The problem with the file and the line in front."""
        return f"{source}:{self.line}: {self.text}" if self.line else f"{source}: {self.text}"


def find(text: str, folder: Path) -> tuple[Scenario | None, list[Problem]]:
    """The scenario in a text; or None, and the first `PROBLEMS_MAX` problems in the order of their lines.

    Files that it names are relative to `folder`.
    """
    try:
        return core.from_values(with_files(core.read_values(text, ""), folder, ""), ""), []
    except ScenarioError:
        found = itertools.islice(_problems(text, folder), PROBLEMS_MAX)
    return None, sorted(found, key=lambda problem: problem.line or 0)


def line_of(lines: Lines, path: Key) -> int | None:
    """The line of a key; for what is in another file, that of the file's name."""
    for inner, file in _FILES.items():
        if path[: len(inner)] == inner and lines.exactly(path[: len(inner) + 1]) is None:
            return lines.of(file)
    return lines.of(path)


def _problems(text: str, folder: Path) -> Iterator[Problem]:
    try:
        values = core.read_values(text, "")
    except ScenarioError as error:
        line = re.search(r"at line (\d+)", str(error))
        yield Problem(int(line[1]) if line else text.count("\n") + 1, _text(error))
        return
    lines = Lines(text)
    values = core.with_radio_model(copy.deepcopy(values))
    unknown: dict[Key, Any] = {}  # removed keys and their values
    meant: dict[Key, Key] = {}  # keys, and how they are misspelt in the file
    hidden: list[Key] = []  # tables that are not checked further
    fit = True
    resolves: tuple[tuple[Key, Any], ...] = (
        (("zones",), with_zones),
        (("users", "file"), with_users),
        (("radio", "sha256"), gain_map.with_absolute_path),
    )
    for key, resolve in resolves:
        try:
            values = resolve(values, folder, "")
        except ScenarioError as error:
            yield Problem(lines.of(key), _text(error))
            del _around(values, key)[key[-1]]
            hidden.append(key[:1])
            fit = False
    while True:
        try:
            scenario = core.with_types(values, "")
            break
        except ScenarioError as error:
            path, problem = error.path, _text(error)
            is_unknown = isinstance(error, UnknownKeyError)
        if path[-1] not in _around(values, path) and (typo := _typo(path, unknown)) is not None:
            meant[path] = typo
            _around(values, path)[path[-1]] = unknown.pop(typo)
            continue
        if not any(path[: len(table)] == table for table in hidden):
            fit = fit and path[0] in _APART
            yield Problem(line_of(lines, meant.get(path, path)), problem)
        if is_unknown:
            unknown[path] = _around(values, path).pop(path[-1])
        elif not _repair(values, path, hidden):
            return
    if fit:
        for problem in core.inconsistencies(scenario):
            yield Problem(line_of(lines, path_of(problem)), problem)


def _text(error: ScenarioError) -> str:
    return str(error).removeprefix(": ")


def _typo(path: Key, unknown: dict[Key, Any]) -> Key | None:
    """The unknown key that was meant for a missing one; None: there is none."""
    beside = {str(other[-1]): other for other in unknown if other[:-1] == path[:-1]}
    close = difflib.get_close_matches(str(path[-1]), beside, n=1)
    return beside[close[0]] if close else None


def _repair(values: dict[str, Any], path: Key, hidden: list[Key]) -> bool:
    """Replace a value by one that is valid; False if none of the stand-ins is."""
    around = _around(values, path)
    for stand_in in (*_STAND_INS, *_choices(Scenario)):
        around[path[-1]] = copy.deepcopy(stand_in)
        try:
            core.with_types(values, "")
        except ScenarioError as error:
            # An error within is no error of the value only where a table takes its place.
            if error.path == path or (stand_in != {} and error.path[: len(path)] == path):
                continue
        # What a table lacks, or has too much for its new model, is no problem of the file.
        hidden += [path] if stand_in == {} else [path[:-1]] if path[-1] == "model" else []
        return True
    return False


def _around(values: Any, path: Key) -> Any:
    for part in path[:-1]:
        values = values[part]
    return values


@cache
def _choices(kind: Any) -> tuple[str, ...]:
    """Every text that some key of a table may have as one of its choices."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        tag = kind.__struct_config__.tag
        hints = get_type_hints(kind).values()
        return (*((str(tag),) if tag else ()), *(text for hint in hints for text in _choices(hint)))
    inner = get_args(kind)[:1] if get_origin(kind) is Annotated else get_args(kind)
    return tuple(text for one in inner for text in ((one,) if isinstance(one, str) else _choices(one)))
