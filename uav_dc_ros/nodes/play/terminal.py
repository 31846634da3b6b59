"""The terminal of a playback: a progress bar (elsewhere plain lines), and keys. Its settings are restored."""

import math
import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable
from typing import Any, Self

from rich.progress import TextColumn

from uav_dc_ros.cli import LiveDisplay

REFRESH_S = 0.1
PLAIN_LINES = 6  # per pass through the bag, without a terminal
# Drawing takes milliseconds: it happens while no message is due, or when the last picture is overdue.
DRAWING_S = 0.01
OVERDUE_S = 1.0
KEYS = {  # terminals send arrows in one of two modes
    **dict.fromkeys(("\x1b[A", "\x1bOA", "+", "="), "faster"),
    **dict.fromkeys(("\x1b[B", "\x1bOB", "-"), "slower"),
    **dict.fromkeys(("\x1b[C", "\x1bOC", "s", "n"), "step"),
    " ": "pause",
    "q": "quit",
}
READ_BYTES = 64
HELP = "space: pause, s or right: step, + or up: faster, - or down: slower, q: quit"


class PlaybackDisplay(LiveDisplay):
    """Shows the position in the played range, seconds of the bag; draws only when `progress` is called."""

    def __init__(self, begin_s: float, end_s: float) -> None:
        # A drawing thread would delay messages.
        super().__init__(TextColumn("{task.fields[text]}"), auto_refresh=False)
        self._begin_s, self._end_s = begin_s, end_s
        self._length_s = max(1e-9, end_s - begin_s)
        self._task = self._bar.add_task("waiting", total=self._length_s, text="")
        self._drawn_s = 0.0
        self._lines = 0

    def info(self, text: str) -> None:
        """Print a line."""
        self.console.print(text, markup=False)

    def note(self, text: str) -> None:
        """Print a note to standard error."""
        self.errors.print(f"note: {text}", markup=False)

    def restart(self) -> None:
        """Start another pass."""
        self._lines = 0

    def progress(self, state: str, position_s: float, rate: float, messages: int, idle_s: float) -> None:
        """Show the position, seconds from the bag's beginning; `idle_s`: time until the next message."""
        text = f"{position_s:.1f}/{self._end_s:.1f} s, rate {rate_text(rate)}, {messages} messages"
        done_s = position_s - self._begin_s
        if self._bar.disable:
            lines = int(done_s / self._length_s * PLAIN_LINES)
            if lines > self._lines:
                self._lines = lines
                self.info(text)
            return
        since_s = time.monotonic() - self._drawn_s
        if since_s < REFRESH_S or (idle_s < DRAWING_S and since_s < OVERDUE_S):
            return
        self._bar.update(self._task, description=state, completed=done_s, text=text)
        self._bar.refresh()
        self._drawn_s = time.monotonic()


def rate_text(rate: float) -> str:
    """A rate as `--rate` accepts it."""
    return "max" if math.isinf(rate) else f"{rate:g}"


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
