"""The trajectory of a single mission, as pictures need it. Needs numpy only."""

import numpy as np

from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario


class Trajectory:
    """One mission, step by step; every list begins with the start."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.cells: list[Array] = []  # the UAV's, `[3]` each
        self.n_collected: list[int] = []  # users
        self.sum_rate_bps: list[float] = []  # 0 for the start
        self.state: world.State | None = None  # the latest

    def add(self, state: world.State, link: world.Link | None = None) -> None:
        """Append the start, or the next step, of one mission without batch dimensions."""
        self.cells.append(state.cell)
        self.n_collected.append(int(np.sum(state.collected)))
        self.sum_rate_bps.append(float(link.sum_rate_bps) if link else 0.0)
        self.state = state
