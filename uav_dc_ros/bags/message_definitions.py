"""ROS message types as text, for files and protocols that bring their own: no ROS installation is needed."""

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from uav_dc_ros.errors import BagError

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
ENCODING = "ros2msg"  # of the text, as MCAP and Foxglove call it


def definition(type: str) -> bytes:
    """A message type with all types inside it, in the encoding `ros2msg`.

    Args:
        type: such as `std_msgs/msg/String`.

    Raises:
        BagError: ROS 2 has no such type.
    """
    if type not in TYPESTORE.fielddefs:
        raise BagError(f"{type!r}; expected a type of ROS 2 Jazzy")
    text, _ = TYPESTORE.generate_msgdef(type, ros_version=2)
    return text.encode()


def is_defined_so(type: str, encoding: str, definition: bytes) -> bool:
    """Whether a definition, as a bag brings it, is that of ROS 2 Jazzy, field by field.

    Args:
        type: such as `std_msgs/msg/String`.
        encoding: `ros2msg` or `ros2idl`; a definition in another one, or none at all, is not judged.
        definition: the text, with all types inside it.
    """
    if not definition or encoding not in ("ros2msg", "ros2idl"):
        return True
    try:
        text = definition.decode().replace("\r\n", "\n")  # as of a checkout on Windows
        told = get_types_from_msg(text, type) if encoding == "ros2msg" else get_types_from_idl(text)
    except Exception:  # of UTF-8, rosbags: no definition
        return False
    # Constants are not in the messages.
    return all(
        name in TYPESTORE.fielddefs and TYPESTORE.fielddefs[name][1] == fields
        for name, (_, fields) in told.items()
    )
