"""Selects the transports and settings of the middleware (fastdds*.xml), unless the user has.

The nodes use UDP, also on one host. Fast DDS's shared memory does not always start on a busy machine: a
participant takes the port of another one that is created at the same time for a leftover and replaces it, and
its owner receives nothing any more. Killed processes leave their segments.
"""

import math
import os
from pathlib import Path

# Jazzy's Fast DDS reads the first name, later ones the second.
NAMES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
RANGE, PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"
RMW, DEFAULT_RMW = "RMW_IMPLEMENTATION", "rmw_fastrtps_cpp"
SHARED_MEMORY = Path("/dev/shm")
RECOMMENDED_MB = 16  # for a dozen participants with their ports; SIGBUS ends a process once it is full
MIN_MB = 0.1  # LTTng's pages, which rclpy's libraries touch when they are loaded


def select_transports(*, shared_memory: bool = False) -> None:
    """Select UDP for this process and its children; to be called before ROS is initialised.

    `shared_memory`: use it beside UDP, for large messages.
    """
    if any(name in os.environ for name in NAMES):
        return
    profile = "fastdds.xml"
    if not (shared_memory or TRANSPORTS in os.environ):
        is_fast_dds = (os.environ.get(RMW) or DEFAULT_RMW).startswith("rmw_fastrtps")
        if os.environ.get(RANGE) == "LOCALHOST" and is_fast_dds and not os.environ.get(PEERS):
            # With LOCALHOST rmw_fastrtps adds shared memory to all transports; the profile limits the range.
            profile, os.environ[RANGE] = "fastdds_localhost.xml", "SUBNET"
        else:
            os.environ[TRANSPORTS] = "UDPv4"
    os.environ.update(dict.fromkeys(NAMES, str(Path(__file__).with_name(profile))))


def free_mb() -> float:
    """Free shared memory, megabytes; infinite where there is none."""
    try:
        found = os.statvfs(SHARED_MEMORY)
    except OSError:
        return math.inf
    return found.f_bavail * found.f_frsize / 1e6
