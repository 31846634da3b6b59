"""Messages written and read serialised, where an object for each point or pose would cost too much.

The format is CDR (OMG's XCDR1, little endian): a number stands at a multiple of its own size, counted from
the first byte after the head; a text has its length in front, and a zero at its end, which counts.
"""

import math
import struct
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.serialization import deserialize_message, serialize_message

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import MessageError
from uav_dc_ros.nodes.convert import FRAME, position_m
from uav_dc_ros.payloads import CDR_LITTLE_ENDIAN

HEAD = len(CDR_LITTLE_ENDIAN)
FRAME_CDR = (len(FRAME) + 1).to_bytes(4, "little") + FRAME.encode() + b"\0"
# A PoseStamped in the frame `map`: stamp, frame, and position and orientation without a gap between.
_POSE = struct.Struct(f"<iI{len(FRAME_CDR)}s7d")
_LEVEL = (0.0, 0.0, 0.0, 1.0)  # orientation x, y, z, w
_NUMBERS_AT = 8 + len(FRAME_CDR)
assert _NUMBERS_AT % 8 == 0, "poses one after the other need no gaps then"


class Writer:
    """Writes one message from its first field to its last."""

    def __init__(self) -> None:
        self._data = bytearray()

    def numbers(self, kind: str, *values: float) -> None:
        """Write numbers of one kind, as `struct` calls it: `i`, `I`, `d`, `f`, `?`."""
        self._align(struct.calcsize(f"={kind}"))
        self._data += struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, text: str) -> None:
        """Write a text."""
        encoded = text.encode()
        self.numbers("I", len(encoded) + 1)
        self._data += encoded + b"\0"

    def stamp(self, time_ns: int) -> None:
        """Write a time, nanoseconds, as a ROS time."""
        self.numbers("i", time_ns // 10**9)
        self.numbers("I", time_ns % 10**9)

    def points(self, points_m: Array) -> None:
        """Write points `[N, 3]`, metres, as a sequence of geometry_msgs/Point."""
        self.numbers("I", len(points_m))
        if len(points_m):
            self._align(8)
            self._data += points_m.astype("<f8").tobytes()

    def message(self) -> bytes:
        """The message, with its head."""
        return CDR_LITTLE_ENDIAN + bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-len(self._data) % size)


def pose(position_m: Array, time_ns: int) -> bytes:
    """A position `[3]` (x, y, altitude, metres) as a level geometry_msgs/PoseStamped, serialised."""
    sec, nanosec = divmod(time_ns, 10**9)
    return CDR_LITTLE_ENDIAN + _POSE.pack(sec, nanosec, FRAME_CDR, *position_m.tolist(), *_LEVEL)


class Pose:
    """A geometry_msgs/PoseStamped in the frame `map`, read from its serialised form.

    Raises:
        MessageError: no such message, another frame, or a position that is not finite.

    Attributes:
        stamp_ns: its stamp.
        position_m: x, y, altitude, metres.
        record: it again, without head, as it stands in a sequence.
    """

    __slots__ = ("position_m", "record", "stamp_ns")

    def __init__(self, data: bytes) -> None:
        if not _is_usual(data):
            try:
                message: Any = deserialize_message(data, PoseStamped)
            except _rclpy.RMWError as error:
                raise MessageError("malformed", str(error)) from None
            position_m(message)  # says what is wrong with it
            data = serialize_message(message)
        sec, nanosec, _, x_m, y_m, z_m, *_ = _POSE.unpack_from(data, HEAD)
        self.stamp_ns: int = sec * 10**9 + nanosec
        self.position_m: tuple[float, float, float] = (x_m, y_m, z_m)
        self.record = data[HEAD : HEAD + _POSE.size]


def _is_usual(data: bytes) -> bool:
    """Little endian, in the frame `map`, finite: as almost all poses are."""
    if not data.startswith(CDR_LITTLE_ENDIAN) or len(data) < HEAD + _POSE.size:
        return False
    _, _, frame, *numbers = _POSE.unpack_from(data, HEAD)
    return frame == FRAME_CDR and math.isfinite(sum(numbers))


def path(poses: list[Pose]) -> bytes:
    """A nav_msgs/Path of one pose or more, with the stamp of the last, serialised."""
    stamp_and_frame = poses[-1].record[:_NUMBERS_AT]
    first, *others = (pose.record for pose in poses)
    # The count of four bytes puts the first pose's numbers off their place; from the second on all is even.
    gap = bytes(-(_NUMBERS_AT + 4 + _NUMBERS_AT) % 8)
    count = len(poses).to_bytes(4, "little")
    begin = stamp_and_frame + count + first[:_NUMBERS_AT] + gap + first[_NUMBERS_AT:]
    return CDR_LITTLE_ENDIAN + begin + b"".join(others)
