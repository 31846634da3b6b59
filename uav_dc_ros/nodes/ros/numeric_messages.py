"""Standard messages of numbers, serialised: what any plotting tool reads. Lengths are metres."""

import math
import struct

from uav_dc_ros.cdr import FRAME, HEADER_BYTES, Pose, Writer, byte_order
from uav_dc_ros.errors import MessageError

BODY_FRAME = "base_link"
UNKNOWN = math.nan
_COVARIANCE = (0.0,) * 36  # not known
STATUS_FIX, SERVICE_GPS = 0, 1  # of sensor_msgs/NavSatStatus

Vector = tuple[float, float, float]


def float64(value: float) -> bytes:
    """A std_msgs/Float64."""
    writer = Writer()
    writer.numbers("d", value)
    return writer.message()


def int32(value: int) -> bytes:
    """A std_msgs/Int32."""
    writer = Writer()
    writer.numbers("i", value)
    return writer.message()


def odometry(pose: Pose, before: Pose | None) -> bytes:
    """A nav_msgs/Odometry: the pose, and the mean velocity since the pose before it, in the body's frame."""
    writer = Writer()
    _header(writer, pose.stamp_ns, FRAME)
    writer.text(BODY_FRAME)
    writer.numbers("d", *pose.position_m, *pose.orientation, *_COVARIANCE)
    velocity_mps = (0.0, 0.0, 0.0) if before is None else _velocity_mps(pose, before)
    writer.numbers("d", *_in_body(velocity_mps, pose), 0.0, 0.0, 0.0, *_COVARIANCE)
    return writer.message()


def transform(pose: Pose) -> bytes:
    """A tf2_msgs/TFMessage from `map` to `base_link`."""
    writer = Writer()
    writer.numbers("I", 1)
    _header(writer, pose.stamp_ns, FRAME)
    writer.text(BODY_FRAME)
    writer.numbers("d", *pose.position_m, *pose.orientation)
    return writer.message()


def fix(latitude_deg: float, longitude_deg: float, time_ns: int) -> bytes:
    """A sensor_msgs/NavSatFix on WGS84, without altitude: that above the ellipsoid is not known."""
    writer = Writer()
    _header(writer, time_ns, BODY_FRAME)
    writer.numbers("b", STATUS_FIX)
    writer.numbers("H", SERVICE_GPS)
    writer.numbers("d", latitude_deg, longitude_deg, UNKNOWN, *_COVARIANCE[:9])
    writer.numbers("B", 0)  # the covariance is not known
    return writer.message()


def battery(charge: float, time_ns: int, voltage_v: float | None = None) -> bytes:
    """A sensor_msgs/BatteryState of a charge from 0 to 1; what is not known is NaN, as the message has it."""
    writer = Writer()
    _header(writer, time_ns, BODY_FRAME)
    writer.numbers("f", UNKNOWN if voltage_v is None else voltage_v, *(UNKNOWN,) * 5, charge)
    writer.numbers("B", 0, 0, 0)  # status, health, technology: unknown
    writer.numbers("?", True)  # present
    writer.numbers("I", 0)  # cell_voltage
    writer.numbers("I", 0)  # cell_temperature
    writer.text("")  # location
    writer.text("")  # serial_number
    return writer.message()


def read_charge(data: bytes) -> float:
    """The charge in a sensor_msgs/BatteryState, 0 to 1; raises MessageError if it has none."""
    order = "<" if byte_order(data) == "little" else ">"
    try:
        (length,) = struct.unpack_from(f"{order}I", data, HEADER_BYTES + 8)
        at = 12 + length  # after the header; aligned to four bytes
        *_, charge = struct.unpack_from(f"{order}7f", data, HEADER_BYTES + at + -at % 4)
    except struct.error as error:
        raise MessageError("malformed", str(error)) from None
    if not 0.0 <= charge <= 1.0:
        raise MessageError("invalid", f"percentage {charge}; expected a number from 0 to 1")
    return float(charge)


def _header(writer: Writer, time_ns: int, frame: str) -> None:
    writer.stamp(time_ns)
    writer.text(frame)


def _velocity_mps(pose: Pose, before: Pose) -> Vector:
    seconds = (pose.stamp_ns - before.stamp_ns) * 1e-9
    if seconds <= 0:
        return 0.0, 0.0, 0.0
    east, north, up = (b - a for a, b in zip(before.position_m, pose.position_m, strict=True))
    return east / seconds, north / seconds, up / seconds


def _in_body(vector: Vector, pose: Pose) -> Vector:
    """A vector of the frame `map` in the frame of the body: rotated by the inverse of its orientation."""
    x, y, z, w = pose.orientation
    u, v = (-x, -y, -z), vector
    t = tuple(2.0 * one for one in _cross(u, v))
    rotated = (a + w * b + c for a, b, c in zip(v, t, _cross(u, (t[0], t[1], t[2])), strict=True))
    east, north, up = rotated
    return east, north, up


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
