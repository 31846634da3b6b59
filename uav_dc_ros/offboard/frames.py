"""Frames: ENU with yaw from the east (ROS, REP 103), NED with heading from the north (autopilots).

Local ENU metres are counted from a *datum*, a point on the Earth: the corner of the grid, on the ground.
An autopilot counts its local NED metres from an *origin* of its own, mostly where it was switched on.
"""

import importlib
import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

from uav_dc_ros.errors import VehicleError

HIGHEST_M = 10_000.0
EQUATOR_M, SQUARED_ECCENTRICITY = 6_378_137.0, 6.694379990141e-3  # of WGS84


class Enu(NamedTuple):
    """East, north, up, metres."""

    east_m: float
    north_m: float
    up_m: float

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `EAST,NORTH,UP`, metres.

        Raises:
            VehicleError: the text is not three finite numbers.
        """
        try:
            position = cls(*map(float, text.split(",")))
        except (TypeError, ValueError):
            position = cls(math.nan, math.nan, math.nan)
        if not all(map(math.isfinite, position)):
            raise VehicleError(f"grid origin: {text!r}; expected EAST,NORTH,UP in metres")
        return position

    def to_text(self) -> str:
        """As `parse` reads it, with all digits."""
        return ",".join(map(repr, self))

    def plus(self, other: Self) -> Self:
        """Sum of two vectors."""
        return type(self)(*(a + b for a, b in zip(self, other, strict=True)))

    def minus(self, other: Self) -> Self:
        """Difference of two vectors."""
        return type(self)(*(a - b for a, b in zip(self, other, strict=True)))


class Ned(NamedTuple):
    """North, east, down, metres."""

    north_m: float
    east_m: float
    down_m: float


def to_ned(position: Enu) -> Ned:
    """The same point or vector, as NED."""
    return Ned(position.north_m, position.east_m, -position.up_m)


def to_enu(position: Ned) -> Enu:
    """The same point or vector, as ENU."""
    return Enu(position.east_m, position.north_m, -position.down_m)


def heading_of_yaw(yaw_rad: float) -> float:
    """Heading, clockwise from the north, of a yaw, counter-clockwise from the east; in (-pi, pi]."""
    return wrapped(math.pi / 2 - yaw_rad)


def yaw_of_heading(heading_rad: float) -> float:
    """Yaw, counter-clockwise from the east, of a heading, clockwise from the north; in (-pi, pi]."""
    return wrapped(math.pi / 2 - heading_rad)


def wrapped(angle_rad: float) -> float:
    """The same angle in (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2 * math.pi)


def tilt_rad(w: float, x: float, y: float, z: float) -> float | None:
    """Angle between a body's vertical axis and the vertical, 0 to pi, of a unit quaternion; None: it is none.

    The same in ENU (with the body's axes forward, left, up) and in NED (forward, right, down).
    """
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.9 < length < 1.1:
        return None
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y) / (length * length))))


@dataclass(frozen=True, kw_only=True)
class Geodetic:
    """A point on WGS84.

    Attributes:
        latitude_deg, longitude_deg: degrees, north and east positive.
        altitude_m: metres; above what, is the same for all points of one flight.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `LATITUDE,LONGITUDE,ALTITUDE`, degrees and metres.

        Raises:
            VehicleError: it is none.
        """
        try:
            latitude_deg, longitude_deg, altitude_m = (float(part) for part in text.split(","))
        except ValueError:
            latitude_deg = math.nan
        right = abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180 and abs(altitude_m) <= HIGHEST_M
        if not right:
            raise VehicleError(
                f"datum: {text!r}; expected LATITUDE,LONGITUDE,ALTITUDE in degrees and metres, such as "
                "47.397742,8.545594,488.0"
            )
        return cls(latitude_deg=latitude_deg, longitude_deg=longitude_deg, altitude_m=altitude_m)

    def __str__(self) -> str:
        """As `parse` reads it, with all digits."""
        return f"{self.latitude_deg!r},{self.longitude_deg!r},{self.altitude_m!r}"

    def seen_from(self, datum: Self) -> Enu:
        """Position of this point in the ENU frame of a datum (exact on WGS84, not the flat Earth's)."""
        here = (self.latitude_deg, self.longitude_deg, self.altitude_m)
        there = (datum.latitude_deg, datum.longitude_deg, datum.altitude_m)
        return Enu(*(float(value) for value in _pymap3d().geodetic2enu(*here, *there)))

    def at(self, offset: Enu) -> Self:
        """The point at an offset in this point's ENU frame."""
        latitude_deg, longitude_deg, altitude_m = _pymap3d().enu2geodetic(
            *offset, self.latitude_deg, self.longitude_deg, self.altitude_m
        )
        return type(self)(
            latitude_deg=float(latitude_deg), longitude_deg=float(longitude_deg), altitude_m=float(altitude_m)
        )


NO_SCALE = Enu(1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class LocalFrame:
    """Between the grid's ENU metres and an autopilot's local NED metres.

    Their axes are taken as parallel: within a kilometre or two they differ by less than a third of a metre.

    Attributes:
        origin: where the autopilot counts from, in the grid's ENU frame.
        scale: its metres in one metre, east, north and up; see `sphere_scale`.
    """

    origin: Enu
    scale: Enu = NO_SCALE

    def to_autopilot(self, position: Enu) -> Ned:
        """A position of the grid, as the autopilot's local NED."""
        return to_ned(Enu(*((p - o) * s for p, o, s in zip(position, self.origin, self.scale, strict=True))))

    def from_autopilot(self, position: Ned) -> Enu:
        """A position of the autopilot's, in the grid's ENU frame."""
        return Enu(*(p / s + o for p, o, s in zip(to_enu(position), self.origin, self.scale, strict=True)))


def sphere_scale(origin: Geodetic, radius_m: float) -> Enu:
    """Metres of an autopilot that takes the Earth for a sphere, in one metre of WGS84: east, north and up.

    It turns degrees into metres by one radius; an ellipsoid has two at each latitude, and they differ from
    that by up to 0.5 %, which is metres at the end of a kilometre.

    Args:
        origin: where it counts from.
        radius_m: of its sphere.
    """
    flat = 1 - SQUARED_ECCENTRICITY * math.sin(math.radians(origin.latitude_deg)) ** 2
    across_m = EQUATOR_M / math.sqrt(flat) + origin.altitude_m
    along_m = EQUATOR_M * (1 - SQUARED_ECCENTRICITY) / flat**1.5 + origin.altitude_m
    return Enu(radius_m / across_m, radius_m / along_m, 1.0)


def _pymap3d() -> Any:
    """The Earth's ellipsoid; only who has a datum needs it.

    Raises:
        VehicleError: it is not installed.
    """
    try:
        return importlib.import_module("pymap3d")
    except ImportError:
        raise VehicleError(
            "a datum needs pymap3d; expected it installed: pip install 'uav_dc_ros[mavlink]'"
        ) from None
