"""How well a mission served its users: age of information, fairness, and the time to the last user.

`mean_age_s`           the age of information: time since the user was served last or, before that, since the
                       start of the mission; mean over the ends of the steps, and over the users by priority.
                       Every transmission is taken as generated when it is sent. Kaul, Yates, Gruteser,
                       "Real-Time Status: How Often Should One Update?", INFOCOM 2012
`fairness`             Jain's index of the users' data, each relative to the volume at which it is collected.
                       Jain, Chiu, Hawe, "A Quantitative Measure of Fairness and Discrimination for Resource
                       Allocation in Shared Computer Systems", DEC-TR-301, 1984
`last_collected_step`  step in which the last of the collected users was collected

docs/users.md writes the formulas out.
"""

import math
from typing import TYPE_CHECKING

from uav_dc_ros.core.arrays import Array, array_namespace

if TYPE_CHECKING:
    from uav_dc_ros.core.scenario import Scenario

FIGURES = ("mean_age_s", "fairness", "last_collected_step")


class ServiceRecord:
    """When the users of missions `[...]` were served and collected; arrays of numpy or torch."""

    def __init__(self, zeros: Array) -> None:
        """Missions before their first step; `zeros` are real numbers 0 of the shape `[..., U]`."""
        self._served_at = zeros  # step in which each user was served last, `[..., U]`
        self._ages = zeros  # sum of the ages at the ends of the steps, in steps, `[..., U]`
        self._n_steps = self._n_collected = zeros.sum(axis=-1)  # `[...]`
        self._last_collected = self._n_steps + math.nan  # step, `[...]`; NaN: no user is collected

    def add(self, step: Array, served: Array, collected: Array, over: Array | None = None) -> None:
        """Add a step: its number `[...]` from 1, and who was served and is collected, bool `[..., U]`.

        Missions that are `over`, bool `[...]`, stay as they are.
        """
        xp, kind = array_namespace(served), self._ages.dtype
        step = xp.astype(step, kind)
        served_at = xp.where(served, step[..., None], self._served_at)
        ages = self._ages + (step[..., None] - served_at)
        n_collected = xp.sum(xp.astype(collected, kind), axis=-1)
        last_collected = xp.where(n_collected > self._n_collected, step, self._last_collected)
        n_steps = self._n_steps + 1.0
        if over is not None:
            ages = xp.where(over[..., None], self._ages, ages)
            last_collected = xp.where(over, self._last_collected, last_collected)
            n_steps = xp.where(over, self._n_steps, n_steps)
        self._served_at, self._ages, self._n_steps = served_at, ages, n_steps
        self._n_collected, self._last_collected = n_collected, last_collected

    def restart(self, where: Array) -> None:
        """Forget the missions in `where`, bool `[...]`, before the first step of the next ones."""
        xp, fresh = array_namespace(where), ServiceRecord(0.0 * self._ages)
        self._served_at = xp.where(where[..., None], fresh._served_at, self._served_at)
        self._ages = xp.where(where[..., None], fresh._ages, self._ages)
        self._n_steps = xp.where(where, fresh._n_steps, self._n_steps)
        self._n_collected = xp.where(where, fresh._n_collected, self._n_collected)
        self._last_collected = xp.where(where, fresh._last_collected, self._last_collected)

    def figures(self, scenario: "Scenario", data_bits: Array) -> dict[str, Array]:
        """The `FIGURES` of each mission, `[...]`, with the data of each user so far, bit, `[..., U]`.

        NaN without a step, without data, or without a collected user.
        """
        xp = array_namespace(data_bits)
        weights = scenario.user_weights(self._ages)
        ages = xp.mean(self._ages, axis=-1) if weights is None else (self._ages * weights).sum(axis=-1)
        n_steps = xp.where(self._n_steps > 0.0, self._n_steps, math.nan)
        return {
            "mean_age_s": ages / n_steps * scenario.mission.step_s,
            "fairness": jain_index(data_bits / scenario.user_r_min_bits(data_bits)),
            "last_collected_step": self._last_collected,
        }


def jain_index(shares: Array) -> Array:
    """Jain's index of what U users have, `[..., U]`: from 1 / U (one has all) to 1 (all the same), `[...]`.

    NaN where no user has anything.
    """
    xp = array_namespace(shares)
    total, squares = shares.sum(axis=-1), (shares * shares).sum(axis=-1)
    return total * total / (shares.shape[-1] * xp.where(squares > 0.0, squares, math.nan))
