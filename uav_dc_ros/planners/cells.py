"""The cells of a scenario and the moves between them, numbered, and what each cell delivers in a step."""

import math
from functools import lru_cache

import numpy as np

from uav_dc_ros.core import mission, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import MOVES, Action
from uav_dc_ros.core.obstacles import UNREACHABLE
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ParameterError

SIZE_MAX = 20_000_000  # cells times users: a table of 160 MB
FAR = np.iinfo(np.int32).max  # moves to what cannot be reached


class Cells:
    """The C cells of a grid, also those that the UAV cannot reach.

    Raises:
        ParameterError: more cells times users than `SIZE_MAX`.
    """

    def __init__(self, scenario: Scenario) -> None:
        if (size := math.prod(scenario.grid.shape) * scenario.n_users) > SIZE_MAX:
            raise ParameterError(
                f"scenario {scenario.name!r}: {size} cells times users; the planner expects up to {SIZE_MAX}"
            )
        self.scenario = scenario
        self.cells = np.moveaxis(np.indices(scenario.grid.shape), 0, -1).reshape(-1, 3)  # `[C, 3]`
        after = world.move(
            scenario,
            np.repeat(self.cells, len(MOVES), axis=0),
            np.tile(np.arange(len(MOVES)), len(self.cells)),
        )
        # The cell after each action, integers `[C, 7]`, and whether the action has an effect, or is hover.
        self.after = self.index(after).reshape(-1, len(MOVES))
        self.has_effect = self.after != np.arange(len(self.cells))[:, None]
        self.has_effect[:, Action.HOVER] = True
        self.docked = mission.at_dock(self.cells, scenario.dock_cell)  # bool `[C]`
        self.steps_home = self._steps(np.asarray(scenario.dock_cell))  # moves to the dock, integers `[C]`
        self.steps_to = lru_cache(maxsize=256)(lambda cell: self._steps(self.cells[cell]))  # to a cell, `[C]`

    def index(self, cells: Array) -> Array:
        """Index of cells `[..., 3]` in `cells`, integers `[...]`."""
        _, n_y, n_z = self.scenario.grid.shape
        return (cells[..., 0] * n_y + cells[..., 1]) * n_z + cells[..., 2]

    def _steps(self, goal: Array) -> Array:
        """Moves from each cell to a cell `[3]`, or to a column of cells `[2]`; `FAR`: no way."""
        moves = self.scenario.moves
        if moves is None:
            return np.abs(self.cells[:, : len(goal)] - goal).sum(axis=-1)
        steps = (
            moves.steps_from(goal[None]) if len(goal) == 3 else moves.steps_to((int(goal[0]), int(goal[1])))
        )
        return np.where(steps == UNREACHABLE, FAR, steps).reshape(-1).astype(np.int64)


class Delivery:
    """The data of a step over each cell, with the users at given positions, and no draw of the channel.

    `users_m` is `[U, 2]`, metres. Where interference is `associated`, a user's data depend on who is served.
    From a cell that the UAV cannot reach no data are delivered.
    """

    def __init__(self, cells: Cells, users_m: Array) -> None:
        self._scenario = scenario = cells.scenario
        uav_m = scenario.grid.centre_m(cells.cells, like=users_m)
        waiting = np.zeros((1, scenario.n_users), dtype=bool)
        everywhere_m = np.broadcast_to(users_m, (len(uav_m), *users_m.shape))
        served, self._gain = world.reception(scenario, uav_m, everywhere_m, waiting)
        self._served = served & (cells.steps_home < FAR)[:, None]
        self._depends = scenario.radio.interference == "associated"
        self._bits = self._delivered(self._served, self._gain)

    def of(self, cell: Array, collected: Array) -> Array:
        """Data in a step over cells `[N]`, bit, `[N, U]`, of users not collected; `collected` is `[N, U]`."""
        if not self._depends:
            return self._bits[cell] * ~collected
        return self._delivered(self._served[cell] & ~collected, self._gain[cell])

    def everywhere(self, collected: Array) -> Array:
        """Data in a step over each cell, bit, `[C, U]`, where `collected` is `[U]`."""
        if not self._depends:
            return self._bits * ~collected
        return self._delivered(self._served & ~collected, self._gain)

    def _delivered(self, served: Array, gain: Array) -> Array:
        link = world.link_over(self._scenario, served, gain)
        return mission.delivered(served, link.rate_bps, self._scenario.mission.step_s)
