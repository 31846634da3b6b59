"""The progress display of playback: a bar on a terminal, plain lines elsewhere."""

import math
import time

from rich.progress import TextColumn

from uav_dc_ros.cli import LiveDisplay

REFRESH_S = 0.1
PLAIN_LINES = 6  # per pass through the bag, without a terminal
# Drawing takes milliseconds: it happens while no message is due, or when the last picture is overdue.
DRAWING_S = 0.01
OVERDUE_S = 1.0


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
