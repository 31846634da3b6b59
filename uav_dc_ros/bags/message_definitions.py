"""Definitions of ROS message types as text, for files and protocols that contain them; needs no ROS."""

from functools import cache
from typing import TYPE_CHECKING

from uav_dc_ros.errors import BagError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

ENCODING = "ros2msg"  # of the text, in MCAP and Foxglove


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
    if not definition or encoding not in ("ros2msg", "ros2idl"):
        return True
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    try:
        text = definition.decode().replace("\r\n", "\n")  # of a checkout on Windows
        recorded = get_types_from_msg(text, type) if encoding == "ros2msg" else get_types_from_idl(text)
    except Exception:  # of UTF-8, rosbags: no definition
        return False
    jazzy = typestore().fielddefs  # constants are not compared: messages do not contain them
    return all(name in jazzy and jazzy[name][1] == fields for name, (_, fields) in recorded.items())
