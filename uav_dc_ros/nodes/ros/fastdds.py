"""The middleware's settings (fastdds.xml, unless the user has others), and its shared memory.

Fast DDS passes messages between processes of a host through files in /dev/shm: a segment of half a megabyte
for each participant, and a port for each endpoint at which it receives. Their owner locks the file of the
same name plus `_el` (exclusive) or `_sl` (shared) until it ends. A process that is killed leaves its files.
"""

import contextlib
import fcntl
import math
import os
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path

# Jazzy's Fast DDS reads the first name, later ones the second.
NAMES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
SHARED_MEMORY = Path("/dev/shm")
RECOMMENDED_MB = 16  # for a dozen participants with their ports; SIGBUS ends a process once it is full
MIN_MB = 0.1  # LTTng's pages, which rclpy's libraries touch when they are loaded
OWNED = re.compile(r"(?P<owned>(?:fastrtps|fastdds)_(?:port\d{1,5}|[0-9a-f]{16}))(?P<lock>_el|_sl)?")
# A file is locked a moment after it is created, and a test of the lock locks it. Younger ones are skipped.
YOUNG_S = 2.0
CREATION_LOCK = (
    "\0uav_dc_ros/participant"  # an abstract Unix socket: the kernel frees it when its process ends
)
CREATION_MAX_S = 5.0  # longest wait for the lock: a process that hangs while it holds it stops no other


@contextlib.contextmanager
def one_participant_at_a_time() -> Iterator[None]:
    """Hold a lock of this host while a node creates its participant.

    Fast DDS locks a port a moment after it creates it. A participant that is created in this moment takes the
    port for a leftover and replaces it, and the owner of the first one receives nothing any more: on a busy
    machine, nodes that start together were seen to wait for each other forever.
    """
    deadline_s = time.monotonic() + CREATION_MAX_S
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as lock:
        while time.monotonic() < deadline_s:
            try:
                lock.bind(CREATION_LOCK)
                break
            except OSError:
                time.sleep(0.002)
        yield


def use_profiles() -> None:
    """Set the profiles of this process and its children; to be called before ROS is initialised."""
    if not any(name in os.environ for name in NAMES):
        os.environ.update(dict.fromkeys(NAMES, str(Path(__file__).with_name("fastdds.xml"))))


def free_mb() -> float:
    """Free shared memory, megabytes; infinite where there is none."""
    try:
        found = os.statvfs(SHARED_MEMORY)
    except OSError:
        return math.inf
    return found.f_bavail * found.f_frsize / 1e6


def remove_leftovers() -> int:
    """Remove segments and ports of processes that have ended; returns their number.

    Those in use stay. A port outlives its owner while others have it open to send: its next owner uses it.
    """
    try:
        names = os.listdir(SHARED_MEMORY)
    except OSError:
        return 0
    locks: dict[str, list[str]] = {}
    for name in names:
        if found := OWNED.fullmatch(name):
            locks.setdefault(found["owned"], []).extend([name] if found["lock"] else [])
    left = {owned for owned, its in locks.items() if _is_left(owned, its)}
    removed = left - _mapped() if left else left
    for owned in removed:
        for name in (owned, *locks[owned], f"sem.{owned}_mutex"):
            with contextlib.suppress(OSError):
                (SHARED_MEMORY / name).unlink()
    return len(removed)


def _is_left(owned: str, locks: list[str]) -> bool:
    """Whether the owner has ended. Files of another user cannot be opened: they stay."""
    files = [SHARED_MEMORY / name for name in locks or [owned]]
    try:
        if any(time.time() - file.stat().st_mtime < YOUNG_S for file in files):
            return False
        return not any(_is_locked(SHARED_MEMORY / name) for name in locks)
    except OSError:
        return False


def _mapped() -> set[str]:
    """Names of the shared memory that processes have mapped."""
    mapped = set()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is another user's, and so is its memory
            for line in (process / "maps").read_text(errors="replace").splitlines():
                mapped.update([Path(line).name] if f" {SHARED_MEMORY}/" in line else [])
    return mapped


def _is_locked(path: Path) -> bool:
    with path.open("rb+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False
