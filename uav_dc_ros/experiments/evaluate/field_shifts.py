"""Shifts of no single key of a scenario: users that are not where the map has them, and a finer grid."""

import math
from typing import Any

import numpy as np

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users.settings import Point
from uav_dc_ros.errors import ScenarioError

_DIRECTIONS = 100  # that are tried for a cluster


def misplaced(values: dict[str, Any], scenario: Scenario, share: float, source: str) -> None:
    """Move each cluster by a share of its distance to the nearest other one, in a random direction.

    `values` are the plain values of a scenario, whose positions change in place; distances are those in
    `scenario`. A cluster keeps its shape. The directions are those of the scenario's fingerprint: equal
    scenarios have equal shifts. A direction out of the grid is not taken, if there is another.

    Raises:
        ScenarioError: a single cluster.
    """
    centres_m, users = scenario.cluster_centres_m, values["users"]
    if len(centres_m) == 1:
        raise ScenarioError(f"{source}: the scenario has one cluster; expected two or more, with a distance")
    (west_m, south_m), (east_m, north_m) = scenario.grid.area_m
    rng = np.random.default_rng(int(scenario.fingerprint, 16))
    moved: list[Point] = []
    for i, centre_m in enumerate(centres_m):
        others = (other for j, other in enumerate(centres_m) if j != i)
        way_m = share * min(math.dist(centre_m, other) for other in others)
        points = (
            [(user.x_m, user.y_m) for user in scenario.users.listed[i]] if users.get("user") else [centre_m]
        )
        for angle in rng.uniform(0.0, 2.0 * math.pi, _DIRECTIONS).tolist():
            dx_m, dy_m = way_m * math.cos(angle), way_m * math.sin(angle)
            if all(west_m <= x + dx_m <= east_m and south_m <= y + dy_m <= north_m for x, y in points):
                break
        moved.append((dx_m, dy_m))
    if users.get("user"):
        ways_m = zip(scenario.users.listed, moved, strict=True)
        of_user = {id(user): way_m for listed, way_m in ways_m for user in listed}
        for user, own in zip(users["user"], scenario.users.user, strict=True):
            dx_m, dy_m = of_user[id(own)]
            user["x_m"], user["y_m"] = user["x_m"] + dx_m, user["y_m"] + dy_m
    else:
        users["cluster_centres_m"] = [
            [x_m + dx_m, y_m + dy_m]
            for (x_m, y_m), (dx_m, dy_m) in zip(users["cluster_centres_m"], moved, strict=True)
        ]


def refined(values: dict[str, Any], n: int) -> None:
    """Divide each cell of a scenario's plain values, which change in place, into `n` along each axis.

    The field keeps its size and the UAV its speed: a step takes an n-th of the time, and a mission has n
    times as many.
    """
    grid, mission = values["grid"], values["mission"]
    for key in ("n_x", "n_y", "n_z"):
        grid[key] = (grid[key] - 1) * n + 1
    for table, key in ((grid, "cell_m"), (grid, "altitude_step_m"), (mission, "step_s")):
        table[key] /= n
    mission["max_steps"] *= n
