"""The middleware's settings, as in fastdds.xml, unless the user has others; and its shared memory.

Fast DDS passes messages between processes of a host through files in /dev/shm: for each participant a
segment of half a megabyte, and a port for each place that it listens at. Until it ends, the owner of each
holds a lock on the file of the same name with `_el` (exclusive) or `_sl` (shared) behind it. A process that
is killed leaves its files, and nothing else removes them.
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
SHARED_MEMORY = Path("/dev/shm")
ENOUGH_MB = 16  # for a dozen participants with their ports; a full one ends a process by SIGBUS
LEAST_MB = 0.1  # LTTng's pages, which rclpy's libraries touch when they are loaded
OWNED = re.compile(r"(?P<owned>(?:fastrtps|fastdds)_(?:port\d{1,5}|[0-9a-f]{16}))(?P<lock>_el|_sl)?")
# A file is locked a moment after it is made, and to look whether it is locks it. Younger ones are let alone.
YOUNG_S = 2.0


def use_profiles() -> None:
    """Set the profiles of this process and its children; to be called before ROS is initialised."""
    if not any(name in os.environ for name in NAMES):
        os.environ.update(dict.fromkeys(NAMES, str(Path(__file__).with_name("fastdds.xml"))))


def use_udp_only() -> None:
    """Have this process and its children use no shared memory; to be called before ROS is initialised."""
    os.environ[TRANSPORTS] = "UDPv4"


def free_mb() -> float:
    """Megabytes of shared memory that are free; infinite, where there is none to be full."""
    try:
        found = os.statvfs(SHARED_MEMORY)
    except OSError:
        return math.inf
    return found.f_bavail * found.f_frsize / 1e6


def remove_leftovers() -> int:
    """Remove the shared memory of processes that have ended; returns how many segments and ports that was.

    What the living use stays. A port outlives the process that listened at it as long as others have it open
    to send: whoever listens there next is to find the same one.
    """
    try:
        names = os.listdir(SHARED_MEMORY)
    except OSError:
        return 0
    locks: dict[str, list[str]] = {}
    for name in names:
        if found := OWNED.fullmatch(name):
            locks.setdefault(found["owned"], []).extend([name] if found["lock"] else [])
    left = [owned for owned, its in locks.items() if _is_left(owned, its)]
    removed = set(left) - _in_use() if left else set()
    for owned in removed:
        for name in (owned, *locks[owned], f"sem.{owned}_mutex"):
            with contextlib.suppress(OSError):
                (SHARED_MEMORY / name).unlink()
    return len(removed)


def _is_left(owned: str, locks: list[str]) -> bool:
    """Has the owner of a segment or port ended. Files of another user cannot be opened: they stay."""
    files = [SHARED_MEMORY / name for name in locks or [owned]]
    try:
        if any(time.time() - file.stat().st_mtime < YOUNG_S for file in files):
            return False
        return not any(_is_locked(SHARED_MEMORY / name) for name in locks)
    except OSError:
        return False


def _in_use() -> set[str]:
    """Names of the shared memory that a process has mapped."""
    used = set()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is another user's, and so is its memory
            for line in (process / "maps").read_text(errors="replace").splitlines():
                used.update([Path(line).name] if f" {SHARED_MEMORY}/" in line else [])
    return used


def _is_locked(path: Path) -> bool:
    """Does a living process hold a lock on a file.

    Raises:
        OSError: the file is gone, or another user's.
    """
    with path.open("rb+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False
