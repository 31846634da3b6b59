"""Obstacles compared with a mission before it flies: its cells, its moves, and its ways home.

An autopilot that returns knows no obstacle. It climbs to its return altitude, unless it is higher, flies home
on a straight line and lands there. An autopilot that lands comes down where it is.
"""

import math

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import MOVES
from uav_dc_ros.core.obstacles import polygons
from uav_dc_ros.core.obstacles.moves import UNREACHABLE
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.vehicle import Limits, Mode

PARTS = 16  # of a move: each keeps clear of obstacles by itself


def cell_conflict(scenario: Scenario, fence: Geofence, settings: SafetySettings) -> str | None:
    """The cell from which the policy may fly too near to an obstacle; None: there is none.

    The fence keeps `margin_m` from obstacles. Cells, the straight moves between them, and the landing at the
    dock keep `tolerance_m` besides.
    """
    wanted_m = fence.margin_m + settings.tolerance_m
    for i, obstacle in enumerate(scenario.obstacles):
        starts_m, ends_m, cells = _moves_m(scenario)
        at_dock = (cells[:, :2] == np.asarray(scenario.dock_cell)).all(axis=-1)
        below_m = starts_m[:, 0] * [1.0, 1.0, 0.0]
        near = obstacle.meets(starts_m, ends_m, wanted_m).any(axis=-1)
        near |= at_dock & obstacle.meets(below_m, starts_m[:, 0], wanted_m)
        if near.any():
            cell = _first(cells, near)
            return (
                f"{obstacle.title(i)}: cell {cell}, a move from it or its landing is nearer than "
                f"{wanted_m:g} m; expected its clearance_m of at least {wanted_m:g} (bridge.fence_margin_m + "
                "bridge.tolerance_m), or a smaller bridge.fence_margin_m"
            )
    return None


def return_conflict(
    scenario: Scenario, fence: Geofence, settings: SafetySettings, limits: Limits | None, home: Enu
) -> str | None:
    """The obstacle that a return, or a landing in place of it, comes too near to; None: there is none."""
    starts_m, ends_m, cells = _moves_m(scenario)
    lands = settings.failsafe_action is Mode.LAND
    if not lands and (unknown := _altitude_conflict(settings, limits)) is not None:
        return unknown
    if not lands and settings.land_if_return_blocked:
        return _stranded(scenario, fence, settings, home)
    # A mission may end on the way to the next cell, from where the straight way home keeps half a cell less.
    straight_m = fence.margin_m + scenario.grid.cell_m / 2
    home_m, altitude_m = np.asarray(home), settings.return_altitude_m
    for i, obstacle in enumerate(scenario.obstacles):
        polygon_m, base_m = obstacle.polygon_m, obstacle.base_m
        # Of the columns of air over the moves
        beside = (polygons.distance_m(polygon_m, starts_m[..., :2], ends_m[..., :2]) < fence.margin_m).any(
            axis=-1
        )
        height_m = starts_m[:, 0, 2]
        if lands and (above := beside & (height_m > base_m)).any():
            return (
                f"{obstacle.title(i)}: a landing from cell {_first(cells, above)} comes nearer than "
                f"{fence.margin_m:g} m; expected bridge.failsafe_action=return, or no cell above the obstacle"
            )
        if lands:
            continue
        needed_m = obstacle.top_m + fence.margin_m - home.up_m  # altitude of a return above the obstacle
        from_m = starts_m[:, 0, :2]
        straight = polygons.distance_m(polygon_m, from_m, np.broadcast_to(home_m[:2], from_m.shape))
        passes = (beside & (height_m < base_m)) | ((straight < straight_m) & (needed_m > altitude_m))
        if passes.any():
            higher = "" if math.isinf(needed_m) else f"bridge.return_altitude_m of at least {needed_m:.0f}, "
            cell = _first(cells, passes)
            return (
                f"{obstacle.title(i)}: a return from cell {cell} at {altitude_m:g} m above home comes too "
                f"near; expected {higher}another home, or bridge.failsafe_action=land"
            )
        if obstacle.meets(home_m, np.asarray(home.plus(Enu(0.0, 0.0, altitude_m))), fence.margin_m):
            return f"{obstacle.title(i)}: home is nearer than {fence.margin_m:g} m; expected another home"
    return None


def _stranded(scenario: Scenario, fence: Geofence, settings: SafetySettings, home: Enu) -> str | None:
    """Where both return and landing come too near to an obstacle, or home is near one; None: nowhere.

    Each part of a move keeps `margin_m` and `tolerance_m`, one way or the other.
    """
    home_m, altitude_m = np.asarray(home), settings.return_altitude_m
    top_m = np.asarray(home.plus(Enu(0.0, 0.0, altitude_m)))
    for i, obstacle in enumerate(scenario.obstacles):
        if obstacle.meets(home_m, top_m, fence.margin_m):
            return f"{obstacle.title(i)}: home is nearer than {fence.margin_m:g} m; expected another home"
    starts_m, ends_m, cells = _moves_m(scenario)
    margin_m = fence.margin_m + settings.tolerance_m

    def distances_m(start_m: Array, end_m: Array) -> list[Array]:
        """Horizontal distance of each obstacle from straight paths."""
        end_m = np.broadcast_to(end_m, start_m.shape)
        return [
            polygons.distance_m(one.polygon_m, start_m[..., :2], end_m[..., :2]) for one in scenario.obstacles
        ]

    # Below the other moves there is no obstacle: a landing is free.
    from_cell, action = np.nonzero(np.min(distances_m(starts_m, ends_m), axis=0) < margin_m)
    start_m, way_m = starts_m[from_cell, action], (ends_m - starts_m)[from_cell, action]
    at_m = start_m[:, None] + way_m[:, None] * np.linspace(0.0, 1.0, PARTS + 1)[:, None]
    from_m, to_m = at_m[:, :-1], at_m[:, 1:]
    part_m = np.linalg.norm(to_m - from_m, axis=-1)
    lands, returns = np.zeros((2, *part_m.shape), dtype=bool)  # whether an obstacle is in the way of it
    ways_m = zip(scenario.obstacles, distances_m(from_m, to_m), distances_m(from_m, home_m), strict=True)
    for obstacle, beside_m, straight_m in ways_m:
        is_high = obstacle.top_m + fence.margin_m - home.up_m > altitude_m
        lands |= (beside_m < margin_m) & (np.maximum(from_m, to_m)[..., 2] > obstacle.base_m)
        returns |= (beside_m < margin_m) & (from_m[..., 2] < obstacle.base_m)
        returns |= (straight_m < margin_m + part_m) & is_high
    if not (both := (returns & lands).any(axis=-1)).any():
        return None
    cell = _first(cells[from_cell], both)
    return (
        f"obstacles: on a move from cell {cell} both a return at {altitude_m:g} m above home and a landing "
        f"come nearer than {margin_m:g} m; expected a higher bridge.return_altitude_m or another home"
    )


def _altitude_conflict(settings: SafetySettings, limits: Limits | None) -> str | None:
    """Why the altitude of a return is not known; None: it is, and not another than the autopilot reports."""
    altitude_m, reported_m = settings.return_altitude_m, None if limits is None else limits.return_altitude_m
    if altitude_m <= 0.0:
        reported = "" if reported_m is None else f" (it reports {reported_m:g})"
        return (
            "obstacles, and bridge.return_altitude_m is not known; expected the altitude above home at which "
            f"the autopilot returns (RTL_ALT, RTL_RETURN_ALT){reported}, or bridge.failsafe_action=land"
        )
    if reported_m is not None and abs(reported_m - altitude_m) > 1.0:
        return (
            f"the autopilot returns at {reported_m:g} m above home (RTL_ALT, RTL_RETURN_ALT); expected "
            f"bridge.return_altitude_m = {altitude_m:g}"
        )
    return None


def _moves_m(scenario: Scenario) -> tuple[Array, Array, Array]:
    """Starts and ends of all moves that a mission may fly, metres `[n, 7, 3]`, and their cells, `[n, 3]`."""
    assert scenario.moves is not None, "only with obstacles"
    cells = np.argwhere(scenario.moves.steps_from(np.asarray([scenario.start_cell])) != UNREACHABLE)
    valid = scenario.moves.valid(cells)
    after = np.where(valid[..., None], cells[:, None] + np.asarray(MOVES), cells[:, None])
    ends_m = scenario.grid.centre_m(after, like=np.zeros(1))
    return np.broadcast_to(ends_m[:, -1:], ends_m.shape), ends_m, cells


def _first(cells: Array, where: Array) -> tuple[int, ...]:
    return tuple(cells[where.argmax()].tolist())
