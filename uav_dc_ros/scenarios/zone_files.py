"""Files of obstacles: GeoJSON polygons on WGS 84. docs/obstacles.md describes them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from uav_dc_ros.core.obstacles import Obstacle
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.scenarios import geojson
from uav_dc_ros.scenarios.geojson import Coordinates, Datum

PROPERTIES = tuple(name for name in Obstacle.__struct_fields__ if name != "polygon_m")

_Rings: TypeAlias = list[list[Coordinates]]  # of a polygon: its outline, then its holes


class _Polygon(msgspec.Struct, tag="Polygon"):
    coordinates: _Rings


class _MultiPolygon(msgspec.Struct, tag="MultiPolygon"):
    coordinates: list[_Rings]


class _ZoneFeature(msgspec.Struct, tag="Feature"):
    geometry: _Polygon | _MultiPolygon
    properties: dict[str, Any] | None = None


def with_zones(values: dict[str, Any], folder: Path, source: str) -> dict[str, Any]:
    """Plain values of a scenario with the obstacles of the file `zones`, a name relative to `folder`.

    They follow those of the scenario itself. Raises ScenarioError as `read` does.
    """
    if "zones" not in values:
        return values
    others = {key: value for key, value in values.items() if key != "zones"}
    file, own, datum = values["zones"], values.get("obstacles", []), values.get("datum_deg")
    if not isinstance(file, str):
        raise ScenarioError(f"{source}: zones = {file!r}; expected the name of a GeoJSON file")
    try:
        datum = None if datum is None else msgspec.convert(datum, Datum)
    except msgspec.ValidationError:
        return others  # from_values() names the error
    return others | {"obstacles": [*(own if isinstance(own, list) else ()), *read(folder / file, datum)]}


def read(path: Path, datum: Datum | None) -> list[dict[str, Any]]:
    """The obstacles of a file as plain values of `Obstacle`, with corners in metres.

    `datum` is the position of the grid's origin on WGS 84. A polygon without `kind` is a no-fly zone.

    Raises:
        ScenarioError: a file that cannot be read or has no polygons; a feature that is no polygon, has a hole
            or an unknown property; a coordinate that is not on WGS 84.
    """
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from None
    found = [one for where, raw in geojson.features(text, path, "polygons") for one in _obstacles(raw, where)]
    if not found:
        raise ScenarioError(f"{path}: no polygons; expected at least one")
    metres = geojson.to_metres(datum, path)
    obstacles = []
    for where, outline, properties in found:
        corners_m = [metres(latitude, longitude, where) for longitude, latitude, *_ in outline]
        obstacles.append({**properties, "polygon_m": corners_m})
        try:
            msgspec.convert(obstacles[-1], Obstacle)
        except msgspec.ValidationError as error:
            expected, _, key = str(error).replace("`", "").partition(" - at $.")
            expected = expected.removeprefix("Expected ").replace(" | null", "")
            raise ScenarioError(f"{where}: {key} = {properties.get(key)!r}; expected {expected}") from None
    return obstacles


def _obstacles(raw: msgspec.Raw, where: str) -> Iterator[tuple[str, list[Coordinates], dict[str, Any]]]:
    """Place, outline without its repeated first corner, and properties of each polygon of a feature."""
    try:
        feature = msgspec.json.decode(raw, type=_ZoneFeature)
    except msgspec.DecodeError as error:
        raise ScenarioError(f"{where}: {error}; expected a Polygon with its properties") from None
    given = {key: value for key, value in (feature.properties or {}).items() if value is not None}
    if unknown := [key for key in given if key not in PROPERTIES]:
        raise ScenarioError(f"{where}: unknown property {unknown[0]!r}; expected {', '.join(PROPERTIES)}")
    geometry = feature.geometry
    for rings in [geometry.coordinates] if isinstance(geometry, _Polygon) else geometry.coordinates:
        if len(rings) != 1:
            raise ScenarioError(f"{where}: a polygon of {len(rings)} rings; expected one: no holes")
        outline = rings[0]
        if len(outline) < 4 or outline[0] != outline[-1]:
            raise ScenarioError(
                f"{where}: an outline of {len(outline)} positions; expected 4 or more, the last one equal "
                "to the first"
            )
        yield where, outline[:-1], {"kind": "no_fly", **given}
