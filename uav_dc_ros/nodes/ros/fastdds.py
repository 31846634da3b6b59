"""Selects the transports and settings of the middleware (fastdds*.xml), unless the user has.

The nodes use UDP, also on one host. Fast DDS's shared memory does not always start on a busy machine: a
participant takes the port of another one that is created at the same time for a leftover and replaces it, and
its owner receives nothing any more. Killed processes leave their segments.

A segment is half a megabyte for each participant that uses shared memory. Its owner locks the file of the
same name plus `_el` until it ends.
"""

import contextlib
import fcntl
import math
import os
import re
import time
from pathlib import Path

# Jazzy's Fast DDS reads the first name, later ones the second.
NAMES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
RANGE, PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"
RMW, DEFAULT_RMW = "RMW_IMPLEMENTATION", "rmw_fastrtps_cpp"
SHARED_MEMORY = Path("/dev/shm")
RECOMMENDED_MB = 16  # for a dozen participants with their ports; SIGBUS ends a process once it is full
SEGMENT_LOCK = re.compile(r"(fastrtps|fastdds)_[0-9a-f]{16}_el")
YOUNG_S = 10.0  # a file is locked a moment after it is created
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


def remove_segments_of_the_dead() -> int:
    """Remove the segments whose owner has ended; returns their number.

    Ports stay: Fast DDS reuses them, and a port may outlive its owner.
    """
    removed = 0
    with contextlib.suppress(OSError):
        for lock in SHARED_MEMORY.iterdir():
            if SEGMENT_LOCK.fullmatch(lock.name):
                with contextlib.suppress(OSError):  # it is locked, or another user's
                    removed += _remove_segment(lock)
    return removed


def _remove_segment(lock: Path) -> bool:
    """Remove the segment of a lock file that is not young; raises OSError if its owner lives."""
    if time.time() - lock.stat().st_mtime < YOUNG_S:
        return False
    with lock.open("rb+") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        lock.with_name(lock.name.removesuffix("_el")).unlink(missing_ok=True)
        lock.unlink()
    return True
