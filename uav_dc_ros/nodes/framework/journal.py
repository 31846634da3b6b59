"""A file of lines from which a node that was killed and restarted restores its state.

The file outlives a process, not a power failure: nothing waits for a disk.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from uav_dc_ros import files
from uav_dc_ros.errors import NodeError


class Journal:
    """Lines of the current mission; path `""`: no file. NodeError: the file cannot be read or written."""

    def __init__(self, path: str) -> None:
        self._path = Path(path) if path else None
        self._file = -1

    def lines(self) -> list[bytes]:
        """Whole lines, without their ends; an incomplete last line is removed from the file."""
        if self._path is None:
            return []
        if self._path.exists() and not self._path.is_file():
            raise NodeError(f"journal {self._path}: it is no file; expected one, or a new one")
        with self._reported("read"):
            text = self._path.read_bytes() if self._path.exists() else b""
            whole, _, incomplete = text.rpartition(b"\n")
            if incomplete:
                os.truncate(self._path, len(text) - len(incomplete))
        return whole.split(b"\n") if whole else []

    def begin(self, line: bytes) -> None:
        """Begin a mission: replace all lines by one, atomically."""
        if self._path is None:
            return
        self.close()
        with self._reported("written"), files.replacing(self._path, durable=False) as new:
            new.write_bytes(line + b"\n")

    def append(self, line: bytes) -> None:
        """Append a line."""
        if self._path is None:
            return
        with self._reported("written"):
            if self._file < 0:
                self._file = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
            os.write(self._file, line + b"\n")

    @contextmanager
    def _reported(self, action: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise NodeError(f"journal {self._path} cannot be {action}: {error.strerror}") from None

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
