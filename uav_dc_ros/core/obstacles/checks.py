"""Errors of the obstacles of a scenario."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from uav_dc_ros.core.channel import FreeSpace
from uav_dc_ros.core.obstacles import polygons
from uav_dc_ros.core.obstacles.moves import UNREACHABLE
from uav_dc_ros.core.obstacles.polygons import Polygon
from uav_dc_ros.core.obstacles.prisms import blocks

if TYPE_CHECKING:
    from uav_dc_ros.core.scenario import Scenario

CELLS_MAX = 10_000_000  # of a grid with obstacles: the table of its moves has seven bytes for each


def problems(scenario: "Scenario") -> Iterator[str]:
    """Errors of a scenario's obstacles, lazily: a later check relies on the earlier ones."""
    grid, mission, obstacles = scenario.grid, scenario.mission, scenario.obstacles
    if math.prod(grid.shape) > CELLS_MAX:
        yield f"grid: {math.prod(grid.shape)} cells with obstacles; expected at most {CELLS_MAX}"
    half_m = grid.cell_m / 2
    east_m, north_m = (n * grid.cell_m - half_m for n in grid.shape[:2])
    field = ((-half_m, -half_m), (east_m, -half_m), (east_m, north_m), (-half_m, north_m))
    for i, obstacle in enumerate(obstacles):
        title = obstacle.title(i)
        if (problem := polygons.problem(obstacle.polygon_m)) is not None:
            yield f"{title}: polygon_m: {problem}"
        if obstacle.height_m is None and obstacle.kind == "building":
            yield f"{title}: missing key height_m; expected the altitude of the building's top, metres"
        if obstacle.base_m >= obstacle.top_m:
            yield f"{title}: base_m = {obstacle.base_m:g}; expected less than height_m = {obstacle.top_m:g}"
        if not _overlap(obstacle.polygon_m, field):
            yield (
                f"{title}: its polygon lies outside the field; expected a part of it within x "
                f"{-half_m:g} to {east_m:g} and y {-half_m:g} to {north_m:g} m"
            )
    radio = scenario.radio
    if scenario.buildings is not None and isinstance(radio, FreeSpace) and radio.obstruction_loss_db is None:
        yield (
            "missing key radio.obstruction_loss_db; expected the loss of a link that a building cuts, dB, or "
            "a radio.model that has one"
        )
    assert scenario.moves is not None, "only with obstacles"
    east, north = scenario.dock_cell
    layers = np.flatnonzero(scenario.moves.free[east, north]).tolist() or [0]
    ways = [("start_m", "take-off to", mission.start_m)]
    ways += [
        ("dock_m", "landing from", grid.centre_m(np.asarray((east, north, up)), np.zeros(1))) for up in layers
    ]
    for key, what, (x_m, y_m, z_m) in ways:
        if (obstacle_title := blocks(obstacles, (x_m, y_m, 0.0), (x_m, y_m, z_m))) is not None:
            yield (
                f"{obstacle_title}: it is over mission.{key} = {list(getattr(mission, key))}; expected a "
                f"free way for the {what} {z_m:g} m"
            )
    if moves_to_dock(scenario) == UNREACHABLE:
        yield (
            f"mission.dock_m = {list(mission.dock_m)}; expected a way between the obstacles to it from "
            f"mission.start_m = {list(mission.start_m)}"
        )


def moves_to_dock(scenario: "Scenario") -> int:
    """Moves from start to dock between the obstacles; `UNREACHABLE`: none lead there."""
    assert scenario.moves is not None, "only with obstacles"
    return int(scenario.moves.steps_to(scenario.dock_cell)[scenario.start_cell])


def _overlap(one: Polygon, other: Polygon) -> bool:
    """Whether two polygons have a common point."""
    starts = np.asarray(one, np.float64)
    if (polygons.distance_m(other, starts, np.roll(starts, -1, axis=0)) == 0.0).any():
        return True
    return bool(polygons.contains(one, np.asarray(other[0])))
