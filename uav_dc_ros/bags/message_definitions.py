"""Definitions of ROS message types as text, for files and protocols that contain them; needs no ROS."""

from functools import cache
from typing import TYPE_CHECKING, Any

from uav_dc_ros.errors import BagError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

ENCODING = "ros2msg"  # of the text, in MCAP and Foxglove
_TEXTS = (ENCODING, "ros2idl")  # encodings of definitions that can be compared


@cache
def typestore() -> "Typestore":
    """The types of ROS 2 Jazzy; the first call takes a fifth of a second."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def definition(type: str) -> bytes:
    """A message type with all types inside it, as `ros2msg`; BagError if ROS 2 Jazzy does not have it."""
    if type not in typestore().fielddefs:
        raise BagError(f"{type!r}; expected a type of ROS 2 Jazzy")
    text, _ = typestore().generate_msgdef(type, ros_version=2)
    return text.encode()


def matches_jazzy(type: str, encoding: str, definition: bytes) -> bool:
    """Whether a recorded definition has the fields of ROS 2 Jazzy's.

    True without a definition, and in another encoding than `ros2msg` and `ros2idl`.
    """
    if not definition or encoding not in _TEXTS:
        return True
    recorded = _fields(type, encoding, definition)
    jazzy = typestore().fielddefs
    return recorded is not None and all(
        name in jazzy and jazzy[name][1] == fields for name, fields in recorded.items()
    )


def have_same_fields(type: str, one: tuple[str, bytes], other: tuple[str, bytes]) -> bool:
    """Whether two definitions of a type, each with its encoding, have the same fields, as far as is known."""
    if one == other or not (one[1] and other[1]):
        return True
    if one[0] not in _TEXTS or other[0] not in _TEXTS:
        return False
    fields = _fields(type, *one)
    return fields is not None and fields == _fields(type, *other)


def _fields(type: str, encoding: str, definition: bytes) -> dict[str, Any] | None:
    """Fields by type of a definition in one of `_TEXTS`; None if it is none.

    Constants are left out: messages do not contain them.
    """
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    try:
        text = definition.decode().replace("\r\n", "\n")  # of a checkout on Windows
        found = get_types_from_msg(text, type) if encoding == ENCODING else get_types_from_idl(text)
    except Exception:  # of UTF-8, rosbags: no definition
        return None
    return {name: fields for name, (_, fields) in found.items()}
