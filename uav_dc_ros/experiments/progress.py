"""The live display of a training: bars on a terminal, plain lines in a file."""

import time
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from uav_dc_ros.experiments.train import Report


class Display:
    """Shows reports as they come; a context manager."""

    def __init__(self, n_episodes: int, line_every: int) -> None:
        """For `n_episodes`; away from a terminal, one line every `line_every` of them."""
        self._console = Console(stderr=True)
        self._line_every = line_every
        self._started = time.monotonic()
        self._bars = Progress(
            # Together they fit into 80 columns.
            MofNCompleteColumn(),
            BarColumn(bar_width=8),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[text]}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bars.add_task("", total=n_episodes, text="")

    def __enter__(self) -> "Display":
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def show(self, report: "Report") -> None:
        """Shows one report."""
        rate = report.episode / (time.monotonic() - self._started)
        text = (
            f"{rate:.1f}/s return {report.mean_return:.1f} collected {report.users_collected:.1f} "
            f"landed {report.landing_rate:.0%} best {report.score:.1f}"
        )
        self._bars.update(self._task, completed=report.episode, text=text)
        if not self._console.is_terminal and report.episode % self._line_every == 0:
            self._console.print(f"episode {report.episode} {text}", soft_wrap=True)
