"""Checks the environment of ROS, for a command and its nodes, and sets what the user left open."""

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
LINE_OF_NODE = "{severity}: {message}"  # run_all adds the node's name
LINE_OF_ONE_OF_MANY = "{severity}: {name}: {message}"
DOMAIN_MAX = 232  # the ports of higher ones do not exist
NUMBER = re.compile(r"(0[xX][0-9a-fA-F]+)|(0[0-7]*)|[1-9][0-9]*")  # as C's strtoul reads it, and so rcl
RANGES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT")
LOG_FOLDERS = (("ROS_LOG_DIR", ""), ("ROS_HOME", "log"))  # rcl uses the first one that is set


def prepare(*, local_only: bool) -> None:
    """`check` the environment and set what it leaves open; to be called before ROS is imported.

    `local_only`: all participants run on this host, so discovery is limited to it.
    """
    check()
    os.environ.setdefault(fastdds.RANGE, "LOCALHOST" if local_only else "SUBNET")
    os.environ.setdefault(LINES, LINE_OF_NODE)


def select_shared_memory() -> None:
    """Use shared memory for large messages, unless little of it is free; first remove what the dead left."""
    fastdds.remove_segments_of_the_dead()
    if is_small := (free_mb := fastdds.free_mb()) < fastdds.RECOMMENDED_MB:
        _note(
            f"{fastdds.SHARED_MEMORY} has {free_mb:.1f} MB free; expected {fastdds.RECOMMENDED_MB}: messages "
            "travel over UDP alone"
        )
    fastdds.select_transports(shared_memory=not is_small)


def check() -> None:
    """Raise ParameterError if ROS cannot start in this environment, or nodes cannot find each other."""
    check_import()
    _check_domain()
    _check_range()
    _check_log_folder()


def check_import() -> None:
    """Raise ParameterError if shared memory is full, or the chosen middleware is not installed.

    The import of rclpy would end the process, by SIGBUS or with status 102.
    """
    if (free_mb := fastdds.free_mb()) < fastdds.MIN_MB:
        raise ParameterError(
            f"{fastdds.SHARED_MEMORY} is full ({free_mb:.2f} MB free), and ROS does not start; expected "
            f"{fastdds.MIN_MB} MB"
        )
    name = os.environ.get(fastdds.RMW)
    if not name:
        return
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    is_package = any(Path(prefix, "share", name).is_dir() for prefix in prefixes if prefix)
    if not (name.isascii() and name.isidentifier() and (importlib.util.find_spec(name) or is_package)):
        raise ParameterError(
            f"{fastdds.RMW} is {name!r}, which is not installed; expected one that is, such as "
            "rmw_fastrtps_cpp, or the variable unset"
        )


def _check_domain() -> None:
    domain = os.environ.get("ROS_DOMAIN_ID")
    if not domain:
        return  # ROS treats an empty one as unset
    found = NUMBER.fullmatch(domain)
    number = -1 if found is None else int(domain, 16 if found[1] else 8 if found[2] else 10)
    if not 0 <= number <= DOMAIN_MAX:
        raise ParameterError(f"ROS_DOMAIN_ID is {domain!r}; expected a whole number from 0 to {DOMAIN_MAX}")


def _check_range() -> None:
    value = os.environ.get(fastdds.RANGE)
    if not value:
        os.environ.pop(fastdds.RANGE, None)
    elif value not in RANGES:
        off = ": nodes do not find each other" if value == "OFF" else ""
        raise ParameterError(f"{fastdds.RANGE} is {value!r}{off}; expected {' or '.join(RANGES)}")


def _check_log_folder() -> None:
    """Create the folder for ROS's log files where rcl expects it; if the home has none, a temporary one."""
    for variable, below in LOG_FOLDERS:
        if value := os.environ.get(variable):
            folder = Path(os.path.expanduser(value), below)
            if (why := _write_error(folder)) is not None:
                raise ParameterError(
                    f"{variable} is {value!r}: {why}; expected a folder for log files that can be made and "
                    "written"
                )
            os.environ["ROS_LOG_DIR"] = str(folder)  # rcl expands no ~ without HOME
            return
    folder = Path(os.path.expanduser("~"), ".ros", "log")
    if (why := _write_error(folder)) is not None:
        folder = Path(tempfile.mkdtemp(prefix="uav_dc_ros_log_"))
        _note(f"no log files in the home folder ({why}): they are in {folder}")
    elif os.environ.get("HOME"):
        return
    os.environ["ROS_LOG_DIR"] = str(folder)


def _write_error(folder: Path) -> str | None:
    """Create a folder and a file in it: the error, or None."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)


def _note(text: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # standard error may be closed, or None
        print(f"note: {text}", file=sys.stderr)
