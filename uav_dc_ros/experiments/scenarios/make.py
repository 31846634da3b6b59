"""The verbs `new`, `random` and `import`: files of scenarios to begin with."""

import argparse
import math
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ParameterError, ScenarioError
from uav_dc_ros.experiments.scenarios import listing
from uav_dc_ros.scenarios import geojson, user_files, zone_files
from uav_dc_ros.scenarios.generation import document, field

CLUSTERS, USERS, SIZE_M = 5, 10, (1000.0, 1000.0)  # those of the shipped field


def add_new(parser: argparse.ArgumentParser) -> None:
    """Options of `new`."""
    _add_options(parser, f"{CLUSTERS} clusters of {USERS} users in {SIZE_M[0]:g} m")
    parser.set_defaults(run=new)


def add_random(parser: argparse.ArgumentParser) -> None:
    """Options of `random`."""
    seed = "equal seeds give equal files"
    parser.add_argument("--seed", type=cli.whole_number(0), required=True, metavar="N", help=seed)
    _add_options(parser, "drawn")
    parser.set_defaults(run=random)


def add_import(parser: argparse.ArgumentParser) -> None:
    """Options of `import`."""
    users = "a CSV or GeoJSON file of users, see docs/users.md"
    parser.add_argument("users", type=Path, metavar="USERS", help=users)
    zones = "a GeoJSON file of buildings and no-fly zones, see docs/obstacles.md"
    parser.add_argument("--zones", type=Path, metavar="ZONES", help=zones)
    datum = "position of x = 0, y = 0 on WGS 84, degrees (default: the south-west corner "
    datum += "of users in degrees; users in metres need it with --zones)"
    parser.add_argument("--datum", type=_datum, metavar="LAT,LON", help=datum)
    out = "the new file, which names the other files relative to itself"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", dest="file", help=out)
    parser.set_defaults(run=import_users)


def _add_options(parser: argparse.ArgumentParser, default: str) -> None:
    add = parser.add_argument
    add("file", type=Path, nargs="?", metavar="FILE", help="the new file (default: to standard output)")
    clusters, users = f"1 to {field.CLUSTERS_MAX}", f"1 to {field.USERS_MAX}"
    number = cli.whole_number(1, field.CLUSTERS_MAX, clusters)
    add("--clusters", type=number, metavar="M", help=f"{clusters} clusters (default: {default})")
    number = cli.whole_number(1, field.USERS_MAX, users)
    add("--users", type=number, metavar="K", help=f"{users} users in each cluster (likewise)")
    sides = f"sides in metres, {field.SIDE_MIN_M:g} to {field.SIDE_MAX_M:g}, east and north (likewise)"
    add("--size", type=_size, metavar="SIDE|EASTxNORTH", help=sides)


def new(options: argparse.Namespace) -> int:
    """Write the shipped field under a new name or, with options, an even field; the exit status."""
    name = _name(options.file) or "my_field"
    if not _given(options):
        shipped = scenarios.load(field.SHIPPED)
        return _write(options, lambda: msgspec.structs.replace(shipped, name=name), "")
    numbers = options.clusters or CLUSTERS, options.users or USERS, options.size or SIZE_M
    return _write(options, lambda: field.even(name, *numbers), _given(options))


def random(options: argparse.Namespace) -> int:
    """Write the random field of a seed; the exit status."""
    sizes = {"n_clusters": options.clusters, "users_per_cluster": options.users, "size_m": options.size}
    given = f" --seed {options.seed}{_given(options)}"
    return _write(options, lambda: field.at_random(options.seed, name=_name(options.file), **sizes), given)


def import_users(options: argparse.Namespace) -> int:
    """Write a field around the users of a file; the exit status."""
    users: Path = options.users
    zones: Path | None = options.zones
    origin: geojson.Datum | None = options.datum
    at = f" --datum {origin[0]!r},{origin[1]!r}" if origin else ""
    given = f" {users}{at} --zones {zones}" if zones else f" {users}{at}"
    if not given.isprintable():  # it becomes text of the file
        raise ParameterError(f"{given.strip()!r}; expected names of printable characters")

    def make() -> Scenario:
        datum = origin or _corner(users)
        try:
            obstacles = zone_files.read(zones, datum) if zones else ()
        except geojson.NoDatumError as error:
            raise ParameterError(
                f"{error.file}: positions in degrees beside users in metres; expected --datum LAT,LON, the "
                "position of x = 0, y = 0"
            ) from None
        listed = user_files.read(users, datum)
        try:
            return field.around(_name(options.file) or "my_field", listed, datum, obstacles)
        except (ParameterError, ScenarioError) as error:
            is_zone = isinstance(error, ScenarioError) and error.path[:1] == ("obstacles",)
            file = zones if is_zone else users
            raise ParameterError(f"{file}: {error}{at and f', with the grid at{at}'}") from None

    folder = options.file.absolute().parent
    names = {
        f"{key}_file": os.path.relpath(path.absolute(), folder)
        for key, path in (("users", users), ("zones", zones))
        if path is not None
    }
    return _write(options, make, given, **names)


def _write(options: argparse.Namespace, make: Callable[[], Scenario], given: str, **names: str) -> int:
    path: Path | None = options.file
    if path is not None:
        if path.is_file() and files.is_replaced(path):
            raise ParameterError(f"{path} exists; expected a new file")
        files.check_writable(path)
    scenario = make()
    text = document.text(scenario, document.header(f"{options.verb}{given}"), **names)
    if path is None:
        sys.stdout.write(text)
    else:
        files.write(path, text.encode())
        print(f"{path}: {listing.description(scenario)}")
    return 0


def _given(options: argparse.Namespace) -> str:
    """The options of a field's size that a command line has."""
    size = options.size and "x".join(f"{side_m:g}" for side_m in options.size)
    values = {"clusters": options.clusters, "users": options.users, "size": size}
    return "".join(f" --{option} {value}" for option, value in values.items() if value)


def _corner(users: Path) -> geojson.Datum | None:
    """South-west corner of users in degrees, rounded down by a metre at most: none is west or south of it."""
    corner = user_files.corner_deg(users)
    return corner and (math.floor(corner[0] * 1e5) / 1e5, math.floor(corner[1] * 1e5) / 1e5)


def _name(path: Path | None) -> str:
    """The file's name as that of a scenario; empty where it has no letter."""
    return re.sub(r"[^a-z0-9]+", "_", path.stem.lower()).lstrip("_0123456789")[:64] if path else ""


def _datum(text: str) -> geojson.Datum:
    """The type of `--datum`: two numbers with a comma between."""
    expected = "LAT,LON: latitude from -90 to 90 and longitude from -180 to 180, degrees on WGS 84"
    latitude, _, longitude = text.partition(",")
    try:
        return cli.number(-90.0, 90.0, expected)(latitude), cli.number(-180.0, 180.0, expected)(longitude)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r}; expected {expected}") from None


def _size(text: str) -> tuple[float, float]:
    """The type of `--size`: one number, or two with an x between."""
    expected = f"metres from {field.SIDE_MIN_M:g} to {field.SIDE_MAX_M:g}, such as 800 or 1500x800"
    side = cli.number(field.SIDE_MIN_M, field.SIDE_MAX_M, expected)
    try:
        east_m, *north_m = map(side, text.split("x", 1))
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r}; expected {expected}") from None
    return east_m, north_m[0] if north_m else east_m
