"""What a real vehicle told of its flight: phases that follow each other as they may, and where it was.

Nothing here can be recomputed to the last bit: where a real vehicle is, it alone knows. What can be checked
is that no move was flown twice, that time goes forward, and that a phase came after one that it may follow.
How far the vehicle was from the centres of its cells is told, and not judged: a step also ends when its time
is over, wherever the wind has the vehicle by then.
"""

from dataclasses import dataclass

import numpy as np

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.phases import next_phases
from uav_dc_ros.recordings.recorded_step import RecordedStep, Told
from uav_dc_ros.recordings.verify.differences import Book, Difference, difference


@dataclass
class Apart:
    """How far the vehicle was from the centre of its cell when it was measured there.

    Attributes:
        n: steps.
        sum_m, max_m: of the distances, metres.
        at: the step of the greatest, in words.
        elsewhere: steps in which it was nearer to the centre of another cell.
    """

    n: int = 0
    sum_m: float = 0.0
    max_m: float = 0.0
    at: str = ""
    elsewhere: int = 0

    def add(self, step: RecordedStep, scenario: Scenario) -> None:
        """Measure a step, if its pose and its cell are known."""
        if not step.poses or step.status is None:
            return
        grid = scenario.grid
        centre_m = grid.centre_m(np.asarray(step.status.cell), like=np.zeros(1))
        off_m = step.poses[0].position_m - centre_m
        distance_m = float(np.linalg.norm(off_m))
        if distance_m >= self.max_m:
            self.max_m, self.at = distance_m, step.name
        self.n += 1
        self.sum_m += distance_m
        size_m = np.asarray([grid.cell_m, grid.cell_m, grid.altitude_step_m])
        self.elsewhere += bool((np.abs(off_m) > size_m / 2).any())

    def lines(self) -> list[str]:
        """In words."""
        if not self.n:
            return []
        mean_m = self.sum_m / self.n
        told = [
            f"  it was measured {mean_m:.2f} m from the centre of its cell on average, at most "
            f"{self.max_m:.2f} m ({self.at})"
        ]
        if self.elsewhere:
            told.append(f"  {self.elsewhere} steps were measured nearer to the centre of another cell")
        return told


class Flights(Book):
    """The words of real vehicles looked through, step by step.

    Args:
        scenario: the world.

    Attributes:
        apart: how far from their cells they were.
        unposed: steps whose users have a time of which no pose is recorded.
        holds: how often something kept one from going on.
        begun: steps whose move was begun, over all missions.
        not_reached: flown steps whose cell was not reached, as the vehicle says; by flight and mission.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__()
        self.apart = Apart()
        self.unposed = self.holds = self.begun = 0
        self.not_reached: dict[tuple[int, int], int] = {}
        self._scenario = scenario
        self._before: RecordedStep | None = None
        # Flight, mission, how often the clock had been set back, and the users' time.
        self._stamp_ns: tuple[tuple[int, int, int], int] = (-1, -1, 0), 0

    def add(self, step: RecordedStep) -> None:
        """Look at a step."""
        before, self._before = self._before, step
        follows = before is not None and (before.flight, before.mission, before.step + 1) == (
            (step.flight, step.mission, step.step)
        )
        self.apart.add(step, self._scenario)
        self.holds += sum(told.held for told in step.told)
        if step.status is not None:
            self.not_reached[step.flight, step.mission] = step.status.steps_not_reached
        found = self._time(step)
        if not step.untold:
            found += self._order(step, before.told[-1] if follows and before and before.told else None)
        moves = sum(told.phase is Phase.MOVING for told in step.phases)
        self.begun += moves > 0
        if moves > 1:
            found.append(difference(step, "mission", "moves begun", moves, 1))
        if not found and not step.told:
            self.skip("no mission recorded")
        elif not found and step.untold:
            self.skip("more was told of it than is looked at")
        else:
            self.enter(found)

    def _order(self, step: RecordedStep, before: Told | None) -> list[Difference]:
        """Phases that may not follow the one before them."""
        found = []
        may_come: tuple[Phase, ...] | None = None
        if before is not None:
            may_come = next_phases(before.phase, steps=1, restarts=True)
        for told in step.phases:
            if may_come is not None and told.phase not in may_come:
                expected = ", ".join(may_come)
                found.append(difference(step, "mission", "phase", told.phase.value, f"one of {expected}"))
            may_come = next_phases(told.phase, restarts=True)
        return found

    def _time(self, step: RecordedStep) -> list[Difference]:
        """Users have the time of a pose, and a later one with each step, unless the clock was set back."""
        if step.users is None:
            return []
        which, last_ns = self._stamp_ns
        now_ns, mission = step.users.stamp_ns, (step.flight, step.mission, step.clock)
        self._stamp_ns = mission, now_ns
        self.unposed += not step.poses or step.poses[0].stamp_ns != now_ns
        if which == mission and now_ns <= last_ns:
            return [difference(step, "users", "stamp_ns", now_ns, f"later than {last_ns}")]
        return []

    def lines(self, vehicle: str) -> list[str]:
        """In words."""
        total = self.compared + self.skipped.total()
        told = f"vehicle ({vehicle}): phases of {self.compared} of {total} steps looked at"
        if self.differing:
            lines = [f"{told}, {self.differing} are not as they may be; first:", f"  {self.first}"]
        else:
            lines = [f"{told}, each follows as it may; {self.begun} moves were begun, none of them twice"]
        lines += self.apart.lines()
        if n := sum(self.not_reached.values()):
            lines.append(f"  {n} flown steps were not reached within the tolerance, as the vehicle says")
        if self.holds:
            times = "once" if self.holds == 1 else f"{self.holds} times"
            lines.append(f"  it held {times}: bag report tells why")
        if self.unposed:
            lines.append(f"  {self.unposed} steps have users at a time of which no pose is recorded")
        return lines + [f"  {n} not looked at: {reason}" for reason, n in self.skipped.most_common()]
