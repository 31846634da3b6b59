"""The moves that obstacles leave to the UAV.

A move follows the straight path between the centres of two cells. A move whose path comes nearer to an
obstacle than its `clearance_m` has no effect, as at the edge of the grid.
"""

from functools import lru_cache
from typing import Any

import numpy as np

from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.grid import MOVES, Action, Grid
from uav_dc_ros.core.obstacles.prisms import Obstacle

UNREACHABLE = -1
_OPPOSITE = (
    (Action.RIGHT, Action.LEFT),
    (Action.FORWARD, Action.BACKWARD),
    (Action.UPWARD, Action.DOWNWARD),
)  # east, north, up: the path of a move and that of its reverse are the same


class Moves:
    """The moves that have an effect in a grid with obstacles; hovering always has one."""

    def __init__(self, grid: Grid, obstacles: tuple[Obstacle, ...]) -> None:
        """Check every path between neighbouring cells once."""
        self.grid = grid
        cells = np.moveaxis(np.indices(grid.shape), 0, -1)  # [n_x, n_y, n_z, 3]
        targets = cells[..., None, :] + np.asarray(MOVES)
        valid = ((targets >= 0) & (targets < np.asarray(grid.shape))).all(axis=-1)
        for obstacle in obstacles:
            east, north, up = _near(grid, obstacle)
            for x in range(east.start, east.stop):  # a large zone in one piece takes too much memory
                near = x, north, up
                starts_m = grid.centre_m(cells[near][..., None, :], like=np.zeros(1))
                ends_m = grid.centre_m(targets[near], like=np.zeros(1))
                meets = obstacle.meets(np.broadcast_to(starts_m, ends_m.shape), ends_m, obstacle.clearance_m)
                valid[near] &= ~meets
        for axis, (there, back) in enumerate(_OPPOSITE):
            first, last = [slice(None)] * 3, [slice(None)] * 3
            first[axis], last[axis] = slice(-1), slice(1, None)
            valid[(*last, back)] = valid[(*first, there)]
        # Whether the UAV may be in a cell, bool [n_x, n_y, n_z]: its hover meets no obstacle
        self.free: Array = valid[..., Action.HOVER].copy()
        valid[..., Action.HOVER] = True
        self._flat: Array = valid.reshape(-1)

    def valid(self, cell: Array) -> Array:
        """The moves that have an effect from cells `[..., 3]`, bool `[..., 7]` in the order of `Action`."""
        xp = array_namespace(cell)
        first = len(MOVES) * self._index(cell)
        entries = first[..., None] + constant(range(len(MOVES)), first)
        return xp.take(self._on(cell), entries.reshape((-1,)), axis=0).reshape(entries.shape)

    def apply(self, cell: Array, action: Array, after: Array) -> Array:
        """`after` where the move from `cell` has an effect, else `cell`, both `[..., 3]`; action `[...]`."""
        xp = array_namespace(cell)
        entries = len(MOVES) * self._index(cell) + action
        valid = xp.take(self._on(cell), entries.reshape((-1,)), axis=0).reshape((*entries.shape, 1))
        return xp.where(valid, after, cell)

    def steps_from(self, cells: Array) -> Array:
        """Moves from the nearest of some cells `[n, 3]` to each cell, int32 `[n_x, n_y, n_z]`.

        The search is breadth first and ignores cells that are not free. `UNREACHABLE` where no moves lead
        to. The way back has as many moves.
        """
        n_x, n_y, n_z = self.grid.shape
        steps = np.full(n_x * n_y * n_z, UNREACHABLE, np.int32)
        offsets = np.asarray([(east * n_y + north) * n_z + up for east, north, up in MOVES])
        valid = self._flat.reshape(-1, len(MOVES))
        frontier, n = np.unique(self._index(cells[self.free[tuple(cells.T)]])), 0
        while frontier.size:
            steps[frontier] = n
            targets = (frontier[:, None] + offsets)[valid[frontier]]
            frontier, n = np.unique(targets[steps[targets] == UNREACHABLE]), n + 1
        return steps.reshape(self.grid.shape)

    def steps_to(self, column: tuple[int, int]) -> Array:
        """Moves from each cell to a column of cells, east and north; see `steps_from`."""
        return self.steps_from(np.asarray([(*column, up) for up in range(self.grid.n_z)]))

    def _index(self, cell: Array) -> Array:
        _, n_y, n_z = self.grid.shape
        return (cell[..., 0] * n_y + cell[..., 1]) * n_z + cell[..., 2]

    def _on(self, cell: Array) -> Array:
        return self._flat if isinstance(cell, np.ndarray) else _copy(self, array_namespace(cell), cell.device)


@lru_cache(maxsize=16)
def _copy(moves: Moves, xp: Any, device: Any) -> Array:
    """The table on a device, copied once."""
    return xp.asarray(moves._flat, device=device)


def _near(grid: Grid, obstacle: Obstacle) -> tuple[slice, slice, slice]:
    """The cells from which a move may meet an obstacle."""
    corners, margin_m = np.asarray(obstacle.polygon_m), obstacle.clearance_m
    low_m = (*(corners.min(axis=0) - margin_m), obstacle.base_m - margin_m - grid.altitude_min_m)
    high_m = (*(corners.max(axis=0) + margin_m), obstacle.top_m + margin_m - grid.altitude_min_m)
    spacing_m = (grid.cell_m, grid.cell_m, grid.altitude_step_m)
    east, north, up = (
        slice(*(int(np.clip(edge, 0, n)) for edge in (np.floor(low / size) - 1, np.ceil(high / size) + 2)))
        for low, high, size, n in zip(low_m, high_m, spacing_m, grid.shape, strict=True)
    )
    return east, north, up
