"""What a node must know again when it is started anew after a kill: lines in a file.

The file is written for a killed process, not for a pulled plug: what was given to the operating system is
there for the next process, so nothing waits for a disk.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from uav_dc_ros import files
from uav_dc_ros.errors import NodeError


class Journal:
    """Lines of the mission that is being flown; `begin` starts a new mission's.

    Args:
        path: the file; empty: nothing is kept.
    """

    def __init__(self, path: str) -> None:
        self._path = Path(path) if path else None
        self._file = -1

    def lines(self) -> list[bytes]:
        """Whole lines, without their ends; one that was not finished is taken away.

        Raises:
            NodeError: the file cannot be read, or is none.
        """
        if self._path is None:
            return []
        if self._path.exists() and not self._path.is_file():
            raise NodeError(f"journal {self._path}: it is no file; expected one, or a new one")
        with self._told("read"):
            text = self._path.read_bytes() if self._path.exists() else b""
            whole, _, torn = text.rpartition(b"\n")
            if torn:
                os.truncate(self._path, len(text) - len(torn))
        return whole.split(b"\n") if whole else []

    def begin(self, line: bytes) -> None:
        """Forget what is there, and write a first line; at no moment is there neither.

        Raises:
            NodeError: the file cannot be written.
        """
        if self._path is None:
            return
        self.close()
        with self._told("written"), files.replacing(self._path, durable=False) as new:
            new.write_bytes(line + b"\n")

    def append(self, line: bytes) -> None:
        """Write a line.

        Raises:
            NodeError: the file cannot be written.
        """
        if self._path is None:
            return
        with self._told("written"):
            if self._file < 0:
                self._file = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
            os.write(self._file, line + b"\n")

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise NodeError(f"journal {self._path} cannot be {what}: {error.strerror}") from None

    def close(self) -> None:
        """Let go of the file."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
