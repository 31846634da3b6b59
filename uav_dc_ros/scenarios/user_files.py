"""Files of users: CSV with metres or degrees, and GeoJSON. docs/users.md describes both."""

import csv
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from uav_dc_ros.core.users.settings import User
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.scenarios import geojson
from uav_dc_ros.scenarios.geojson import Coordinates, Datum

METRES, DEGREES = ("x_m", "y_m"), ("latitude", "longitude")
NUMBERS = (*METRES, *DEGREES, "radius_m", "data_bits", "priority")
_OF_USER = tuple(name for name in User.__struct_fields__ if name not in METRES)


class _Row(NamedTuple):
    """A user of a file."""

    where: str  # file and line, or feature
    values: dict[str, Any]  # by the keys of `User`, or with DEGREES in place of METRES


class _Point(msgspec.Struct, tag="Point", forbid_unknown_fields=False):
    coordinates: Coordinates


class _Feature(msgspec.Struct, tag="Feature"):
    geometry: _Point
    properties: dict[str, Any] | None = None


def with_users(values: dict[str, Any], folder: Path, source: str) -> dict[str, Any]:
    """Plain values of a scenario with `users.user` in place of `users.file`, a name relative to `folder`.

    Raises ScenarioError as `read` does, and for users in the scenario beside those of the file.
    """
    users, datum = values.get("users"), values.get("datum_deg")
    file = users.get("file") if isinstance(users, dict) else None
    if not isinstance(users, dict) or not isinstance(file, str):
        return values
    if "user" in users:
        raise ScenarioError(f"{source}: users.file = {file!r} beside users.user; expected one of them")
    try:
        datum = None if datum is None else msgspec.convert(datum, Datum)
    except msgspec.ValidationError:
        datum = None  # from_values() names the error
    others = {key: value for key, value in users.items() if key != "file"}
    return values | {"users": {**others, "user": read(folder / file, datum)}}


def read(path: Path, datum: Datum | None) -> list[dict[str, Any]]:
    """The users of a file as plain values of `User`, with positions in metres.

    `datum` is the position of the grid's origin on WGS 84, needed by a file with degrees.

    Raises:
        ScenarioError: a file that cannot be read or has no users; a column, a number or a position that is
            not as expected.
    """
    rows = _rows(path)
    if DEGREES[0] in rows[0].values:
        rows = list(_in_metres(rows, datum, path))
    for row in rows:
        try:
            msgspec.convert(row.values, User)
        except msgspec.ValidationError as error:
            expected, _, key = str(error).replace("`", "").partition(" - at $.")
            value, expected = row.values.get(key), expected.removeprefix("Expected ").replace(" | null", "")
            raise ScenarioError(f"{row.where}: {key} = {value!r}; expected {expected}") from None
    return [row.values for row in rows]


def corner_deg(path: Path) -> Datum | None:
    """South-west corner of the positions in a file with degrees; None: it has metres. Raises as `read`."""
    at = [[row.values[name] for name in DEGREES] for row in _rows(path) if DEGREES[0] in row.values]
    return (min(one[0] for one in at), min(one[1] for one in at)) if at else None


def _rows(path: Path) -> list[_Row]:
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from None
    is_csv = path.suffix.lower() == ".csv"
    if not is_csv and path.suffix.lower() not in (".geojson", ".json"):
        raise ScenarioError(f"{path}: a file of users; expected a name that ends in .csv, .geojson or .json")
    rows = list(_csv_rows(text, path) if is_csv else _geojson_rows(text, path))
    if not rows:
        raise ScenarioError(f"{path}: no users; expected at least one")
    return rows


def _csv_rows(text: str, path: Path) -> Iterator[_Row]:
    """The rows of a CSV file (RFC 4180) whose first line names the columns."""
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        names = [name.strip() for name in next(lines, [])]
        if not any(names):
            raise ScenarioError(f"{path}: no header; expected the columns {_expected()}")
        _check_names(names, f"{path}, line 1", "column")
        for cells in lines:
            where = f"{path}, line {lines.line_num}"
            if not cells:
                continue
            if len(cells) != len(names):
                raise ScenarioError(f"{where}: {len(cells)} fields; expected {len(names)}, as in line 1")
            filled = {name: cell.strip() for name, cell in zip(names, cells, strict=True) if cell.strip()}
            for name in METRES if METRES[0] in names else DEGREES:
                if name not in filled:
                    raise ScenarioError(f"{where}: no {name}; expected a number")
            yield _Row(where, {name: _number(name, cell, where) for name, cell in filled.items()})
    except csv.Error as error:
        raise ScenarioError(f"{path}, line {lines.line_num}: {error}; expected CSV") from None


def _number(name: str, cell: str, where: str) -> float | str:
    """The value of a cell; text stays text."""
    if name not in NUMBERS:
        return cell
    try:
        number = math.nan if "_" in cell else float(cell)  # Python's own notation
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ScenarioError(f"{where}: {name} = {cell!r}; expected a finite number, such as 12.5")
    return number


def _geojson_rows(text: str, path: Path) -> Iterator[_Row]:
    """The points of a GeoJSON feature collection (RFC 7946); their properties are the optional columns."""
    for where, raw in geojson.features(text, path, "points"):
        try:
            feature = msgspec.json.decode(raw, type=_Feature)
        except msgspec.DecodeError as error:
            raise ScenarioError(f"{where}: {error}; expected a Point with its properties") from None
        given = {key: value for key, value in (feature.properties or {}).items() if value is not None}
        _check_names([*DEGREES, *given], where, "property")
        longitude, latitude = feature.geometry.coordinates[:2]
        yield _Row(where, {"latitude": latitude, "longitude": longitude, **given})


def _check_names(names: list[str], where: str, kind: Literal["column", "property"]) -> None:
    """Raise ScenarioError for unknown, repeated or missing names."""
    known = (*METRES, *DEGREES, *_OF_USER) if kind == "column" else _OF_USER
    for i, name in enumerate(names):
        if name not in (*known, *DEGREES):
            raise ScenarioError(f"{where}: unknown {kind} {name!r}; expected {_expected(kind)}")
        if name in names[:i]:
            raise ScenarioError(f"{where}: {kind} {name!r} twice; expected it once")
    given = [[name for name in pair if name in names] for pair in (METRES, DEGREES)]
    if all(given):
        raise ScenarioError(
            f"{where}: {given[0][0]} and {given[1][0]}; expected positions in metres or in degrees, not both"
        )
    if not any(len(one) == 2 for one in given):
        missing = [name for pair in (DEGREES if given[1] else METRES,) for name in pair if name not in names]
        raise ScenarioError(f"{where}: no {kind} {missing[0]}; expected {_expected(kind)}")


def _expected(kind: str = "column") -> str:
    optional = f"{', '.join(_OF_USER[:-1])} or {_OF_USER[-1]}"
    if kind == "property":
        return optional
    return f"{' and '.join(METRES)}, or {' and '.join(DEGREES)}; optionally {optional}"


def _in_metres(rows: list[_Row], datum: Datum | None, path: Path) -> Iterator[_Row]:
    """Rows with x_m, y_m: east and north of the datum in its tangential plane, exact on WGS 84."""
    metres = geojson.to_metres(datum, path)
    for where, values in rows:
        latitude, longitude = (values.pop(name) for name in DEGREES)
        x_m, y_m = metres(latitude, longitude, where)
        yield _Row(where, {"x_m": x_m, "y_m": y_m, **values})
