"""Messages written and read serialised: texts, poses, paths. Knows no ROS.

The format is CDR (OMG's XCDR1): a number stands at a multiple of its own size, counted from the first byte
after the head; a text has its length in front, and a zero at its end, which counts. We write little endian,
and read both byte orders.
"""

import math
import struct
from typing import Literal

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import MessageError

CDR_LITTLE_ENDIAN = b"\0\1\0\0"  # how a serialised message says how its numbers are laid out
CDR_BIG_ENDIAN = b"\0\0\0\0"
HEAD = len(CDR_LITTLE_ENDIAN)
FRAME = "map"  # of all positions: ENU, as everywhere in this project
# Encapsulations that are not ROS 2's, and frames that are none.
_NAMES = {
    **{bytes([0, kind]): f"parameter list (0x{kind:04x})" for kind in (2, 3)},
    **{bytes([0, kind]): f"XCDR2 (0x{kind:04x})" for kind in range(6, 12)},
    b"\x28\xb5": "a zstd frame that is damaged",
}
_FRAME_CDR = (len(FRAME) + 1).to_bytes(4, "little") + FRAME.encode() + b"\0"
# A PoseStamped in the frame `map`: stamp, frame, and position and orientation without a gap between.
_POSE = struct.Struct(f"<iI{len(_FRAME_CDR)}s7d")
_LEVEL = (0.0, 0.0, 0.0, 1.0)  # orientation x, y, z, w
_NUMBERS_AT = 8 + len(_FRAME_CDR)
assert _NUMBERS_AT % 8 == 0, "poses one after the other need no gaps then"


def of_text(text: bytes) -> bytes:
    """A std_msgs/String, serialised: its JSON goes to the middleware, and comes from it, as bytes."""
    return CDR_LITTLE_ENDIAN + (len(text) + 1).to_bytes(4, "little") + text + b"\0"


def byte_order(data: bytes) -> Literal["little", "big"]:
    """The byte order of a serialised message, by its encapsulation: plain CDR, as ROS 2 has it.

    Raises:
        MessageError: another encapsulation, or none.
    """
    kind = data[:2] if len(data) >= HEAD else b""
    if kind == CDR_LITTLE_ENDIAN[:2]:
        return "little"
    if kind == CDR_BIG_ENDIAN[:2]:
        return "big"
    if not kind:
        raise MessageError("malformed", f"{len(data)} bytes; expected a message with its encapsulation")
    raise MessageError(
        "encapsulation", f"{_NAMES.get(kind, f'0x{kind.hex()}')}; expected CDR (0x0000 or 0x0001)"
    )


def text_in(data: bytes) -> bytes:
    """The text in a serialised std_msgs/String.

    Raises:
        MessageError: it is serialised in another way, or holds less than it says.
    """
    order = byte_order(data)
    length = int.from_bytes(data[4:8], order)  # with the zero at its end
    if len(data) < 8 + length:
        raise MessageError("malformed", f"{len(data) - 8} bytes of text; expected {length}, as it says")
    return data[8 : 7 + length]


def check_position(frame: str, position_m: tuple[float, float, float]) -> None:
    """Refuse a position that is none on the grid.

    Raises:
        MessageError: another frame than `map`, or a position that is not finite.
    """
    if frame != FRAME:
        raise MessageError("frame", f"frame {frame[:64]!r}; expected {FRAME!r}")
    if not all(map(math.isfinite, position_m)):
        raise MessageError("not_finite", f"position {list(position_m)}; expected finite metres")


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
    return CDR_LITTLE_ENDIAN + _POSE.pack(sec, nanosec, _FRAME_CDR, *position_m.tolist(), *_LEVEL)


class Pose:
    """A geometry_msgs/PoseStamped in the frame `map`, read from its serialised form.

    Raises:
        MessageError: no such message, another frame, or a position that is not finite.

    Attributes:
        stamp_ns: its stamp.
        position_m: x, y, altitude, metres.
        record: it again, little endian and without head, as it stands in a sequence.
    """

    __slots__ = ("position_m", "record", "stamp_ns")

    def __init__(self, data: bytes) -> None:
        if not data.startswith(CDR_LITTLE_ENDIAN + data[HEAD : HEAD + 8] + _FRAME_CDR):
            data = _usual(data)
        if len(data) < HEAD + _POSE.size:
            raise MessageError("malformed", f"{len(data)} bytes; expected a pose of {HEAD + _POSE.size}")
        sec, nanosec, _, x_m, y_m, z_m, *_ = _POSE.unpack_from(data, HEAD)
        self.stamp_ns: int = sec * 10**9 + nanosec
        self.position_m: tuple[float, float, float] = (x_m, y_m, z_m)
        self.record = data[HEAD : HEAD + _POSE.size]
        check_position(FRAME, self.position_m)


def _usual(data: bytes) -> bytes:
    """A PoseStamped, little endian and in the frame `map`.

    Raises:
        MessageError: another encapsulation, another frame, or less than a pose.
    """
    order = "<" if byte_order(data) == "little" else ">"
    try:
        sec, nanosec, length = struct.unpack_from(f"{order}iII", data, HEAD)
        (frame,) = struct.unpack_from(f"{length}s", data, HEAD + 12)
        numbers = struct.unpack_from(f"{order}7d", data, HEAD + 12 + length + -(12 + length) % 8)
    except (struct.error, OverflowError, MemoryError) as error:
        raise MessageError("malformed", str(error)) from None
    check_position(frame.removesuffix(b"\0").decode(errors="replace"), numbers[:3])
    return CDR_LITTLE_ENDIAN + _POSE.pack(sec, nanosec, _FRAME_CDR, *numbers)


def path(poses: list[Pose]) -> bytes:
    """A nav_msgs/Path of one pose or more, with the stamp of the last, serialised."""
    stamp_and_frame = poses[-1].record[:_NUMBERS_AT]
    first, *others = (pose.record for pose in poses)
    # The count of four bytes puts the first pose's numbers off their place; from the second on all is even.
    gap = bytes(-(_NUMBERS_AT + 4 + _NUMBERS_AT) % 8)
    count = len(poses).to_bytes(4, "little")
    begin = stamp_and_frame + count + first[:_NUMBERS_AT] + gap + first[_NUMBERS_AT:]
    return CDR_LITTLE_ENDIAN + begin + b"".join(others)
