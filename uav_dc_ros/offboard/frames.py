"""Coordinate frames: ENU (ROS, REP 103) and NED (autopilots).

The origin of the grid's ENU frame is its *datum*: the grid's corner on the ground, a point on the Earth.
The origin of the autopilot's local NED frame is mostly the place where it was switched on.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.offboard.extras import load

MAX_ALTITUDE_M = 10_000.0
EQUATOR_M, SQUARED_ECCENTRICITY = 6_378_137.0, 6.694379990141e-3  # of WGS84


class Enu(NamedTuple):
    """East, north, up, metres."""

    east_m: float
    north_m: float
    up_m: float

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse `EAST,NORTH,UP`, metres; raises VehicleError if the text is not three finite numbers."""
        try:
            position = cls(*map(float, text.split(",")))
        except (TypeError, ValueError):
            position = cls(math.nan, math.nan, math.nan)
        if not position.is_finite:
            raise VehicleError(f"grid origin: {text!r}; expected EAST,NORTH,UP in metres")
        return position

    @property
    def is_finite(self) -> bool:
        """Whether all coordinates are finite numbers."""
        return all(map(math.isfinite, self))

    def to_text(self) -> str:
        """All digits, as `parse` reads them."""
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


def tilt_rad(w: float, x: float, y: float, z: float) -> float | None:
    """Angle between body z axis and vertical, 0 to pi, of a quaternion (ENU or NED); None: not a unit one."""
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.9 < length < 1.1:
        return None
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y) / (length * length))))


class Geodetic(NamedTuple):
    """A point on WGS84, north and east positive. The reference of its altitude is the same in one flight."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse `LATITUDE,LONGITUDE,ALTITUDE`, degrees and metres; raises VehicleError if it is not that."""
        try:
            point = cls(*map(float, text.split(",")))
        except (TypeError, ValueError):
            point = cls(math.nan, math.nan, math.nan)
        limits = (90, 180, MAX_ALTITUDE_M)
        if not all(abs(value) <= limit for value, limit in zip(point, limits, strict=True)):
            raise VehicleError(
                f"datum: {text!r}; expected LATITUDE,LONGITUDE,ALTITUDE in degrees and metres, such as "
                "47.397742,8.545594,488.0"
            )
        return point

    def __str__(self) -> str:
        """All digits, as `parse` reads them."""
        return ",".join(map(repr, self))

    def enu_from(self, datum: Self) -> Enu:
        """Position of this point in the ENU frame of a datum, exact on WGS84."""
        return Enu(*map(float, load("pymap3d", "a datum needs pymap3d").geodetic2enu(*self, *datum)))

    def at(self, offset: Enu) -> Self:
        """Point at an offset in this point's ENU frame."""
        return type(self)(*map(float, load("pymap3d", "a datum needs pymap3d").enu2geodetic(*offset, *self)))


NO_SCALE = Enu(1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class LocalFrame:
    """Transform between the grid's ENU frame and an autopilot's local NED frame, metres.

    The axes are taken as parallel: within two kilometres the error is less than 0.3 m.
    """

    origin: Enu  # origin of the autopilot's frame, in the grid's ENU frame
    scale: Enu = NO_SCALE  # the autopilot's metres in one metre, see `sphere_scale`

    def to_autopilot(self, position: Enu) -> Ned:
        """Position in the autopilot's local NED frame."""
        return to_ned(Enu(*((p - o) * s for p, o, s in zip(position, self.origin, self.scale, strict=True))))

    def from_autopilot(self, position: Ned) -> Enu:
        """Position in the grid's ENU frame."""
        return Enu(*(p / s + o for p, o, s in zip(to_enu(position), self.origin, self.scale, strict=True)))


def sphere_scale(origin: Geodetic, radius_m: float) -> Enu:
    """Metres of an autopilot that uses a spherical Earth, in one metre of WGS84: east, north and up.

    The autopilot converts degrees to metres by one radius, `radius_m`. The radii of curvature of WGS84 at
    `origin` differ from it by up to 0.5 %: metres per kilometre.
    """
    denominator = 1 - SQUARED_ECCENTRICITY * math.sin(math.radians(origin.latitude_deg)) ** 2
    across_m = EQUATOR_M / math.sqrt(denominator) + origin.altitude_m
    along_m = EQUATOR_M * (1 - SQUARED_ECCENTRICITY) / denominator**1.5 + origin.altitude_m
    return Enu(radius_m / across_m, radius_m / along_m, 1.0)
