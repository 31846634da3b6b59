"""Standard output and error, written by a thread: what a mission prints can neither delay it nor end it.

A full disk, a closed pipe, a terminal that is gone or takes no more (Ctrl-S, a stalled ssh) costs the text
that it does not take, and nothing else.
"""

import atexit
import contextlib
import io
import os
import queue
import threading
from typing import IO, TextIO, cast

from rich.console import Console

WAITING_MAX = 10_000  # pieces of text; what comes when so many wait is lost
DRAIN_S = 2.0


class Output:
    """Writes what consoles print, in the order in which they print it."""

    def __init__(self) -> None:
        self._waiting: queue.Queue[tuple[int, bytes] | threading.Event] = queue.Queue(WAITING_MAX)
        threading.Thread(target=self._write, name="output", daemon=True).start()
        atexit.register(self.drain)

    def console(self, stream: TextIO) -> Console:
        """A console that prints to `stream`, which is sys.stdout or sys.stderr."""
        file = cast(IO[str], OutputStream(self, stream))  # it is one, as far as a console needs it
        return Console(file=file, highlight=False, soft_wrap=True)

    def put(self, descriptor: int, data: bytes) -> None:
        """Have data written; returns at once."""
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait((descriptor, data))

    def drain(self) -> None:
        """Wait until everything is written, `DRAIN_S` at most."""
        written = threading.Event()
        with contextlib.suppress(queue.Full):
            self._waiting.put(written, timeout=DRAIN_S)
            written.wait(DRAIN_S)

    def _write(self) -> None:
        while True:
            piece = self._waiting.get()
            if isinstance(piece, threading.Event):
                piece.set()
                continue
            descriptor, data = piece
            with contextlib.suppress(OSError):
                while data:
                    data = data[os.write(descriptor, data) :]


class OutputStream(io.TextIOBase):
    """A text stream like `of`, such as sys.stdout, that is written by an `Output`."""

    def __init__(self, output: Output, of: TextIO) -> None:
        self._output, self._of = output, of

    @property
    def encoding(self) -> str:  # type: ignore[override]  # io's own is an attribute
        """Of the other stream."""
        return self._of.encoding

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return self._of.isatty()

    def fileno(self) -> int:
        """Descriptor of the other stream."""
        return self._of.fileno()

    def writable(self) -> bool:
        """Always."""
        return True

    def write(self, text: str) -> int:
        """Have text written; never fails, never waits."""
        self._output.put(self.fileno(), text.encode(self.encoding, "backslashreplace"))
        return len(text)
