"""The live progress of a training: bars on a terminal, plain lines in a file."""

import time
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from uav_dc_ros.experiments.train.training import Training

_LATEST = 20  # episodes of each run


def latest_means(training: "Training") -> dict[str, float]:
    """Means of the curves over all runs and their latest 20 episodes; NaN before a mission has ended."""
    latest = {name: values[-_LATEST:] for name, values in training.curves.items()}
    ended = np.isfinite(latest["reward"])
    return {
        name: float(values[ended].mean()) if ended.any() else float("nan") for name, values in latest.items()
    }


class ProgressDisplay:
    """Shows the progress of a training; a context manager."""

    def __init__(self, training: "Training", line_every: int) -> None:
        """For a new or resumed training; without a terminal, one line every `line_every` episodes."""
        self._training, self._line_every = training, line_every
        self._console = Console(stderr=True)
        self._started, self._first = time.monotonic(), training.n_flown
        self._bars = Progress(
            # Together they fit into 80 columns.
            MofNCompleteColumn(),
            BarColumn(bar_width=8),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[text]}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bars.add_task(
            "", total=training.population.n_episodes, completed=self._first, text=""
        )

    def __enter__(self) -> "ProgressDisplay":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def show(self, score: float) -> None:
        """Shows the training after an episode, its rate in agent-steps, and its best validation score."""
        population, episode = self._training.population, self._training.n_flown
        steps = len(population.runs) * population.scenario.mission.max_steps * (episode - self._first)
        means = latest_means(self._training)
        text = (
            f"{steps / (time.monotonic() - self._started):,.0f}/s return {means['episode_return']:.1f} "
            f"collected {means['users_collected']:.1f} landed {means['landing_rate']:.0%} best {score:.1f}"
        )
        self._bars.update(self._task, completed=episode, text=text)
        if not self._console.is_terminal and episode % self._line_every == 0:
            self._console.print(f"episode {episode} {text}", soft_wrap=True)
