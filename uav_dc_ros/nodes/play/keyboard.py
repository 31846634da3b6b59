"""Single keys from a terminal, whose settings are always restored."""

import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable
from typing import Any, Self

KEYS = {  # terminals send arrows in one of two modes
    **dict.fromkeys(("\x1b[A", "\x1bOA", "+", "="), "faster"),
    **dict.fromkeys(("\x1b[B", "\x1bOB", "-"), "slower"),
    **dict.fromkeys(("\x1b[C", "\x1bOC", "s", "n"), "step"),
    " ": "pause",
    "q": "quit",
}
READ_BYTES = 64
HELP = "space: pause, s or right: step, + or up: faster, - or down: slower, q: quit"


class Keyboard:
    """Reads keys if standard input is a terminal and the command is in its foreground.

    A context manager: inside, the terminal delivers keys at once and does not echo them. Ctrl-C and Ctrl-Z
    keep their meaning. After Ctrl-Z and `fg`, `on_resumed` is called with the seconds between them.
    """

    def __init__(self, on_resumed: Callable[[float], None]) -> None:
        self.active = False  # whether keys can be read
        self._on_resumed = on_resumed
        self._settings: list[Any] = []  # of the terminal, before
        self._fd = -1
        self._partial = ""  # start of an escape sequence

    def __enter__(self) -> Self:
        try:
            self._fd = sys.stdin.fileno()
            # The terminal stops background processes that change its settings.
            foreground = os.isatty(self._fd) and os.tcgetpgrp(self._fd) == os.getpgrp()
        except (OSError, ValueError, AttributeError):  # no standard input, or another session's terminal
            return self
        if foreground:
            self._settings = termios.tcgetattr(self._fd)
            signal.signal(signal.SIGTSTP, self._suspend)
            self._activate()
        return self

    def __exit__(self, *_: object) -> None:
        if self._settings:
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            self._restore()

    def wait(self, timeout_s: float) -> list[str]:
        """Wait for keys; returns their meanings, in order."""
        if not self.active:
            if timeout_s > 0.0:
                time.sleep(timeout_s)
            return []
        if not select.select([self._fd], [], [], max(0.0, timeout_s))[0]:
            return []
        try:
            read = os.read(self._fd, READ_BYTES).decode(errors="replace")
        except OSError:
            read = ""
        if not read:  # the terminal was closed
            self.active = False
        return self._parse(self._partial + read)

    def _parse(self, text: str) -> list[str]:
        meanings = []
        self._partial = ""
        while text:
            key = next((key for key in KEYS if text.startswith(key)), None)
            if key is not None:
                meanings.append(KEYS[key])
            elif any(key.startswith(text) for key in KEYS):
                self._partial = text
                break
            text = text[len(key or text[0]) :]
        return meanings

    def _activate(self) -> None:
        tty.setcbreak(self._fd, termios.TCSANOW)
        self.active = True

    def _restore(self) -> None:
        self.active = False
        try:
            termios.tcsetattr(self._fd, termios.TCSANOW, self._settings)
        except termios.error:
            return  # the terminal was closed

    def _suspend(self, number: int, frame: Any) -> None:
        """Handle Ctrl-Z: suspend with the terminal restored; read keys again after `fg`, but not `bg`."""
        began_s = time.monotonic()
        self._restore()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)  # returns after SIGCONT
        signal.signal(number, self._suspend)
        if os.tcgetpgrp(self._fd) == os.getpgrp():
            self._activate()
        self._on_resumed(time.monotonic() - began_s)
