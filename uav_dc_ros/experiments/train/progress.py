"""Live progress: bars on a terminal, plain lines in a file."""

import time
from typing import TYPE_CHECKING, Self

import numpy as np
from rich import progress as bars
from rich.console import Console

if TYPE_CHECKING:
    from uav_dc_ros.experiments.train.training import Training

_LATEST = 20  # episodes of each run


class ProgressBar:
    """A bar with a text on a terminal, lines elsewhere; a context manager."""

    def __init__(self, *columns: bars.ProgressColumn, total: int, completed: int = 0) -> None:
        self._console = Console(stderr=True)
        self._bar = bars.Progress(*columns, console=self._console, disable=not self._console.is_terminal)
        self._task = self._bar.add_task("", total=total, completed=completed, text="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, completed: int, text: str, line: str | None) -> None:
        """Shows `text` in the bar, or prints a line, if any, without a terminal."""
        self._bar.update(self._task, completed=completed, text=text)
        if line and not self._console.is_terminal:
            self._console.print(line, soft_wrap=True)


class TrainingProgress(ProgressBar):
    """The progress of a new or resumed training; without a terminal, one line every `line_every` episodes."""

    def __init__(self, training: "Training", line_every: int) -> None:
        self._training, self._line_every = training, line_every
        self._started, self._first = time.monotonic(), training.n_flown
        super().__init__(
            # Together they fit into 80 columns.
            bars.MofNCompleteColumn(),
            bars.BarColumn(bar_width=8),
            bars.TimeRemainingColumn(compact=True),
            bars.TextColumn("{task.fields[text]}"),
            total=training.population.n_episodes,
            completed=self._first,
        )

    def show(self, score: float) -> None:
        """Shows the training after an episode, its rate in agent-steps, and its best validation score."""
        population, episode = self._training.population, self._training.n_flown
        steps = len(population.runs) * population.scenario.mission.max_steps * (episode - self._first)
        means = latest_means(self._training)
        text = (
            f"{steps / (time.monotonic() - self._started):,.0f}/s return {means['episode_return']:.1f} "
            f"collected {means['users_collected']:.1f} landed {means['landing_rate']:.0%} best {score:.1f}"
        )
        self.update(episode, text, None if episode % self._line_every else f"episode {episode} {text}")


def latest_means(training: "Training") -> dict[str, float]:
    """Means of the curves over all runs and their latest 20 episodes; NaN before a mission has ended."""
    latest = {name: values[-_LATEST:] for name, values in training.curves.items()}
    ended = np.isfinite(latest["reward"])
    return {
        name: float(values[ended].mean()) if ended.any() else float("nan") for name, values in latest.items()
    }
