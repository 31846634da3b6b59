"""Single keys from a terminal, which is always left as it was."""

import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

# What terminals send, longest first: arrows in both of their modes.
KEYS = {
    "\x1b[A": "faster",
    "\x1bOA": "faster",
    "\x1b[B": "slower",
    "\x1bOB": "slower",
    "\x1b[C": "step",
    "\x1bOC": "step",
    "+": "faster",
    "=": "faster",
    "-": "slower",
    "s": "step",
    "n": "step",
    " ": "pause",
    "q": "quit",
}
READ = 64  # bytes at once
HELP = "space: pause, s or right: step, + or up: faster, - or down: slower, q: quit"


class Keyboard:
    """Reads keys, where standard input is a terminal and the command is in its foreground.

    A context manager: inside, keys come at once and are not shown. Ctrl-C and Ctrl-Z stay what they are.

    Args:
        on_suspended: called after Ctrl-Z and `fg`, with the seconds between them.

    Attributes:
        active: are there keys to be read?
    """

    def __init__(self, on_suspended: Callable[[float], None]) -> None:
        self.active = False
        self._on_suspended = on_suspended
        self._before: list[Any] = []  # the terminal's settings
        self._fd = -1
        self._rest = ""  # of an arrow whose end has not come yet

    def __enter__(self) -> Self:
        """Take the keys."""
        try:
            self._fd = sys.stdin.fileno()
            # A command in the background that touches the terminal would be stopped.
            foreground = os.isatty(self._fd) and os.tcgetpgrp(self._fd) == os.getpgrp()
        except (OSError, ValueError, AttributeError):  # no standard input, or not a terminal of ours
            return self
        if foreground:
            self._before = termios.tcgetattr(self._fd)
            signal.signal(signal.SIGTSTP, self._suspend)
            self._take()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the terminal as it was."""
        if self._before:
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            self._give_back()

    def wait(self, seconds: float) -> list[str]:
        """Wait for keys, so long at most; what they mean, in their order."""
        if not self.active:
            if seconds > 0.0:
                time.sleep(seconds)
            return []
        if not select.select([self._fd], [], [], max(0.0, seconds))[0]:
            return []
        try:
            read = os.read(self._fd, READ).decode(errors="replace")
        except OSError:
            read = ""
        if not read:  # the terminal is gone
            self.active = False
        return self._meant(self._rest + read)

    def _meant(self, text: str) -> list[str]:
        meant = []
        self._rest = ""
        while text:
            key = next((key for key in KEYS if text.startswith(key)), None)
            if key is not None:
                meant.append(KEYS[key])
            elif any(key.startswith(text) for key in KEYS):
                self._rest = text
                break
            text = text[len(key or text[0]) :]
        return meant

    def _take(self) -> None:
        tty.setcbreak(self._fd, termios.TCSANOW)
        self.active = True

    def _give_back(self) -> None:
        self.active = False
        try:
            termios.tcsetattr(self._fd, termios.TCSANOW, self._before)
        except termios.error:
            return  # the terminal is gone

    def _suspend(self, number: int, frame: Any) -> None:
        """Ctrl-Z: stop with the terminal as it was; go on from `fg`, or without keys from `bg`."""
        began_s = time.monotonic()
        self._give_back()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        # Here it goes on.
        signal.signal(number, self._suspend)
        if os.tcgetpgrp(self._fd) == os.getpgrp():
            self._take()
        self._on_suspended(time.monotonic() - began_s)
