"""CDR, ROS 2's serialisation (OMG's XCDR1), of strings, poses and paths; needs no ROS.

A number is aligned to its own size, counted from the end of the encapsulation header. A string is its length
(with the terminating zero), its bytes and the zero. Messages are written little endian and read in both
byte orders.
"""

import math
import struct
from typing import Literal

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import MessageError

CDR_LITTLE_ENDIAN = b"\0\1\0\0"  # encapsulation headers
CDR_BIG_ENDIAN = b"\0\0\0\0"
HEADER_BYTES = len(CDR_LITTLE_ENDIAN)
FRAME = "map"  # of all positions: ENU
_OTHER_ENCAPSULATIONS = {
    **{bytes([0, kind]): f"parameter list (0x{kind:04x})" for kind in (2, 3)},
    **{bytes([0, kind]): f"XCDR2 (0x{kind:04x})" for kind in range(6, 12)},
    b"\x28\xb5": "a zstd frame that is damaged",
}
_FRAME_CDR = (len(FRAME) + 1).to_bytes(4, "little") + FRAME.encode() + b"\0"
# A PoseStamped in the frame `map`: stamp, frame, position and orientation; no padding.
_POSE = struct.Struct(f"<iI{len(_FRAME_CDR)}s7d")
_LEVEL = (0.0, 0.0, 0.0, 1.0)  # orientation x, y, z, w
_NUMBERS_AT = 8 + len(_FRAME_CDR)
assert _NUMBERS_AT % 8 == 0, "consecutive poses need no padding"


def encode_string(text: bytes) -> bytes:
    """A std_msgs/String of UTF-8 bytes."""
    return CDR_LITTLE_ENDIAN + (len(text) + 1).to_bytes(4, "little") + text + b"\0"


def byte_order(data: bytes) -> Literal["little", "big"]:
    """The byte order of a serialised message; raises MessageError if its encapsulation is not plain CDR."""
    kind = data[:2] if len(data) >= HEADER_BYTES else b""
    if kind == CDR_LITTLE_ENDIAN[:2]:
        return "little"
    if kind == CDR_BIG_ENDIAN[:2]:
        return "big"
    if not kind:
        raise MessageError("malformed", f"{len(data)} bytes; expected a message with its encapsulation")
    name = _OTHER_ENCAPSULATIONS.get(kind, f"0x{kind.hex()}")
    raise MessageError("encapsulation", f"{name}; expected CDR (0x0000 or 0x0001)")


def decode_string(data: bytes) -> bytes:
    """The bytes of the text in a std_msgs/String; raises MessageError if it is torn or not plain CDR."""
    length = int.from_bytes(data[4:8], byte_order(data))  # with the terminating zero
    if len(data) < 8 + length:
        raise MessageError("malformed", f"{len(data) - 8} bytes of text; expected {length}, its length field")
    return data[8 : 7 + length]


def check_position(frame: str, position_m: tuple[float, float, float]) -> None:
    """Reject a position in another frame than `map`, or one that is not finite (MessageError)."""
    if frame != FRAME:
        raise MessageError("frame", f"frame {frame[:64]!r}; expected {FRAME!r}")
    if not all(map(math.isfinite, position_m)):
        raise MessageError("not_finite", f"position {list(position_m)}; expected finite metres")


class Writer:
    """Serialises one message, field by field in the order of its definition."""

    def __init__(self) -> None:
        self._data = bytearray()

    def numbers(self, kind: str, *values: float) -> None:
        """Append numbers of one `struct` format character: `i`, `I`, `d`, `f`, `?`."""
        self._align(struct.calcsize(f"={kind}"))
        self._data += struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, text: str) -> None:
        """Append a string."""
        encoded = text.encode()
        self.numbers("I", len(encoded) + 1)
        self._data += encoded + b"\0"

    def stamp(self, time_ns: int) -> None:
        """Append a ROS time."""
        self.numbers("i", time_ns // 10**9)
        self.numbers("I", time_ns % 10**9)

    def points(self, points_m: Array) -> None:
        """Append points `[N, 3]` as a sequence of geometry_msgs/Point."""
        self.numbers("I", len(points_m))
        if len(points_m):
            self._align(8)
            self._data += points_m.astype("<f8").tobytes()

    def message(self) -> bytes:
        """The message, with its encapsulation header."""
        return CDR_LITTLE_ENDIAN + bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-len(self._data) % size)


def encode_pose(position_m: Array, time_ns: int) -> bytes:
    """A position `[3]` (x, y, altitude) as a level geometry_msgs/PoseStamped."""
    sec, nanosec = divmod(time_ns, 10**9)
    return CDR_LITTLE_ENDIAN + _POSE.pack(sec, nanosec, _FRAME_CDR, *position_m.tolist(), *_LEVEL)


class Pose:
    """A decoded geometry_msgs/PoseStamped in the frame `map`.

    Raises MessageError for no such message, another frame, or a position that is not finite.
    """

    __slots__ = ("body", "position_m", "stamp_ns")

    def __init__(self, data: bytes) -> None:
        if not data.startswith(CDR_LITTLE_ENDIAN + data[HEADER_BYTES : HEADER_BYTES + 8] + _FRAME_CDR):
            data = _reencoded(data)
        self.body = data[HEADER_BYTES : HEADER_BYTES + _POSE.size]  # little endian, without encapsulation
        if len(self.body) < _POSE.size:
            expected = HEADER_BYTES + _POSE.size
            raise MessageError("malformed", f"{len(data)} bytes; expected a pose of {expected}")
        sec, nanosec, _, x_m, y_m, z_m, *_ = _POSE.unpack(self.body)
        self.stamp_ns: int = sec * 10**9 + nanosec
        self.position_m: tuple[float, float, float] = (x_m, y_m, z_m)  # x, y, altitude
        check_position(FRAME, self.position_m)

    @property
    def orientation(self) -> tuple[float, float, float, float]:
        """Quaternion x, y, z, w; level, facing east, where the message has no rotation."""
        rotation: tuple[float, float, float, float] = _POSE.unpack(self.body)[-4:]
        return rotation if 0.9 < math.hypot(*rotation) < 1.1 else _LEVEL


def _reencoded(data: bytes) -> bytes:
    """A PoseStamped of either byte order in little endian; MessageError for any other message."""
    order = "<" if byte_order(data) == "little" else ">"
    try:
        sec, nanosec, length = struct.unpack_from(f"{order}iII", data, HEADER_BYTES)
        (frame,) = struct.unpack_from(f"{length}s", data, HEADER_BYTES + 12)
        numbers_at = HEADER_BYTES + 12 + length + -(12 + length) % 8
        numbers = struct.unpack_from(f"{order}7d", data, numbers_at)
    except (struct.error, OverflowError, MemoryError) as error:
        raise MessageError("malformed", str(error)) from None
    check_position(frame.removesuffix(b"\0").decode(errors="replace"), numbers[:3])
    return CDR_LITTLE_ENDIAN + _POSE.pack(sec, nanosec, _FRAME_CDR, *numbers)


def encode_path(poses: list[Pose]) -> bytes:
    """A nav_msgs/Path of at least one pose, with the stamp of the last."""
    first, *others = (pose.body for pose in poses)
    # The count of four bytes misaligns the numbers of the first pose; later poses need no padding.
    padding = bytes(-(_NUMBERS_AT + 4 + _NUMBERS_AT) % 8)
    header = poses[-1].body[:_NUMBERS_AT] + len(poses).to_bytes(4, "little")
    begin = header + first[:_NUMBERS_AT] + padding + first[_NUMBERS_AT:]
    return CDR_LITTLE_ENDIAN + begin + b"".join(others)
