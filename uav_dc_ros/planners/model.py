"""The model of a mission that a planner searches with: moves, and the data delivered by step and cell.

It is the world of `core`, to the last bit, with the users where the planner expects them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_dc_ros.core import mission, mobility, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.propagation.counter_random import seed_of
from uav_dc_ros.core.propagation.stochastic import Realization
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import State
from uav_dc_ros.planners.cells import Cells

_BLOCK = 1 << 18  # links at a time


@dataclass(frozen=True, kw_only=True)
class Walks:
    """Where the users are in each of the next H steps, and what a random channel draws there."""

    users_m: Array  # metres, `[H, U, 2]`
    drawn: Sequence[Realization] | None = None  # of each step; None: the mean channel


def known_walks(scenario: Scenario, seed: int) -> tuple[State, Walks]:
    """The start of the mission of a seed, and its walks: what only a clairvoyant planner knows.

    The draws are those of `rollout_steps` and of the environment.
    """
    rng = np.random.default_rng(seed)
    start = world.initial(scenario, rng.random(scenario.draws_shape))
    users_m, motion, walks, drawn = start.users_m, start.motion, [], []
    for _ in range(scenario.mission.max_steps):
        draws = rng.random(scenario.draws_shape)
        users_m, motion = mobility.move(scenario, users_m, motion, draws)
        walks.append(users_m)
        drawn.append(Realization(start.waves, seed_of(draws)))
    return start, Walks(users_m=np.stack(walks), drawn=drawn if scenario.radio.is_random else None)


class Model(Cells):
    """The moves of a scenario, and what a search needs besides."""

    n_steps: int  # H, the steps to look ahead

    def delivered(self, step: int, cell: Array, collected: Array) -> Array:
        """Bits that users deliver in the step with index `step` (0 to H - 1), `[B, U]`.

        Of missions with the UAV at `cell` (indices `[B]`) and users collected before, bool `[B, U]`.
        """
        raise NotImplementedError


class MissionModel(Model):
    """The moves of a scenario, and the data that users deliver over the next steps, by cell."""

    def __init__(self, scenario: Scenario, walks: Walks) -> None:
        super().__init__(scenario)
        self.walks = walks
        self.n_steps = len(walks.users_m)  # H
        self._uav_m = scenario.grid.centre_m(self.cells, like=walks.users_m)

    def delivered(self, step: int, cell: Array, collected: Array) -> Array:
        """See `Model.delivered`."""
        drawn = None if self.walks.drawn is None else self.walks.drawn[step]
        users_m = self.walks.users_m[step]
        if self.scenario.radio.interference == "associated":
            return self._bits(cell, users_m, collected, drawn)
        here, inverse = np.unique(cell, return_inverse=True)
        none = np.zeros((len(here), len(users_m)), bool)
        return self._bits(here, users_m, none, drawn)[inverse] * ~collected

    def mean_delivered(self, users_m: Array) -> Array:
        """Bits that users at `users_m` `[U, 2]` deliver in a step over the mean channel, `[C, U]`.

        None of them is collected.
        """
        none = np.zeros((len(self.cells), len(users_m)), bool)
        return self._bits(np.arange(len(self.cells)), users_m, none, None)

    def spread(self, values: Array) -> Array:
        """The minimum of `values` `[C, U]` plus the moves to where they are, for each cell, `[C, U]`."""
        if self.scenario.moves is None:
            grid = values.reshape(*self.scenario.grid.shape, -1)
            for axis, n in enumerate(self.scenario.grid.shape):
                index = np.arange(n, dtype=np.float64).reshape(-1, *(1,) * (3 - axis))
                ahead = np.minimum.accumulate(grid - index, axis=axis) + index
                back = np.flip(np.minimum.accumulate(np.flip(grid + index, axis), axis=axis), axis) - index
                grid = np.minimum(ahead, back)
            return grid.reshape(values.shape)
        while True:
            nearer = np.minimum(values, values[self.after].min(axis=1) + 1.0)
            if np.array_equal(nearer, values):
                return values
            values = nearer

    def _bits(self, cell: Array, users_m: Array, collected: Array, drawn: Realization | None) -> Array:
        """As `delivered`, with users at `users_m` `[U, 2]`; in blocks, since shadowing takes much memory."""
        n = max(1, _BLOCK // len(users_m))
        bits = np.empty(collected.shape)
        for rows in (slice(first, first + n) for first in range(0, len(cell), n)):
            uav_m = self._uav_m[cell[rows]]
            everywhere_m = np.broadcast_to(users_m, (len(uav_m), *users_m.shape))
            link = world.measure(self.scenario, uav_m, everywhere_m, collected[rows], drawn=drawn)
            bits[rows] = mission.delivered(link.served, link.rate_bps, self.scenario.mission.step_s)
        return bits
