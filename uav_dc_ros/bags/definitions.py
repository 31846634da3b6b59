"""ROS message types as text, for files and protocols that bring their own: no ROS installation is needed."""

from rosbags.typesys import Stores, get_typestore

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
