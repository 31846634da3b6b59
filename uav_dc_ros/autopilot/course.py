"""Where a mission stands on the grid, and how that outlives a bridge that was killed."""

import msgspec
import numpy as np

from uav_dc_ros.autopilot.frames import Enu
from uav_dc_ros.autopilot.vehicle import Telemetry
from uav_dc_ros.autopilot.watch import Settings
from uav_dc_ros.core import world as core
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase

Cell = tuple[int, int, int]


class Standing(msgspec.Struct, frozen=True, kw_only=True):
    """Where a mission stands, for a bridge that was killed and takes it up again.

    Attributes:
        step, cell: to go on with. A move that was begun is flown to its end, and not begun again.
        flies: has the vehicle left the ground, or may it have?
        outcome: of a mission that was on its way down, or over; None: it goes on.
        reason: why it was.
        at_rest_v: voltage of the battery before take-off; None: not told.
    """

    step: int
    cell: Cell
    flies: bool = False
    outcome: Phase | None = None
    reason: str = ""
    at_rest_v: float | None = None


class Course:
    """Steps and cells of one mission.

    Args:
        scenario: the world that is flown.
        standing: where it is taken up; None: at its beginning.

    Attributes:
        step: steps flown.
        cell: the cell that the vehicle reached last.
        goal: the cell that it is in, or flies to.
    """

    def __init__(self, scenario: Scenario, standing: Standing | None = None) -> None:
        self.scenario = scenario
        self.standing = standing or Standing(step=0, cell=scenario.start_cell)
        self.step, self.cell, self.goal = self.standing.step, self.standing.cell, self.standing.cell

    @property
    def target(self) -> Enu:
        """Centre of the goal, in the grid's ENU frame."""
        return self.centre(self.goal)

    def centre(self, cell: Cell) -> Enu:
        """Centre of a cell, in the grid's ENU frame."""
        return Enu(*self.scenario.grid.centre_m(np.asarray(cell), like=np.zeros(1)).tolist())

    def beyond(self, action: Action) -> Cell:
        """The cell that an action leads to."""
        east, north, up = self.scenario.grid.move(np.asarray(self.cell), np.asarray(int(action))).tolist()
        return east, north, up

    def arrive(self) -> None:
        """End a step, at its goal."""
        self.step, self.cell = self.step + 1, self.goal

    @property
    def is_done(self) -> bool:
        """Are there no further steps."""
        terminated, truncated, _ = self._ends()
        return self.step > 0 and bool(terminated or truncated)

    @property
    def is_at_dock(self) -> bool:
        """Does the last step end where a vehicle lands."""
        return bool(self._ends()[2])

    def _ends(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return core.ends(self.scenario, np.asarray(self.step), np.asarray(self.cell))


class Dwell:
    """Whether a vehicle is where it was sent, and stays there.

    Args:
        settings: how near, and for how long.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._since_s: float | None = None  # vehicle time

    def begin(self) -> None:
        """Forget what was: it is on its way to another place."""
        self._since_s = None

    def is_there(self, target: Enu, known: Telemetry) -> bool:
        """Has it been at a place for the dwell time; where it is must be known."""
        assert known.position is not None, "a fault otherwise"
        if float(np.linalg.norm(np.subtract(known.position, target))) > self._settings.tolerance_m:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = known.vehicle_s
        return known.vehicle_s - self._since_s >= self._settings.dwell_s
