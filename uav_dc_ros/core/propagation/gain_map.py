"""The channel `gain_map`: path gains from a table, of a ray tracer or of measurements.

The table is a NumPy file (`.npz`) with the path gain from the centre of every cell of the grid to every point
of a regular grid on the ground. docs/channels.md describes the file.
"""

import hashlib
import io
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from uav_dc_ros import files
from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.grid import Grid
from uav_dc_ros.errors import ScenarioError

AXES = ("uav_x_m", "uav_y_m", "uav_z_m", "ground_x_m", "ground_y_m")  # of `gain_db`, in this order
TOLERANCE_M = 1e-3  # of coordinates, metres


@dataclass(frozen=True, eq=False)
class GainTable:
    """A gain map in memory."""

    gain_db: Array  # path gain, dB, float64 `[X, Y, Z, I, J]`: cells east, north, up; points east, north
    origin_m: tuple[float, ...]  # first coordinate of each axis, see `AXES`
    spacing_m: tuple[float, ...]  # of each axis; 1 where there is a single cell

    def last_m(self, axis: int) -> float:
        """Last coordinate of an axis, metres."""
        return self.origin_m[axis] + (self.gain_db.shape[axis] - 1) * self.spacing_m[axis]


def save(path: Path, grid: Grid, ground_x_m: Array, ground_y_m: Array, gain_db: Array) -> None:
    """Write a gain map.

    Args:
        path: of the file, `.npz`.
        grid: the cells of the UAV.
        ground_x_m: metres east of the points on the ground, `[I]`, ascending, in equal steps.
        ground_y_m: metres north, `[J]`, likewise.
        gain_db: path gain, dB, `[n_x, n_y, n_z, I, J]`; kept as float32.

    Raises:
        ScenarioError: wrong shapes, numbers that are not finite, unequal steps.
        UavDcError: the file cannot be written.
    """
    arrays = dict(zip(AXES, (*_centres_m(grid), np.asarray(ground_x_m), np.asarray(ground_y_m)), strict=True))
    arrays["gain_db"] = np.asarray(gain_db, np.float32)
    if arrays["gain_db"].shape[:3] != grid.shape:
        raise ScenarioError(
            f"{path}: gain_db is {arrays['gain_db'].shape}; expected {grid.shape} cells first"
        )
    table(arrays, str(path))
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    files.write(path, content.getvalue())


def digest(path: Path) -> str:
    """SHA-256 of a file's content, hexadecimal; raises ScenarioError for one that cannot be read."""
    try:
        return _digest(path, path.stat().st_mtime_ns)
    except OSError as error:
        raise ScenarioError(f"gain map {path}: cannot be read: {error.strerror}") from None


@lru_cache(maxsize=8)
def _digest(path: Path, changed_ns: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@lru_cache(maxsize=4)
def load(file: str, sha256: str) -> GainTable:
    """The gain map in a file whose content has this SHA-256; raises ScenarioError for any other."""
    path = Path(file)
    if (found := digest(path)) != sha256:
        raise ScenarioError(
            f"gain map {path}: its SHA-256 is {found[:12]}...; expected {sha256[:12]}..., with which the "
            "scenario was made"
        )
    try:
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files if name in (*AXES, "gain_db")}
    except (
        OSError,
        ValueError,
        TypeError,
        AttributeError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        reason = str(error).partition("\n")[0]
        raise ScenarioError(f"gain map {path}: not a NumPy file (.npz): {reason}") from None
    return table(arrays, f"gain map {path}")


def table(arrays: dict[str, Array], source: str) -> GainTable:
    """The table of the arrays of a file; raises ScenarioError for missing or unsuitable ones."""
    if missing := [name for name in (*AXES, "gain_db") if name not in arrays]:
        raise ScenarioError(f"{source}: lacks {', '.join(missing)}; expected {', '.join(AXES)} and gain_db")
    for name, values in arrays.items():
        if values.dtype.kind not in "fiu":
            raise ScenarioError(f"{source}: {name} is of type {values.dtype}; expected numbers")
        if not np.isfinite(values).all():
            i = tuple(map(int, np.argwhere(~np.isfinite(values))[0]))
            raise ScenarioError(f"{source}: {name}{list(i)} = {values[i]}; expected finite numbers")
    axes = [np.asarray(arrays[name], np.float64) for name in AXES]
    for name, axis in zip(AXES, axes, strict=True):
        fewest = 2 if name.startswith("ground") else 1
        steps = np.diff(np.atleast_1d(axis))
        unequal_m = abs(steps - steps[..., :1]).max(initial=0.0)
        if axis.ndim != 1 or axis.size < fewest or (steps <= 0.0).any() or unequal_m > TOLERANCE_M:
            raise ScenarioError(
                f"{source}: {name} is {axis.shape}, {_ends(axis)}; expected at least {fewest} coordinates of "
                "one axis, ascending in equal steps"
            )
    gain_db, shape = arrays["gain_db"], tuple(axis.size for axis in axes)
    if gain_db.shape != shape:
        raise ScenarioError(
            f"{source}: gain_db is {gain_db.shape}; expected {shape}, the sizes of {', '.join(AXES)}"
        )
    spacing_m = [(axis[-1] - axis[0]) / (axis.size - 1) if axis.size > 1 else 1.0 for axis in axes]
    return GainTable(
        gain_db=np.ascontiguousarray(gain_db, np.float64),
        origin_m=tuple(float(axis[0]) for axis in axes),
        spacing_m=tuple(float(one) for one in spacing_m),
    )


def with_absolute_path(values: dict[str, Any], folder: Path, source: str) -> dict[str, Any]:
    """Plain values of a scenario with the absolute path of its gain map, and the SHA-256 of its content.

    Values with both, as policies and bags hold them, are not changed: the file may be elsewhere. A file that
    cannot be read has no SHA-256, which `inconsistencies` reports.

    Raises:
        ScenarioError: the file has another content than the `sha256` that is given.
    """
    radio = values.get("radio")
    if not isinstance(radio, dict) or radio.get("model") != "gain_map":
        return values
    if not isinstance(file := radio.get("file"), str) or (Path(file).is_absolute() and "sha256" in radio):
        return values
    path = Path(folder, file).absolute()
    found = digest(path) if path.is_file() else None
    sha256 = radio.get("sha256", found)
    if found is not None and sha256 != found:
        raise ScenarioError(f"{source}: radio.sha256 = {sha256!r}; expected {found!r}, that of {file}")
    return values | {"radio": {**radio, "file": str(path)} | ({} if found is None else {"sha256": found})}


def inconsistencies(
    file: str, sha256: str, grid: Grid, area_m: tuple[float, float, float, float]
) -> Iterator[str]:
    """What is wrong with a map for a grid, and for users within limits west, south, east and north.

    Nothing for a file that is no longer there: `load` fails when its gains are needed.
    """
    path, where = Path(file), f"radio.file = {file!r}"
    try:
        if not sha256:
            yield f"missing key radio.sha256; expected {digest(path)!r}, that of {file}"
        if not sha256 or not path.is_file() or digest(path) != sha256:
            return
        map_ = load(file, sha256)
    except ScenarioError as error:
        yield f"{where}: {error}"
        return
    for axis, (name, centres_m) in enumerate(zip(AXES[:3], _centres_m(grid), strict=True)):
        found_m = map_.origin_m[axis] + np.arange(map_.gain_db.shape[axis]) * map_.spacing_m[axis]
        if found_m.shape != centres_m.shape or abs(found_m - centres_m).max() > TOLERANCE_M:
            yield (
                f"{where}: its {name} are {found_m.size}, {_ends(found_m)}; expected the centres of the "
                f"grid's cells, {centres_m.size}, {_ends(centres_m)}"
            )
    west_m, south_m, east_m, north_m = area_m
    for axis, low_m, high_m in ((3, west_m, east_m), (4, south_m, north_m)):
        if low_m < map_.origin_m[axis] - TOLERANCE_M or high_m > map_.last_m(axis) + TOLERANCE_M:
            yield (
                f"{where}: its {AXES[axis]} are {map_.origin_m[axis]:g} to {map_.last_m(axis):g} m; expected "
                f"at least {low_m:.1f} to {high_m:.1f} m, where users may get to"
            )


def gain_db(file: str, sha256: str, uav_m: Array, users_m: Array) -> Array:
    """Path gain, dB, `[..., U]`, between the UAV at `uav_m` `[..., 3]` and users at `users_m` `[..., U, 2]`.

    The table of the nearest cell, bilinear between the four nearest points on the ground. A real vehicle is
    some metres off the centre of its cell. A position outside the table counts as its nearest one.
    """
    map_, xp = load(file, sha256), array_namespace(users_m)
    values = _values(file, sha256, xp, getattr(users_m, "device", None), users_m.dtype)
    n_i, n_j = map_.gain_db.shape[3:]
    index = None
    for axis in range(3):
        at = xp.round((uav_m[..., axis : axis + 1] - map_.origin_m[axis]) / map_.spacing_m[axis])
        at = xp.astype(xp.clip(at, 0, map_.gain_db.shape[axis] - 1), xp.int64)
        index = at if index is None else index * map_.gain_db.shape[axis] + at
    east, at_east = _between(users_m[..., 0], map_, 3)
    north, at_north = _between(users_m[..., 1], map_, 4)
    corner = (index * n_i + east) * n_j + north

    def take(offset: int) -> Array:
        return xp.take(values, (corner + offset).reshape((-1,)), axis=0).reshape(corner.shape)

    west_db = take(0) * (1.0 - at_north) + take(1) * at_north
    east_db = take(n_j) * (1.0 - at_north) + take(n_j + 1) * at_north
    return west_db * (1.0 - at_east) + east_db * at_east


def _between(at_m: Array, map_: GainTable, axis: int) -> tuple[Array, Array]:
    """Index of the point before each coordinate, integers, and the way to the next one in [0, 1]."""
    xp, n = array_namespace(at_m), map_.gain_db.shape[axis]
    steps = xp.clip((at_m - map_.origin_m[axis]) / map_.spacing_m[axis], 0.0, float(n - 1))
    before = xp.clip(xp.floor(steps), 0.0, float(n - 2))
    return xp.astype(before, xp.int64), steps - before


@lru_cache(maxsize=4)
def _values(file: str, sha256: str, xp: Any, device: Any, dtype: Any) -> Array:
    """The gains of a map, flat, on a device."""
    return xp.asarray(load(file, sha256).gain_db.reshape(-1), dtype=dtype, device=device)


def _centres_m(grid: Grid) -> tuple[Array, Array, Array]:
    """Coordinates of the cells' centres along each axis, metres."""
    x_m, y_m, z_m = (
        grid.centre_m(np.arange(n)[:, None] * np.eye(3, dtype=int)[axis], like=np.zeros(0))[:, axis]
        for axis, n in enumerate(grid.shape)
    )
    return x_m, y_m, z_m


def _ends(axis_m: Array) -> str:
    return f"{axis_m.flat[0]:g} to {axis_m.flat[-1]:g} m" if axis_m.size else "empty"
