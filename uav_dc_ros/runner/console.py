"""The display of run_all: a live line on a terminal, plain lines elsewhere, and the summary."""

import time
from pathlib import Path

import numpy as np
from rich.progress import TextColumn, TimeElapsedColumn
from rich.table import Table

from uav_dc_ros.cli import LiveDisplay
from uav_dc_ros.core import reward, world
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Mission
from uav_dc_ros.mission_summary import Summary
from uav_dc_ros.phases import POLICY_CONTROLLED
from uav_dc_ros.runner.monitor import MonitoredMission

REFRESH_S = 0.05
PLAIN_LINES = 6  # per mission, without a terminal


class MissionConsole(LiveDisplay):
    """Shows the missions of a run; prints nothing if not `show`."""

    def __init__(self, scenario: Scenario, missions: int, *, show: bool = True) -> None:
        super().__init__(
            TextColumn("step {task.completed:.0f}/{task.total:.0f}"),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
        )
        self.scenario, self.missions = scenario, missions
        self._working_directory = Path.cwd()  # may be deleted during the run
        self.console.quiet = self.errors.quiet = not show
        self._line_steps = max(1, scenario.mission.max_steps // PLAIN_LINES)
        self._next_s = 0.0  # time of the next refresh
        self._status: Mission | None = None  # last one shown
        self._task = self._bar.add_task("starting the nodes", total=scenario.mission.max_steps, text="")

    def step(self, now: MonitoredMission) -> None:
        """Show a step: on a terminal at `REFRESH_S`, elsewhere a few per mission."""
        due = now.steps % self._line_steps == 0 if self._bar.disable else time.monotonic() >= self._next_s
        if not (due or now.is_over or now.steps == self.scenario.mission.max_steps):
            return
        self._next_s = time.monotonic() + REFRESH_S
        title = "mission" if self.missions == 1 else f"mission {now.index + 1} of {self.missions}"
        assert now.cell is not None
        assert now.rates is not None
        dock_m = float(world.dock_distance_m(self.scenario, np.asarray(now.cell), like=np.zeros(1)))
        users, sum_rate_mbps = f"{now.collected}/{self.scenario.n_users} users", now.rates.sum_rate_bps / 1e6
        text = f"{users}, {sum_rate_mbps:.2f} Mbit/s, {dock_m:.0f} m to the dock"
        if self._bar.disable:
            self.console.print(f"{title}: step {now.steps}/{self.scenario.mission.max_steps}: {text}")
        else:
            self._bar.update(self._task, description=title, completed=now.steps, text=text)

    def vehicle(self, status: Mission) -> None:
        """Print a new state or reason of a real vehicle, except the routine of a step without faults."""
        before = self._status
        if not status.reason or (before and (status.state, status.reason) == (before.state, before.reason)):
            return
        self._status = status
        if _is_routine(status) and before is not None and _is_routine(before):
            return
        self._bar.update(self._task, description=status.phase.value)
        self.console.print(f"{status.state}: {status.reason}", markup=False)

    def line(self, source: str, text: str) -> None:
        """Print a node's line of output, or a `note`."""
        self.console.print(f"{source}: {text}", markup=False)

    def error(self, text: str) -> None:
        """Print an error to standard error."""
        self.errors.print(f"error: {text}", markup=False)

    def summary(self, summaries: list[Summary]) -> None:
        """Print the missions as a table, and the bag's folder; wait until everything is written."""
        table = Table(box=None, pad_edge=False, header_style="bold")
        for name in ("seed", "outcome", "steps", "users", "data", "sum-rate", "flown", "reward"):
            table.add_column(name, justify="right", no_wrap=True, overflow="fold")
        table.columns[1].justify = "left"
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
        self.console.print(f"reward: {reward.MISSION_REWARD[self.scenario.reward.data]}")
        if summaries and summaries[0].bag is not None:
            bag = Path(summaries[0].bag)
            if bag.is_relative_to(self._working_directory):
                bag = bag.relative_to(self._working_directory)
            self.console.print(f"bag: {bag}", markup=False)
        self._output.drain()


def _is_routine(status: Mission) -> bool:
    return status.phase in POLICY_CONTROLLED and not status.held
