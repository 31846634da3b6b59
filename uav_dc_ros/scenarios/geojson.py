"""GeoJSON (RFC 7946): the features of a collection, and positions in metres of the grid."""

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import msgspec
from msgspec import Meta

from uav_dc_ros.errors import ScenarioError

# The one name of a coordinate reference system that older programs write for the coordinates of RFC 7946.
WGS_84 = "urn:ogc:def:crs:OGC:1.3:CRS84"

Datum: TypeAlias = tuple[float, float]  # latitude, longitude, degrees, of the grid's x = 0, y = 0
# Longitude, latitude, and an altitude, which is not used
Coordinates: TypeAlias = Annotated[tuple[float, ...], Meta(min_length=2, max_length=3)]
# Metres east and north of a position: latitude and longitude, degrees, and its place in the file, for errors.
ToMetres: TypeAlias = Callable[[float, float, str], tuple[float, float]]


class _Collection(msgspec.Struct, tag="FeatureCollection"):
    features: list[msgspec.Raw]
    crs: dict[str, Any] | None = None


class NoDatumError(ScenarioError):
    """A file (`file`) with positions in degrees, and no datum."""

    def __init__(self, path: Path) -> None:
        super().__init__(
            f"{path}: positions in degrees; expected datum_deg in the scenario, latitude and longitude of "
            "x = 0, y = 0"
        )
        self.file = path


def features(text: str, path: Path, what: str) -> Iterator[tuple[str, msgspec.Raw]]:
    """The features of a collection, each with its place in the file.

    Raises:
        ScenarioError: no FeatureCollection (of `what`, such as points), or not on WGS 84.
    """
    try:
        found = msgspec.json.decode(text.encode(), type=_Collection)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ScenarioError(f"{path}: {error}; expected a GeoJSON FeatureCollection of {what}") from None
    name = found.crs and (found.crs.get("properties") or {}).get("name")
    if found.crs is not None and name != WGS_84:
        raise ScenarioError(
            f"{path}: crs = {name or found.crs!r}; expected longitude and latitude on WGS 84 (RFC 7946), "
            f"without a crs or with {WGS_84!r}"
        )
    return ((f"{path}, feature {i}", raw) for i, raw in enumerate(found.features))


def to_metres(datum: Datum | None, path: Path) -> ToMetres:
    """Conversion to metres east and north of a datum in its tangential plane, exact on WGS 84.

    Raises:
        ScenarioError: no datum, no pymap3d, or (when converting) degrees out of range.
    """
    if datum is None:
        raise NoDatumError(path)
    try:
        pymap3d = importlib.import_module("pymap3d")
    except ImportError:
        raise ScenarioError(
            f"{path}: positions in degrees need pymap3d; expected it installed: "
            "pip install 'uav_dc_ros[mavlink]'"
        ) from None

    def convert(latitude: float, longitude: float, where: str) -> tuple[float, float]:
        for name, value, limit in (("latitude", latitude, 90.0), ("longitude", longitude, 180.0)):
            if not abs(value) <= limit:
                raise ScenarioError(
                    f"{where}: {name} = {value:g}; expected degrees on WGS 84, from {-limit:g} to {limit:g}"
                )
        x_m, y_m, _ = map(float, pymap3d.geodetic2enu(latitude, longitude, 0.0, *datum, 0.0))
        return x_m, y_m

    return convert
