"""What holds for a command's ROS and that of its nodes, unless the user's environment says otherwise."""

import contextlib
import importlib.util
import os
import re
import sys
import tempfile
from pathlib import Path

from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.ros import fastdds

LINES = "RCUTILS_CONSOLE_OUTPUT_FORMAT"
LINE_OF_NODE = "{severity}: {message}"  # whose line it is says who passes it on
LINE_OF_ONE_OF_MANY = "{severity}: {name}: {message}"
DOMAIN_MAX = 232  # the ports of higher ones do not exist
NUMBER = re.compile(r"(0[xX][0-9a-fA-F]+)|(0[0-7]*)|[1-9][0-9]*")  # as C's strtoul reads it: rcl uses that
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
RANGES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT")
LOG_FOLDERS = (("ROS_LOG_DIR", ""), ("ROS_HOME", "log"))  # of rcl, the first one that is set


def prepare(*, alone: bool) -> None:
    """Check the environment, and set what it leaves open; to be called before ROS is imported.

    Args:
        alone: is all that takes part on this host? Then no other host sees it by accident.

    Raises:
        ParameterError: an environment in which ROS cannot start.
    """
    check()
    os.environ.setdefault(RANGE, "LOCALHOST" if alone else "SUBNET")
    os.environ.setdefault(LINES, LINE_OF_NODE)


def check() -> None:
    """Check the environment, as every process that uses ROS must.

    Raises:
        ParameterError: an environment in which ROS cannot start, or its nodes cannot find each other.
    """
    check_import()
    _check_domain()
    _check_range()
    _check_log_folder()
    fastdds.use_profiles()
    fastdds.remove_leftovers()
    free_mb = fastdds.free_mb()
    if free_mb < fastdds.ENOUGH_MB and fastdds.TRANSPORTS not in os.environ:
        fastdds.use_udp_only()
        _note(
            f"{fastdds.SHARED_MEMORY} has {free_mb:.1f} MB free; expected {fastdds.ENOUGH_MB}: messages "
            "travel over UDP alone"
        )


def check_import() -> None:
    """Check what would end the process when rclpy is imported: by SIGBUS, or with status 102.

    Raises:
        ParameterError: shared memory is full, or the chosen middleware is not installed.
    """
    if fastdds.free_mb() < fastdds.LEAST_MB:
        fastdds.remove_leftovers()
        if (free_mb := fastdds.free_mb()) < fastdds.LEAST_MB:
            raise ParameterError(
                f"{fastdds.SHARED_MEMORY} is full ({free_mb:.2f} MB free), and ROS does not start; expected "
                f"{fastdds.ENOUGH_MB} MB"
            )
    name = os.environ.get("RMW_IMPLEMENTATION")
    if not name:
        return
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    packages = [Path(prefix, "share", name) for prefix in prefixes if prefix]
    is_name = name.isascii() and name.isidentifier()
    if not is_name or not (
        importlib.util.find_spec(name) is not None or any(package.is_dir() for package in packages)
    ):
        raise ParameterError(
            f"RMW_IMPLEMENTATION is {name!r}, which is not installed; expected one that is, such as "
            "rmw_fastrtps_cpp, or the variable unset"
        )


def _check_domain() -> None:
    domain = os.environ.get("ROS_DOMAIN_ID")
    if not domain:
        return  # ROS takes an empty one as unset
    found = NUMBER.fullmatch(domain)
    number = -1 if found is None else int(domain, 16 if found[1] else 8 if found[2] else 10)
    if not 0 <= number <= DOMAIN_MAX:
        raise ParameterError(f"ROS_DOMAIN_ID is {domain!r}; expected a whole number from 0 to {DOMAIN_MAX}")


def _check_range() -> None:
    value = os.environ.get(RANGE)
    if not value:
        os.environ.pop(RANGE, None)
    elif value == "OFF":
        raise ParameterError(f"{RANGE} is OFF: nodes do not find each other; expected {' or '.join(RANGES)}")
    elif value not in RANGES:
        raise ParameterError(f"{RANGE} is {value!r}; expected {' or '.join(RANGES)}")


def _check_log_folder() -> None:
    """Make the folder for ROS's log files, where rcl would look for it; without a home, somewhere else."""
    for variable, below in LOG_FOLDERS:
        if value := os.environ.get(variable):
            folder = Path(os.path.expanduser(value), below)
            if (why := _cannot_write(folder)) is not None:
                raise ParameterError(
                    f"{variable} is {value!r}: {why}; expected a folder for log files that can be made and "
                    "written"
                )
            os.environ["ROS_LOG_DIR"] = str(folder)  # rcl expands no ~ without HOME
            return
    folder = Path(os.path.expanduser("~"), ".ros", "log")
    if (why := _cannot_write(folder)) is not None:
        folder = Path(tempfile.mkdtemp(prefix="uav_dc_ros_log_"))
        _note(f"no log files in the home folder ({why}): they are in {folder}")
    elif os.environ.get("HOME"):
        return
    os.environ["ROS_LOG_DIR"] = str(folder)


def _cannot_write(folder: Path) -> str | None:
    """Why no file can be made in a folder, which is made if need be; None: it can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)


def _note(text: str) -> None:
    """Print a line for the user, if there is anything to print it on."""
    with contextlib.suppress(OSError, ValueError):
        print(f"note: {text}", file=sys.stderr)
