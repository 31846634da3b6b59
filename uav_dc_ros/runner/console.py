"""What run_all shows: a live line on a terminal, plain lines elsewhere, and the summary."""

import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import JustifyMethod
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from uav_dc_ros.cli import Output
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Mission
from uav_dc_ros.mission_summary import Summary
from uav_dc_ros.phases import POLICY_CONTROLLED
from uav_dc_ros.runner.monitor import MissionProgress

REFRESH_S = 0.05
PLAIN_LINES = 6  # of progress a mission, where there is no terminal


class MissionConsole:
    """Shows missions while they are flown; a context manager.

    Args:
        scenario: the world that is flown.
        missions: how many missions will be flown.
        show: is anything printed?
    """

    def __init__(self, scenario: Scenario, missions: int, *, show: bool = True) -> None:
        self.scenario = scenario
        self.missions = missions
        self._here = Path.cwd()  # by the end of the missions it may be deleted
        self._output = Output()
        self.console = self._output.console(sys.stdout)
        self.errors = self._output.console(sys.stderr)
        self.console.quiet = self.errors.quiet = not show
        self._every = max(1, scenario.mission.max_steps // PLAIN_LINES)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("step {task.completed:.0f}/{task.total:.0f}"),
            TextColumn("{task.fields[told]}"),
            TimeElapsedColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        self._next_s = 0.0  # when the next step is shown
        self._told: Mission | None = None  # what the vehicle did last
        self._task = self._bar.add_task("starting the nodes", total=scenario.mission.max_steps, told="")

    def step(self, now: MissionProgress) -> None:
        """Show a step: on a terminal a few times a second, elsewhere a few lines a mission."""
        shown = now.step % self._every == 0 if self._bar.disable else time.monotonic() >= self._next_s
        if not (shown or now.over or now.step == self.scenario.mission.max_steps):
            return
        self._next_s = time.monotonic() + REFRESH_S
        title = "mission" if self.missions == 1 else f"mission {now.mission + 1} of {self.missions}"
        told = (
            f"{now.users_collected}/{self.scenario.n_users} users, "
            f"{now.sum_rate_bps / 1e6:.2f} Mbit/s, {now.dock_distance_m:.0f} m to the dock"
        )
        if self._bar.disable:
            self.console.print(f"{title}: step {now.step}/{self.scenario.mission.max_steps}: {told}")
        else:
            self._bar.update(self._task, description=title, completed=now.step, told=told)

    def vehicle(self, status: Mission) -> None:
        """Tell what a real vehicle does, unless it is a step's daily work: a fault, and its end, is not."""
        before, told = self._told, (status.state, status.reason)
        if not status.reason or (before is not None and told == (before.state, before.reason)):
            return
        self._told = status
        goes_on = before is not None and before.phase in POLICY_CONTROLLED and not before.held
        if status.phase in POLICY_CONTROLLED and not status.held and goes_on:
            return
        self._bar.update(self._task, description=status.phase.value)
        self.console.print(f"{status.state}: {status.reason}", markup=False)

    def node_line(self, node: str, line: str) -> None:
        """Pass on a line that a node printed."""
        self._bar.console.print(f"{node}: {line}", markup=False)

    def note(self, text: str) -> None:
        """Tell what the user should know."""
        self.console.print(f"note: {text}", markup=False)

    def error(self, text: str) -> None:
        """Tell what went wrong."""
        self.errors.print(f"error: {text}", markup=False)

    def summary(self, summaries: list[Summary]) -> None:
        """Show the missions as a table, and where the bag is."""
        table = Table(box=None, pad_edge=False, header_style="bold")
        for name in ("seed", "outcome", "steps", "users", "data", "sum-rate", "flown", "reward"):
            justify: JustifyMethod = "left" if name == "outcome" else "right"
            table.add_column(name, justify=justify, no_wrap=True, overflow="fold")
        for mission in summaries:
            missed = f" ({mission.steps_not_reached} not reached)" if mission.steps_not_reached else ""
            table.add_row(
                str(mission.seed),
                mission.outcome.value,
                f"{mission.steps}{missed}",
                f"{mission.users_collected}/{mission.users_total}",
                f"{mission.data_bits / 1e6:.1f} Mbit",
                f"{mission.sum_rate_bps / 1e6:.3f} Mbit/s",
                f"{mission.distance_m:.0f} m",
                f"{mission.reward:.3f}",
            )
        self.console.print(table)
        if summaries and summaries[0].bag is not None:
            self.console.print(f"bag: {self._beside(Path(summaries[0].bag))}", markup=False)

    def _beside(self, path: Path) -> Path:
        """A path, short where it lies in the working directory."""
        return path.relative_to(self._here) if path.is_relative_to(self._here) else path

    def __enter__(self) -> Self:
        """Start the live display."""
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the terminal as it was."""
        self._bar.stop()
        self.drain()

    def drain(self) -> None:
        """Wait until everything is written."""
        self._output.drain()
