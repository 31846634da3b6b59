"""The live display of a training: bars on a terminal, plain lines in a file."""

import time
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from uav_dc_ros.experiments.train.training import Training

# Episodes of each run that the figures of a `ProgressReport` look back on.
_LATEST = 20


@dataclass(frozen=True, kw_only=True)
class ProgressReport:
    """How training stands after an episode; means are over all runs and their latest episodes.

    Attributes:
        episode: episodes flown by each run.
        mean_return: what the agents were paid in an episode; NaN while no mission has ended.
        users_collected: users collected.
        landing_rate: share of episodes that landed.
        score: best validation score until now: mean number of users collected, where a mission that
            did not land counts as none; NaN before the first validation.
    """

    episode: int
    mean_return: float
    users_collected: float
    landing_rate: float
    score: float

    @classmethod
    def of(cls, training: "Training", score: float) -> "ProgressReport":
        """The report of a training after an episode."""
        latest = {name: values[-_LATEST:] for name, values in training.curves.items()}
        known = np.isfinite(latest["reward"])

        def mean(name: str) -> float:
            return float(latest[name][known].mean()) if known.any() else float("nan")

        return cls(
            episode=training.n_flown,
            mean_return=mean("episode_return"),
            users_collected=mean("users_collected"),
            landing_rate=mean("landing_rate"),
            score=score,
        )


class ProgressDisplay:
    """Shows reports as they come; a context manager."""

    def __init__(self, training: "Training", line_every: int) -> None:
        """For a training, begun or not; away from a terminal, one line every `line_every` episodes."""
        self._console = Console(stderr=True)
        self._line_every = line_every
        self._started, self._first = time.monotonic(), training.n_flown
        self._steps = len(training.population.runs) * training.population.scenario.mission.max_steps
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def show(self, report: ProgressReport) -> None:
        """Shows one report; its rate is in agent-steps, each a step and a gradient step of one run."""
        rate = self._steps * (report.episode - self._first) / (time.monotonic() - self._started)
        text = (
            f"{rate:,.0f}/s return {report.mean_return:.1f} collected {report.users_collected:.1f} "
            f"landed {report.landing_rate:.0%} best {report.score:.1f}"
        )
        self._bars.update(self._task, completed=report.episode, text=text)
        if not self._console.is_terminal and report.episode % self._line_every == 0:
            self._console.print(f"episode {report.episode} {text}", soft_wrap=True)
