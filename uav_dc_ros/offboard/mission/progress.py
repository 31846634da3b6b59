"""Where a mission stands on the grid, and how that outlives a bridge that was killed."""

import math

import msgspec
import numpy as np

from uav_dc_ros.core import world as core
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Mode, Telemetry

Cell = tuple[int, int, int]


class Checkpoint(msgspec.Struct, frozen=True, kw_only=True):
    """Where a mission stands, for a bridge that was killed and takes it up again.

    Attributes:
        step, cell: steps flown, and the cell reached last.
        goal: of a move that was begun: it is flown to its end, and not begun again. None: no move was.
        steps_not_reached: of the steps flown, those whose cell was not reached.
        flies: has the vehicle left the ground, or may it have?
        released: has somebody else the vehicle, or does it stand again? Then nothing is requested any more.
        allowed_mode, is_a_pilots: see `Ground`.
        home: where the vehicle was armed, in the grid's ENU frame; None: not known.
        outcome: of a mission that was on its way down, or over; None: it goes on.
        reason: why it was.
        down: how it was to come down, of a mission with an outcome; None: not told.
        asked: was that requested?
        obeyed: was it seen coming down? Who has it fly again is somebody else.
        at_rest_v: voltage of the battery before take-off; None: not told.
    """

    step: int
    cell: Cell
    goal: Cell | None = None
    steps_not_reached: int = 0
    flies: bool = False
    released: bool = False
    allowed_mode: str | None = None
    is_a_pilots: bool = False
    home: tuple[float, float, float] | None = None
    outcome: Phase | None = None
    reason: str = ""
    down: Mode | None = None
    asked: bool = False
    obeyed: bool = False
    at_rest_v: float | None = None


class MissionProgress:
    """Steps and cells of one mission.

    Args:
        scenario: the world that is flown.
        standing: where it is taken up; None: at its beginning.

    Attributes:
        step: steps flown.
        steps_not_reached: of these, how many ended away from their cell's centre.
        cell: the cell that the vehicle reached last.
        goal: the cell that it is in, or flies to.
    """

    def __init__(self, scenario: Scenario, standing: Checkpoint | None = None) -> None:
        self.scenario = scenario
        self.standing = standing or Checkpoint(step=0, cell=scenario.start_cell)
        self.step, self.cell = self.standing.step, self.standing.cell
        self.goal = self.standing.goal or self.standing.cell
        self.steps_not_reached = self.standing.steps_not_reached

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

    def distance_m(self, position: Enu) -> float:
        """Distance of a position from the goal's centre."""
        return math.dist(position, self.target)

    def dock_distance_m(self, position: Enu) -> float:
        """Horizontal distance of a position from the dock."""
        return math.dist(position[:2], self.scenario.mission.dock_m)

    def may_end_at(self, position: Enu, settings: SafetySettings) -> bool:
        """May a step end at a position whose time is over, though its goal was not reached."""
        grid = self.scenario.grid
        sizes_m = (grid.cell_m, grid.cell_m, grid.altitude_step_m)
        offsets = (abs(p - t) / size for p, t, size in zip(position, self.target, sizes_m, strict=True))
        if max(offsets) > settings.max_offset_cells:
            return False
        lands = bool(core.end_of_mission(self.scenario, np.asarray(self.step + 1), np.asarray(self.goal))[2])
        return not lands or self.dock_distance_m(position) <= settings.landing_radius_m

    def arrive(self, reached: bool = True) -> None:
        """End a step, at its goal, or near it."""
        self.step, self.cell = self.step + 1, self.goal
        self.steps_not_reached += not reached

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
        return core.end_of_mission(self.scenario, np.asarray(self.step), np.asarray(self.cell))


class Dwell:
    """Whether a vehicle is where it was sent, and stays there.

    Args:
        settings: how near, and for how long.
    """

    def __init__(self, settings: SafetySettings) -> None:
        self._settings = settings
        self._since_s: float | None = None  # vehicle time

    def begin(self) -> None:
        """Forget what was: it is on its way to another place."""
        self._since_s = None

    def is_there(self, target: Enu, known: Telemetry) -> bool:
        """Has it been at a place for the dwell time."""
        if known.position is None or math.dist(known.position, target) > self._settings.tolerance_m:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = known.vehicle_s
        return known.vehicle_s - self._since_s >= self._settings.dwell_s
