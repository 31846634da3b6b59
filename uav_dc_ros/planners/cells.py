"""The cells of a scenario as a graph, and what each of them would deliver in a step."""

from functools import lru_cache

import numpy as np

from uav_dc_ros.core import mission, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import MOVES, Action
from uav_dc_ros.core.obstacles import UNREACHABLE
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ParameterError

SIZE_MAX = 20_000_000  # cells times users: tables of 160 MB


class Cells:
    """The C cells that the UAV can reach, numbered, with their moves.

    Raises:
        ParameterError: more cells and users than `SIZE_MAX`.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, grid = scenario, scenario.grid
        if (size := int(np.prod(grid.shape)) * scenario.n_users) > SIZE_MAX:
            raise ParameterError(
                f"scenario {scenario.name!r}: cells times users are {size}; this planner expects "
                f"at most {SIZE_MAX}"
            )
        everywhere = np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3)
        if scenario.moves is None:
            reachable = np.ones(len(everywhere), dtype=bool)
        else:
            reachable = (
                scenario.moves.steps_from(np.asarray([scenario.start_cell])).reshape(-1) != UNREACHABLE
            )
        self.cells: Array = everywhere[reachable]  # `[C, 3]`
        self._numbers = np.where(reachable, np.cumsum(reachable) - 1, -1).reshape(grid.shape)
        actions = np.arange(len(MOVES))
        moved = world.move(
            scenario,
            np.repeat(self.cells[:, None], len(MOVES), axis=1),
            actions[None] + 0 * self.cells[:, :1],
        )
        self.after: Array = self.number(moved)  # number of the cell after each action, `[C, 7]`
        # The actions that have an effect, and hover, bool `[C, 7]`
        self.valid: Array = (self.after != np.arange(len(self.cells))[:, None]) | (actions == Action.HOVER)
        self.at_dock: Array = mission.at_dock(self.cells, scenario.dock_cell)  # bool `[C]`
        self.to_dock: Array = self._steps(scenario.dock_cell)  # moves to the dock, `[C]`
        self.uav_m: Array = grid.centre_m(self.cells, like=np.zeros(1))  # `[C, 3]`
        self.steps_to = lru_cache(maxsize=256)(self._steps_to)  # moves to the cell of a number, `[C]`

    def number(self, cell: Array) -> Array:
        """Numbers of cells `[..., 3]`, integers `[...]`; -1 for one that cannot be reached."""
        return self._numbers[tuple(np.moveaxis(cell, -1, 0))]

    def _steps_to(self, number: int) -> Array:
        return self._steps(self.cells[number])

    def _steps(self, goal: Array | tuple[int, int]) -> Array:
        """Moves from each cell to a goal `[3]`, or a column of cells `[2]`, integers `[C]`."""
        moves, goal = self.scenario.moves, np.asarray(goal)
        if moves is None:
            return np.abs(self.cells[:, : len(goal)] - goal).sum(axis=-1)
        steps = (
            moves.steps_from(goal[None]) if len(goal) == 3 else moves.steps_to((int(goal[0]), int(goal[1])))
        )
        return steps[tuple(self.cells.T)].astype(np.int64)

    @property
    def energies_j(self) -> Array:
        """Energy of each action, joules, `[7]`; zeros in a scenario without `energy`."""
        if self.scenario.energy is None:
            return np.zeros(len(MOVES))
        one = self.scenario.step_energies_j
        return np.asarray([*(one.level,) * 4, one.climb, one.descent, one.hover])

    @property
    def has_battery(self) -> bool:
        """Whether the battery may end a mission."""
        return self.scenario.energy is not None and self.scenario.energy.ends != "steps"


class Delivery:
    """The data of a step over each cell, with the users at given positions, and no draw of the channel.

    `users_m` is `[U, 2]`, metres. Where interference is `associated`, a user's data depend on who is served.
    """

    def __init__(self, cells: Cells, users_m: Array) -> None:
        self._scenario = scenario = cells.scenario
        waiting = np.zeros((1, scenario.n_users), dtype=bool)
        everywhere_m = np.broadcast_to(users_m, (len(cells.cells), *users_m.shape))
        self._served, self._gain = world.reception(scenario, cells.uav_m, everywhere_m, waiting)
        self._depends = scenario.radio.interference == "associated"
        self._bits = self._delivered(self._served, self._gain)

    def of(self, number: Array, collected: Array) -> Array:
        """Data in a step over cells `[N]`, bit, `[N, U]`, of users not collected; `collected` is `[N, U]`."""
        if not self._depends:
            return self._bits[number] * ~collected
        return self._delivered(self._served[number] & ~collected, self._gain[number])

    def everywhere(self, collected: Array) -> Array:
        """Data in a step over each cell, bit, `[C, U]`, where `collected` is `[U]`."""
        if not self._depends:
            return self._bits * ~collected
        return self._delivered(self._served & ~collected, self._gain)

    def _delivered(self, served: Array, gain: Array) -> Array:
        link = world.link_over(self._scenario, served, gain)
        return mission.delivered(served, link.rate_bps, self._scenario.mission.step_s)
