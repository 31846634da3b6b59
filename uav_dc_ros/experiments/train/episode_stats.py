"""Episode statistics of training missions, in the array library of the worlds: no step waits for a device."""

from typing import Any

import numpy as np

from uav_dc_ros.core import mission
from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Outcome, State

# Means over the missions that ended in an episode, exploration included; NaN where none ended.
CURVES = (
    "reward",  # of a mission, see `core.reward.mission_reward`
    "episode_return",  # undiscounted
    "throughput_bps",  # sum-rate of the served users, mean over the steps, bit/s
    "users_collected",
    "landing_rate",
    "arrival_step",  # after which the UAV stayed over the dock; T_cons without a landing
    "loss",  # squared TD error of the learner, mean over the iterations
)


class EpisodeStats:
    """Sums over the steps of each mission, and over the missions of an episode."""

    def __init__(self, scenario: Scenario, like: Array) -> None:
        """Zeros with the library, dtype and device of `like`, floating point `[N]`."""
        self._scenario = scenario
        self._xp = array_namespace(like)
        self._zero = self._xp.zeros_like(like)
        self._return = self._rate_bps = self._arrival = self._zero
        self._reset()

    def _reset(self) -> None:
        self._sums = [self._zero] * (len(CURVES) - 1)
        self._n_ended = self._zero

    def add_step(self, state: State, outcome: Outcome) -> None:
        """Adds a step of every mission, `[N]`."""
        xp = self._xp
        self._return = self._return + outcome.reward
        self._rate_bps = self._rate_bps + outcome.link.sum_rate_bps
        docked = mission.at_dock(state.cell, self._scenario.dock_cell)
        since = xp.where(self._arrival > 0, self._arrival, xp.astype(state.step, self._zero.dtype))
        self._arrival = xp.where(docked, since, self._zero)

    def end_missions(self, ended: Array, state: State, outcome: Outcome) -> None:
        """Adds the missions in `ended`, bool `[N]`, to the episode."""
        xp, dtype = self._xp, self._zero.dtype
        values = [
            state.mission_reward,
            self._return,
            self._rate_bps / xp.astype(state.step, dtype),
            xp.astype(xp.sum(state.collected, axis=-1), dtype),
            xp.astype(outcome.landed, dtype),
            xp.where(outcome.landed, self._arrival, self._zero + self._scenario.mission.max_steps),
        ]
        self._sums = [
            total + xp.where(ended, value, self._zero)
            for total, value in zip(self._sums, values, strict=True)
        ]
        self._n_ended = self._n_ended + xp.astype(ended, dtype)
        self._return, self._rate_bps, self._arrival = (
            xp.where(ended, self._zero, total) for total in (self._return, self._rate_bps, self._arrival)
        )

    def take(self) -> list[np.ndarray]:
        """Ends an episode, and returns its `CURVES` without the loss, numpy `[N]` each."""
        n_ended = _to_numpy(self._n_ended)
        with np.errstate(invalid="ignore"):  # 0 / 0: no mission ended
            means = [_to_numpy(total) / n_ended for total in self._sums]
        self._reset()
        return means

    def state(self) -> dict[str, Array]:
        """Sums of the missions under way."""
        return {"paid": self._return, "rate_bps": self._rate_bps, "arrival": self._arrival}

    def restore(self, state: dict[str, Array]) -> None:
        """Sets what `state` returned."""
        self._return, self._rate_bps, self._arrival = state["paid"], state["rate_bps"], state["arrival"]


def _to_numpy(values: Any) -> np.ndarray:
    return values if isinstance(values, np.ndarray) else values.cpu().numpy()
