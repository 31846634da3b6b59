"""The books of missions flown while learning; kept where the worlds are, so that no device is waited for."""

from typing import Any

import numpy as np

from uav_dc_ros.core import mission
from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Outcome, State

# Figures of an episode: means over the missions that ended in it, exploration included; NaN where none did.
#   reward           r^t at the end of a mission (eq. 7)
#   episode_return   sum of what the agent was paid
#   throughput_bps   sum-rate of the served users, mean over the steps, bit/s
#   users_collected  users collected
#   landing_rate     share of missions that landed
#   arrival_step     step after which the UAV stayed over the dock; T_cons when it did not land
# and one of the learner, which a training adds:
#   loss             squared TD error, mean over the iterations
CURVES = (
    "reward",
    "episode_return",
    "throughput_bps",
    "users_collected",
    "landing_rate",
    "arrival_step",
    "loss",
)
_N_FIGURES = len(CURVES) - 1


class EpisodeStats:
    """Sums over the steps of each mission, and over the missions of an episode."""

    def __init__(self, scenario: Scenario, like: Array) -> None:
        """Empty books for worlds whose numbers look `like`, floating point `[N]`."""
        self._scenario = scenario
        self._xp = array_namespace(like)
        self._zero = self._xp.zeros_like(like)
        self._paid = self._rate_bps = self._arrival = self._zero
        self._forget()

    def _forget(self) -> None:
        self._sums = [self._zero] * _N_FIGURES
        self._n_ended = self._zero

    def add(self, state: State, outcome: Outcome) -> None:
        """Books a step of every mission, `[N]`."""
        xp = self._xp
        self._paid = self._paid + outcome.reward
        self._rate_bps = self._rate_bps + outcome.link.sum_rate_bps
        docked = mission.at_dock(state.cell, self._scenario.dock_cell)
        since = xp.where(self._arrival > 0, self._arrival, xp.astype(state.step, self._zero.dtype))
        self._arrival = xp.where(docked, since, self._zero)

    def close(self, over: Array, state: State, outcome: Outcome) -> None:
        """Books the missions in `over`, bool `[N]`, as ended."""
        xp, dtype = self._xp, self._zero.dtype
        figures = [
            state.total_reward,
            self._paid,
            self._rate_bps / xp.astype(state.step, dtype),
            xp.astype(xp.sum(state.collected, axis=-1), dtype),
            xp.astype(outcome.landed, dtype),
            xp.where(outcome.landed, self._arrival, self._zero + self._scenario.mission.max_steps),
        ]
        ended = [xp.where(over, figure, self._zero) for figure in figures]
        self._sums = [total + figure for total, figure in zip(self._sums, ended, strict=True)]
        self._n_ended = self._n_ended + xp.astype(over, dtype)
        books = (self._paid, self._rate_bps, self._arrival)
        self._paid, self._rate_bps, self._arrival = (xp.where(over, self._zero, book) for book in books)

    def take(self) -> list[np.ndarray]:
        """Closes an episode: all of `CURVES` but the loss, numpy `[N]` each."""
        n_ended = _on_host(self._n_ended)
        with np.errstate(invalid="ignore"):  # 0 / 0: no mission ended
            means = [_on_host(total) / n_ended for total in self._sums]
        self._forget()
        return means

    def state(self) -> dict[str, Array]:
        """What an episode hands to the next: the books of missions that have not ended."""
        return {"paid": self._paid, "rate_bps": self._rate_bps, "arrival": self._arrival}

    def restore(self, state: dict[str, Array]) -> None:
        """Becomes what gave `state`."""
        self._paid, self._rate_bps, self._arrival = state["paid"], state["rate_bps"], state["arrival"]


def _on_host(values: Any) -> np.ndarray:
    return values if isinstance(values, np.ndarray) else values.cpu().numpy()
