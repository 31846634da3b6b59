"""What play shows: a bar on a terminal, plain lines elsewhere."""

import math
import sys
import time
from types import TracebackType
from typing import Self

from rich.progress import BarColumn, Progress, TextColumn

from uav_dc_ros.cli import Output

REFRESH_S = 0.1
PLAIN_LINES = 6  # of progress in a pass through the bag, where there is no terminal
# A picture takes a few milliseconds: it is drawn while no message is due, or, if one always is, now and then.
DRAWING_S = 0.01
OVERDUE_S = 1.0


class PlaybackDisplay:
    """Shows how far a bag has been played; a context manager. It draws only when it is asked to.

    Args:
        begin_s, end_s: what is played, seconds from the bag's beginning.
    """

    def __init__(self, begin_s: float, end_s: float) -> None:
        self._output = Output()
        self.console = self._output.console(sys.stdout)
        self._errors = self._output.console(sys.stderr)
        self._begin_s, self._end_s = begin_s, end_s
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[told]}"),
            console=self.console,
            auto_refresh=False,  # a thread that draws would delay messages
            disable=not self.console.is_terminal,
        )
        self._task = self._bar.add_task("waiting", total=max(1e-9, end_s - begin_s), told="")
        self._drawn_s = 0.0
        self._lines = 0

    def tell(self, text: str) -> None:
        """Tell what happens."""
        self._bar.console.print(text, markup=False)

    def note(self, text: str) -> None:
        """Tell what the user should know."""
        self._errors.print(f"note: {text}", markup=False)

    def begin(self) -> None:
        """Another pass begins."""
        self._lines = 0

    def progress(self, state: str, at_s: float, rate: float, messages: int, idle_s: float) -> None:
        """Show how far it is.

        Args:
            state: what it does.
            at_s: seconds from the bag's beginning.
            rate: seconds of the bag in a second.
            messages: published so far.
            idle_s: how long there is nothing else to do.
        """
        told = f"{at_s:.1f}/{self._end_s:.1f} s, rate {text_of(rate)}, {messages} messages"
        if self._bar.disable:
            share = (at_s - self._begin_s) / max(1e-9, self._end_s - self._begin_s)
            if share * PLAIN_LINES >= self._lines + 1:
                self._lines = int(share * PLAIN_LINES)
                self.tell(told)
            return
        since_s = time.monotonic() - self._drawn_s
        if since_s < REFRESH_S or (idle_s < DRAWING_S and since_s < OVERDUE_S):
            return
        self._bar.update(self._task, description=state, completed=at_s - self._begin_s, told=told)
        self._bar.refresh()
        self._drawn_s = time.monotonic()

    def __enter__(self) -> Self:
        """Start the bar."""
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the terminal as it was."""
        self._bar.stop()
        self._output.drain()


def text_of(rate: float) -> str:
    """A rate in words."""
    return "max" if math.isinf(rate) else f"{rate:g}"
