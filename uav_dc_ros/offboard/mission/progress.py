"""Progress of a mission on the grid, and the checkpoint from which a restarted bridge resumes it."""

import math

import msgspec
import numpy as np

from uav_dc_ros.core import world as core
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Mode

Cell = tuple[int, int, int]


class Checkpoint(msgspec.Struct, frozen=True, kw_only=True):
    """State of a mission, for a bridge that was killed and resumes it."""

    step: int
    cell: Cell  # reached last
    goal: Cell | None = None  # of the move in progress, which the restarted bridge completes
    steps_not_reached: int = 0
    energy_used_j: float = 0.0  # by the scenario's model
    airborne: bool = False  # the vehicle has left the ground, or may have
    released: bool = False  # to another controller, or it stands again: the bridge requests nothing any more
    allowed_mode: str | None = None  # see `Preflight`
    pilot_has_control: bool = False  # see `Preflight`
    home: tuple[float, float, float] | None = None  # where it was armed, in the grid's ENU frame
    stop_reason: str = ""  # the mission ends after the move in progress; empty: it does not
    outcome: Phase | None = None  # final phase of a mission that is landing or over
    reason: str = ""  # of the outcome
    landing_mode: Mode | None = None  # with an outcome
    landing_requested: bool = False  # the bridge has requested that mode
    landing_confirmed: bool = False  # the vehicle was in a landing mode: any later mode is a pilot's
    at_rest_v: float | None = None  # battery voltage before take-off; None: not measured


class MissionProgress:
    """Steps and cells of one mission."""

    def __init__(self, scenario: Scenario, checkpoint: Checkpoint | None = None) -> None:
        self.scenario = scenario
        self.checkpoint = checkpoint or Checkpoint(step=0, cell=scenario.start_cell)  # at the bridge's start
        self.step, self.cell = self.checkpoint.step, self.checkpoint.cell  # steps flown, cell reached last
        self.goal = self.checkpoint.goal or self.checkpoint.cell  # cell that the vehicle flies to, or is in
        self.steps_not_reached = self.checkpoint.steps_not_reached  # that ended away from their goal's centre
        self.energy_used_j: Array = np.asarray(self.checkpoint.energy_used_j)  # by the model, joules

    @property
    def target(self) -> Enu:
        """Centre of the goal, in the grid's ENU frame."""
        return self.centre(self.goal)

    def centre(self, cell: Cell) -> Enu:
        """Centre of a cell, in the grid's ENU frame."""
        return Enu(*self.scenario.grid.centre_m(np.asarray(cell), like=np.zeros(1)).tolist())

    def neighbour(self, action: Action) -> Cell:
        """Cell that an action leads to."""
        east, north, up = core.move(self.scenario, np.asarray(self.cell), np.asarray(int(action))).tolist()
        return east, north, up

    def distance_m(self, position: Enu) -> float:
        """Distance of a position from the goal's centre."""
        return math.dist(position, self.target)

    def dock_distance_m(self, position: Enu) -> float:
        """Horizontal distance of a position from the dock."""
        return math.dist(position[:2], self.scenario.mission.dock_m)

    def may_end_at(self, position: Enu, settings: SafetySettings) -> bool:
        """Whether a step whose time is over may end at a position away from its goal."""
        grid = self.scenario.grid
        sizes_m = (grid.cell_m, grid.cell_m, grid.altitude_step_m)
        offsets = (abs(p - t) / size for p, t, size in zip(position, self.target, sizes_m, strict=True))
        if max(offsets) > settings.max_offset_cells:
            return False
        lands = self._ends(self.step + 1, self.goal, self._energy_after())[2]
        return not lands or self.dock_distance_m(position) <= settings.landing_radius_m

    def complete_step(self, reached: bool = True) -> None:
        """End a step; `reached`: at its goal."""
        self.energy_used_j = self._energy_after()
        self.step, self.cell = self.step + 1, self.goal
        self.steps_not_reached += not reached

    @property
    def is_done(self) -> bool:
        """Whether the last step is flown."""
        terminated, truncated, _ = self._ends(self.step, self.cell, self.energy_used_j)
        return self.step > 0 and (terminated or truncated)

    @property
    def is_at_dock(self) -> bool:
        """Whether the last step ended where the vehicle lands."""
        return self._ends(self.step, self.cell, self.energy_used_j)[2]

    @property
    def used_up(self) -> str:
        """What a mission that ended away from the dock is out of."""
        return "steps" if self.step >= self.scenario.mission.max_steps else "the scenario's battery"

    def _energy_after(self) -> Array:
        """Energy used after a step from the cell to the goal."""
        cell, goal = np.asarray(self.cell), np.asarray(self.goal)
        return core.energy_after(self.scenario, self.energy_used_j, cell, goal)

    def _ends(self, step: int, cell: Cell, energy_used_j: Array) -> tuple[bool, bool, bool]:
        ends = core.end_of_mission(self.scenario, np.asarray(step), np.asarray(cell), energy_used_j)
        terminated, truncated, landed = map(bool, ends)
        return terminated, truncated, landed
