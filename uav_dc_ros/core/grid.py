"""The grid of cells that the UAV moves on, and the seven moves.

A cell is three indices, east, north and up. The centre of cell (0, 0, 0) is at the map's origin, at the
lowest altitude. Frames are ENU: x east, y north, z up.
"""

import math
from enum import IntEnum
from typing import Annotated, Literal, TypeAlias, cast

import msgspec

from uav_dc_ros.core.arrays import Array, array_namespace, constant

ActionLabel: TypeAlias = Literal["left", "right", "forward", "backward", "upward", "downward", "hover"]


class Action(IntEnum):
    """The action space (eq. 6), in the paper's order; the value is the network's output index."""

    LEFT = 0  # -x, west
    RIGHT = 1  # +x, east
    FORWARD = 2  # +y, north
    BACKWARD = 3  # -y, south
    UPWARD = 4
    DOWNWARD = 5
    HOVER = 6

    @property
    def label(self) -> ActionLabel:
        """The action's name in messages."""
        return cast(ActionLabel, self.name.lower())


ACTION_LABELS: tuple[ActionLabel, ...] = tuple(action.label for action in Action)

# Cells moved east, north and up by each action, in the order of Action.
MOVES: tuple[tuple[int, int, int], ...] = (
    (-1, 0, 0),
    (1, 0, 0),
    (0, 1, 0),
    (0, -1, 0),
    (0, 0, 1),
    (0, 0, -1),
    (0, 0, 0),
)


class Grid(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Extent and spacing of the cells."""

    # n_x, n_y, n_z: number of cells east, north and up
    n_x: Annotated[int, msgspec.Meta(ge=1, le=1000)]
    n_y: Annotated[int, msgspec.Meta(ge=1, le=1000)]
    n_z: Annotated[int, msgspec.Meta(ge=1, le=100)]
    cell_m: Annotated[float, msgspec.Meta(gt=0)]  # horizontal distance between neighbouring centres, metres
    # Altitude of the lowest layer, metres above the users
    altitude_min_m: Annotated[float, msgspec.Meta(gt=0)]
    altitude_step_m: Annotated[float, msgspec.Meta(gt=0)]  # distance between layers, metres

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells east, north and up."""
        return self.n_x, self.n_y, self.n_z

    @property
    def last_cell(self) -> tuple[int, int, int]:
        """Highest index east, north and up."""
        return self.n_x - 1, self.n_y - 1, self.n_z - 1

    @property
    def area_m(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """South-west and north-east corner x, y of the area of all cells, metres.

        It ends half a cell beyond the outermost centres.
        """
        east_m, north_m = (self.n_x - 0.5) * self.cell_m, (self.n_y - 0.5) * self.cell_m
        return (-0.5 * self.cell_m, -0.5 * self.cell_m), (east_m, north_m)

    def move(self, cell: Array, action: Array) -> Array:
        """The cell `[..., 3]` after an `Action` (its value, `[...]`); a move off the grid has no effect."""
        xp = array_namespace(cell)
        target = cell + xp.take(constant(MOVES, cell), action.reshape((-1,)), axis=0).reshape(cell.shape)
        # A move changes one index by one: clipping cancels a move off the grid.
        return xp.minimum(xp.maximum(target, constant((0,), cell)), constant(self.last_cell, cell))

    def centre_m(self, cell: Array, like: Array) -> Array:
        """Centres x, y, altitude of cells `[..., 3]`, metres, `[..., 3]`; dtype and device as `like`."""
        xp = array_namespace(cell)
        spacing = constant((self.cell_m, self.cell_m, self.altitude_step_m), like)
        origin = constant((0.0, 0.0, self.altitude_min_m), like)
        return origin + xp.astype(cell, like.dtype) * spacing

    def distance_m(self, centre_m: tuple[float, float], radius_m: float) -> float:
        """3D distance between a disc on the ground and the cell nearest to it, metres."""
        cell_m = [
            min(max(round(at_m / self.cell_m), 0), n - 1) * self.cell_m
            for at_m, n in zip(centre_m, self.shape[:2], strict=True)
        ]
        horizontal_m = max(0.0, math.dist(centre_m, cell_m) - radius_m)
        return math.hypot(horizontal_m, self.altitude_min_m)

    def cell_at(self, position_m: tuple[float, float, float]) -> tuple[int, int, int] | None:
        """The cell whose centre is at `position_m` (x, y, altitude, metres), or None."""
        x_m, y_m, z_m = position_m
        height_m = z_m - self.altitude_min_m
        steps = (x_m / self.cell_m, y_m / self.cell_m, height_m / self.altitude_step_m)
        if not all(map(math.isfinite, steps)):  # a spacing so small that the division overflows
            return None
        cell = (round(steps[0]), round(steps[1]), round(steps[2]))
        on_centre = all(abs(s - i) < 1e-6 for s, i in zip(steps, cell, strict=True))
        inside = all(0 <= i < n for i, n in zip(cell, self.shape, strict=True))
        return cell if on_centre and inside else None
