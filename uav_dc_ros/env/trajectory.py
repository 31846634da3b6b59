"""The trajectory of a single mission, as pictures need it. Needs numpy only."""

import numpy as np

from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario


class Trajectory:
    """One mission, step by step; every list begins with the start.

    Attributes:
        scenario: the world's values.
        cells: the UAV's cell after each step.
        n_collected: users collected after each step.
        sum_rate_bps: sum-rate of each step, 0 for the start.
        state: the latest state.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.cells: list[Array] = []
        self.n_collected: list[int] = []
        self.sum_rate_bps: list[float] = []
        self.state: world.State | None = None

    def add(self, state: world.State, link: world.Link | None = None) -> None:
        """Append the start, or the next step, of one mission without batch dimensions."""
        self.cells.append(state.cell)
        self.n_collected.append(int(np.sum(state.collected)))
        self.sum_rate_bps.append(float(link.sum_rate_bps) if link else 0.0)
        self.state = state
