"""The users' start positions and random walk."""

import math

import numpy as np

from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.scenario import Scenario


def scatter(centres_m: Array, radius_m: float, draws: Array) -> Array:
    """Start positions, metres, `[..., U, 2]`, from uniform draws `[..., U, 2]`.

    They are uniform by area in a disc of radius C around the centre of each user's cluster, `[U, 2]`.
    """
    xp = array_namespace(draws)
    # The square root makes equal areas, not equal radii, equally likely.
    return centres_m + _polar(radius_m * xp.sqrt(draws[..., 0]), draws[..., 1])


def walk(users_m: Array, v_max_mps: float, step_s: float, draws: Array) -> Array:
    """Positions after one step of the unbounded random walk, metres, `[..., U, 2]`, from uniform draws.

    Speeds (up to v) and directions are uniform. `users_m` and `draws` are `[..., U, 2]`.
    """
    return users_m + _polar(v_max_mps * step_s * draws[..., 0], draws[..., 1])


def _polar(radius_m: Array, turn: Array) -> Array:
    """Radius `[...]` and angle in turns `[...]` as x, y, `[..., 2]`."""
    xp = array_namespace(radius_m)
    angle_rad = (2.0 * math.pi) * turn
    radius_m, angle_rad = radius_m[..., None], angle_rad[..., None]  # `stack` takes twice the time
    return xp.concat([radius_m * xp.cos(angle_rad), radius_m * xp.sin(angle_rad)], axis=-1)


class WalkingUsers:
    """The users of one mission, drawn from its seed in the order of the environment."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario = scenario
        self._rng = np.random.default_rng(seed)
        self.step = 0  # steps walked
        draws = self._draws()
        centres_m = constant(scenario.user_centres_m, draws)
        # Current positions, metres, `[U, 2]`
        self.positions_m: Array = scatter(centres_m, scenario.users.cluster_radius_m, draws)
        self._next_m: Array | None = None

    def walk(self, steps: int = 1) -> None:
        """Advance the users."""
        for _ in range(steps):
            self.positions_m, self._next_m = self.next_m(), None
            self.step += 1

    def next_m(self) -> Array:
        """Positions after the next step, metres, `[U, 2]`; drawn once."""
        if self._next_m is None:
            v_max_mps, step_s = self._scenario.users.v_max_mps, self._scenario.mission.step_s
            self._next_m = walk(self.positions_m, v_max_mps, step_s, self._draws())
        return self._next_m

    def _draws(self) -> Array:
        return self._rng.random((self._scenario.n_users, 2))
