"""The folder of a run, in memory, where no write waits for a busy disk: journals and parameters of its nodes.

A run_all that was killed leaves its folder. The next one removes it: a lock, which ends with its process,
shows whether a folder is in use.
"""

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

PREFIX = "uav_dc_ros_"
LOCKED = "locked"  # an empty file in a folder that its process has locked


def memory() -> Path | None:
    """A folder in memory that this user can write to; None: there is none."""
    folders = (os.environ.get("XDG_RUNTIME_DIR", ""), "/dev/shm")
    found = next((folder for folder in folders if os.access(folder, os.W_OK | os.X_OK)), None)
    return Path(found) if found else None


@contextlib.contextmanager
def working_folder() -> Iterator[Path]:
    """An empty folder for the time of a block; folders of runs that were killed are removed."""
    parent = memory() or Path(tempfile.gettempdir())
    _remove_leftovers(parent)
    with tempfile.TemporaryDirectory("", PREFIX, parent) as name, _opened(name) as folder:
        fcntl.flock(folder, fcntl.LOCK_EX)
        Path(name, LOCKED).touch()  # from now on a folder without a lock is a leftover
        yield Path(name)


def _remove_leftovers(parent: Path) -> None:
    for mark in parent.glob(f"{PREFIX}*/{LOCKED}"):
        # OSError: the folder is in use, belongs to another user, or was just removed.
        with contextlib.suppress(OSError), _opened(mark.parent) as folder:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(mark.parent, ignore_errors=True)


@contextlib.contextmanager
def _opened(folder: str | Path) -> Iterator[int]:
    """The descriptor of a folder for the time of a block."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
