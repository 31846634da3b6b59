"""Checks of flights with a real vehicle: allowed phase changes, no move flown twice, times that increase.

Nothing here is recomputed, since only the vehicle knows its position. Its distance from the centres of cells
is reported and is no difference: a step also ends when its time is over.
"""

import numpy as np

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.phases import next_phases
from uav_dc_ros.recordings.recorded_step import PhaseReport, RecordedStep
from uav_dc_ros.recordings.verify.recompute import Check, Difference, difference


class VehicleCheck(Check):
    """Checks the status reports of a real vehicle; `vehicle`: its name in the output."""

    title = "vehicle"

    def __init__(self, scenario: Scenario, vehicle: str) -> None:
        super().__init__()
        self._scenario, self._vehicle = scenario, vehicle
        self._without_pose = 0  # steps without a pose of their users' time
        self._holds = 0
        self._moves = 0  # steps whose move was started
        self._not_reached: dict[tuple[int, int], int] = {}  # by flight and mission
        self._before: RecordedStep | None = None
        # Flight, mission and number of clock resets; and the users' time.
        self._stamp_ns: tuple[tuple[int, int, int], int] = (-1, -1, 0), 0
        self._measured = 0  # steps with a pose and a cell
        self._sum_m = self._max_m = 0.0  # of their distances from the centres of their cells
        self._max_at = ""
        self._elsewhere = 0  # steps nearer to the centre of another cell

    def add(self, step: RecordedStep) -> None:
        """Check a step."""
        before, self._before = self._before, step
        self._measure(step)
        self._holds += sum(report.held for report in step.phase_reports)
        if step.status is not None:
            self._not_reached[step.flight, step.mission] = step.status.steps_not_reached
        found = self._time(step)
        if not step.n_dropped_reports:
            reports = before.phase_reports if before and step.follows(before) else []
            found += self._order(step, reports[-1] if reports else None)
        moves = sum(report.phase is Phase.MOVING for report in step.phase_changes)
        self._moves += moves > 0
        if moves > 1:
            found.append(difference(step, "mission", "moves started", moves, 1))
        if not found and not step.phase_reports:
            self.skipped["no mission recorded"] += 1
        elif not found and step.n_dropped_reports:
            self.skipped["too many phase reports"] += 1
        else:
            self.count(found)

    def _measure(self, step: RecordedStep) -> None:
        """Measure the distance from the centre of the cell."""
        if not step.poses or step.status is None:
            return
        grid = self._scenario.grid
        centre_m = grid.centre_m(np.asarray(step.status.cell), like=np.zeros(1))
        offset_m = step.poses[0].position_m - centre_m
        distance_m = float(np.linalg.norm(offset_m))
        if distance_m >= self._max_m:
            self._max_m, self._max_at = distance_m, step.name
        self._measured += 1
        self._sum_m += distance_m
        size_m = np.asarray([grid.cell_m, grid.cell_m, grid.altitude_step_m])
        self._elsewhere += bool((np.abs(offset_m) > size_m / 2).any())

    def _order(self, step: RecordedStep, before: PhaseReport | None) -> list[Difference]:
        """Phases that may not follow the previous one."""
        found = []
        allowed = None if before is None else next_phases(before.phase, steps=1, restarts=True)
        for report in step.phase_changes:
            if allowed is not None and report.phase not in allowed:
                expected = f"one of {', '.join(allowed)}"
                found.append(difference(step, "mission", "phase", report.phase.value, expected))
            allowed = next_phases(report.phase, restarts=True)
        return found

    def _time(self, step: RecordedStep) -> list[Difference]:
        """Users have the time of a pose, and a later one with each step unless the clock was set back."""
        if step.users is None:
            return []
        last, last_ns = self._stamp_ns
        now_ns, mission = step.users.stamp_ns, (step.flight, step.mission, step.clock_resets)
        self._stamp_ns = mission, now_ns
        self._without_pose += not step.poses or step.poses[0].stamp_ns != now_ns
        if last == mission and now_ns <= last_ns:
            return [difference(step, "users", "stamp_ns", now_ns, f"later than {last_ns}")]
        return []

    def lines(self) -> list[str]:
        """The result as text."""
        total = self.compared + self.skipped.total()
        summary = f"vehicle ({self._vehicle}): phases of {self.compared} of {total} steps checked"
        if self.first:
            lines = [f"{summary}, {self.differing} have a change that is not allowed; first:"]
            lines.append(f"  {self.first.text}")
        else:
            lines = [f"{summary}, all changes are allowed; {self._moves} moves were started, none twice"]
        if self._measured:
            lines.append(
                f"  distance from the centre of the cell: mean {self._sum_m / self._measured:.2f} m, max "
                f"{self._max_m:.2f} m ({self._max_at})"
            )
        if self._elsewhere:
            lines.append(f"  {self._elsewhere} steps were measured nearer to the centre of another cell")
        if n := sum(self._not_reached.values()):
            lines.append(f"  {n} flown steps did not reach their cell within the tolerance")
        if self._holds:
            times = "once" if self._holds == 1 else f"{self._holds} times"
            lines.append(f"  faults held the vehicle {times}: bag report lists them")
        if self._without_pose:
            lines.append(f"  {self._without_pose} steps have no recorded pose of their users' time")
        return lines + [f"  {n} not checked: {reason}" for reason, n in self.skipped.most_common()]
