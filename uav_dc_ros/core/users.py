"""The users of one mission with a seed, as they walk about: whoever has the seed has the same users."""

import numpy as np

from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario


class WalkingUsers:
    """Users who walk step by step, drawn in the order of the environment: once to start, once a step.

    Args:
        scenario: whose users.
        seed: of this mission.

    Attributes:
        step: steps walked.
        positions_m: where they are, metres, `[U, 2]`.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario = scenario
        self._rng = np.random.default_rng(seed)
        self.step = 0
        self.positions_m: Array = world.place_users(scenario, self._draw())
        self._ahead_m: Array | None = None

    def walk(self, steps: int = 1) -> None:
        """Walk on."""
        for _ in range(steps):
            self.positions_m, self._ahead_m = self.ahead_m(), None
            self.step += 1

    def ahead_m(self) -> Array:
        """Where they will be after the next step, metres, `[U, 2]`: worked out once, early or late."""
        if self._ahead_m is None:
            self._ahead_m = world.walk_users(self._scenario, self.positions_m, self._draw())
        return self._ahead_m

    def _draw(self) -> Array:
        return self._rng.random((self._scenario.n_users, 2))
