"""The problem of a clairvoyant planner: the walks of a mission are known, so all data is a table.

A user counts as collected when what it has delivered adds up to its r_min. What it delivers in a step depends
on the cell and the step alone, as long as interference does not depend on which users are collected. Then a
user is collected by a mission if, and only if, the sum over all its steps reaches r_min: after that it
delivers nothing, but nothing else changes.
"""

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.planners.model import MissionModel, known_walks
from uav_dc_ros.planners.promise import groups_of_users

_NUMBERS_MAX = 3 * 10**8  # of a table: 2.4 GB
_NODES_MAX = 6_000_000  # steps times cells times sets of groups
_GROUPS_MAX = 5


class ClairvoyantProblem:
    """The mission of a seed. T steps, C cells, U users, G groups of users."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """Draw the walks, and work out the tables.

        Raises:
            ScenarioError: the data of a step depends on more than cell and step, or the world is too large.
        """
        check(scenario)
        self.scenario, self.seed = scenario, seed
        self.start, walks = known_walks(scenario, seed)
        self.model = model = MissionModel(scenario, walks)
        self.n_steps, self.n_users, n_cells = scenario.mission.max_steps, scenario.n_users, len(model.cells)
        cells, none = np.arange(n_cells), np.zeros((n_cells, self.n_users), bool)
        r_min_bits = scenario.user_r_min_bits(np.zeros(1))
        # Share of r_min that each user delivers in a step, at most 1, `[T, C, U]`. The limit changes nothing:
        # a step in which a user delivers more than r_min collects it.
        self.share = np.stack(
            [np.minimum(model.delivered(t, cells, none) / r_min_bits, 1.0) for t in range(self.n_steps)]
        )
        self.start_cell = int(model.index(self.start.cell))
        self.ends_on_arrival = scenario.mission.episode_end == "on_arrival"
        n_groups = max(1, min(_GROUPS_MAX, int(np.log2(max(_NODES_MAX / (self.n_steps * n_cells), 2.0)))))
        self.group = groups_of_users(scenario, walks.users_m[self.n_steps // 2], n_groups)
        self.n_groups = int(self.group.max()) + 1
        in_group = self.group == np.arange(self.n_groups)[:, None]
        # Groups with a user in reach, as bits, integers `[T, C]`
        self.in_reach = np.zeros(self.share.shape[:2], np.int64)
        for i, members in enumerate(in_group):
            self.in_reach |= (self.share[..., members] > 0.0).any(axis=-1).astype(np.int64) << i
        sets = np.arange(1 << self.n_groups)[:, None] >> np.arange(self.n_groups) & 1
        self.members = (sets @ in_group).astype(bool)  # users of each set of groups, `[2^G, U]`

    def cells_of(self, actions: Array) -> Array:
        """The cell (its index) after each of T steps; the UAV hovers behind the last of `actions`."""
        cells, here = np.empty(self.n_steps, np.int64), self.start_cell
        for step in range(self.n_steps):
            here = self.model.after[here, actions[step] if step < len(actions) else Action.HOVER]
            cells[step] = here
        return cells


def check(scenario: Scenario) -> None:
    """Raise ScenarioError for a world whose optimum is not worked out here."""
    if scenario.radio.interference == "associated":
        raise ScenarioError(
            f"scenario {scenario.name!r}: radio.interference = 'associated', where a user's rate depends on "
            "the users that are collected; expected 'all' or 'none'"
        )
    if scenario.energy is not None and scenario.energy.ends != "steps":
        raise ScenarioError(
            f"scenario {scenario.name!r}: energy.ends = {scenario.energy.ends!r}, with which a battery ends "
            "missions; expected 'steps'"
        )
    n_x, n_y, n_z = scenario.grid.shape
    numbers = scenario.mission.max_steps * n_x * n_y * n_z * scenario.n_users
    if numbers > _NUMBERS_MAX:
        raise ScenarioError(
            f"scenario {scenario.name!r}: steps times cells times users are {numbers}; "
            f"expected at most {_NUMBERS_MAX}, which fit into memory"
        )
