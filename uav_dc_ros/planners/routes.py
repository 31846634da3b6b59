"""Shortest ways among obstacles, move by move."""

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import MOVES, Action
from uav_dc_ros.core.obstacles.moves import UNREACHABLE
from uav_dc_ros.core.scenario import Scenario

# Of several actions on shortest ways the first one is taken.
_PREFERRED = (
    *(Action.HOVER, Action.DOWNWARD, Action.LEFT, Action.RIGHT, Action.BACKWARD, Action.FORWARD),
    Action.UPWARD,
)
_FAR = np.iinfo(np.int32).max


class Routes:
    """Ways to each cluster and to the dock: goals 0 to M - 1, and M.

    A cluster's goal is the cell nearest to its centre that the UAV can reach.
    """

    def __init__(self, scenario: Scenario) -> None:
        assert scenario.moves is not None, "only with obstacles"
        self._moves, grid = scenario.moves, scenario.grid
        steps = self._moves.steps_from(np.asarray([scenario.start_cell]))
        reachable = np.argwhere(steps != UNREACHABLE)
        centres_m = grid.centre_m(reachable, like=np.zeros(1))
        clusters_m = np.pad(np.asarray(scenario.cluster_centres_m), ((0, 0), (0, 1)))
        nearest = [((centres_m - one) ** 2).sum(axis=-1).argmin() for one in clusters_m]
        self.cells = reachable[nearest]  # of the clusters' goals, integers `[M, 3]`
        to_clusters = [self._moves.steps_from(cell[None]) for cell in self.cells]
        tables = np.stack([*to_clusters, self._moves.steps_to(scenario.dock_cell)], axis=-1)
        self._steps = np.where(tables == UNREACHABLE, _FAR, tables)

    def steps(self, cell: Array) -> Array:
        """Moves from cells `[..., 3]` to each goal, integers `[..., M + 1]`."""
        return self._steps[tuple(np.moveaxis(cell, -1, 0))]

    def towards(self, cell: Array, goal: Array) -> Array:
        """The action on a shortest way from cells `[..., 3]` to goals, integers `[...]`; at one, hover."""
        valid = self._moves.valid(cell)
        after = np.where(valid[..., None], cell[..., None, :] + np.asarray(MOVES), cell[..., None, :])
        steps = np.take_along_axis(self.steps(after), goal[..., None, None], axis=-1)[..., 0]
        steps = np.where(valid, steps, _FAR)[..., _PREFERRED]
        return np.asarray(_PREFERRED)[steps.argmin(axis=-1)]
