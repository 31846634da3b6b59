"""The missions of a bag as page data: totals of each mission, and its steps.

The steps of a long mission are thinned while they are read. Totals (data, distance, rates) are of all steps.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np
from msgspec import UNSET

from uav_dc_ros import payloads
from uav_dc_ros.core import mission, radio, reward, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Mission, Rates, Users
from uav_dc_ros.recordings.pages.vehicle import VehiclePath, VehicleTimeline
from uav_dc_ros.recordings.recorded_step import MissionTotals, RecordedStep
from uav_dc_ros.recordings.thinning import EveryNth, spread

STEPS_MAX = 400  # shown of a mission: the resolution of a slider
VALUES_MAX = 60_000  # steps times users: the capacity of a page
USERS_MAX = 2_000  # shown
BATTERY = ("energy_used_j", "energy_per_mbit_j")  # in summaries of a scenario with a battery
WAITING, SERVED, COLLECTED = "012"  # state of a user in the page data


class MissionData:
    """A mission as page data; `real`: whether a real vehicle flew it."""

    def __init__(self, scenario: Scenario, flight: int, index: int, real: bool) -> None:
        n_users = scenario.n_users
        self.scenario = scenario
        self.flight, self.index = flight, index
        self.totals = MissionTotals()
        self.timeline = VehicleTimeline(scenario) if real else None
        self.faults: Counter[str] = Counter()  # missing or contradictory messages, by text
        self.last_ns = 0  # log time of the latest message
        self._data_bits: Array = np.zeros(n_users)
        self._counted_bits: Array = np.zeros(n_users)  # R in r^t (eq. 7); NaN where unknown
        self._collected: Array = np.zeros(n_users, dtype=bool)
        self._distance_m = 0.0  # length of the path flown
        self._shown = spread(n_users, USERS_MAX)
        max_kept = max(min(STEPS_MAX, VALUES_MAX // len(self._shown)), 20)
        self._steps: EveryNth[dict[str, Any]] = EveryNth(max_kept)
        self._last: dict[str, Any] | None = None  # the newest step, kept or not
        self._position_m: Array | None = None
        self._cell: Array | None = None
        self._charge: float | None = None  # state of charge; None: unknown, or no battery in the scenario
        self._next_step = 0
        self._sum_rates_bps: list[float] = [0.0, 0.0]  # sum over the steps, and their number
        self._served_steps: Array = np.zeros(n_users, dtype=np.int64)
        self._served_sums: Array = np.zeros((2, n_users))  # of SINR (linear) and rate (bit/s) while served
        self._collected_at: Array = np.full(n_users, -1, dtype=np.int64)

    def add(self, step: RecordedStep) -> None:
        """Add the next step. Payloads of another world are counted and left out."""
        if step.step > self._next_step:
            self.faults["steps that are not in the bag"] += step.step - self._next_step
        self._next_step = step.step + 1
        self.last_ns = max(step.log_ns.values(), default=self.last_ns)
        if self.timeline is not None:
            self.timeline.add(step)
        status, rates, users = map(self._checked, (step.status, step.rates, step.users))
        if status is None:
            self.faults["steps without mission"] += 1
        else:
            self._cell = np.asarray(status.cell)
        if step.is_measured:
            for name, value in {"users": users, "rates": rates, "pose": step.position_m}.items():
                if value is None:
                    self.faults[f"steps without {name}"] += 1
        self.totals.add(step.step, status, rates)
        if rates is not None:
            self._add_rates(step.step, rates)
        elif self.scenario.reward.data == "step":
            self._counted_bits = np.full_like(self._counted_bits, math.nan)
        if step.step and not math.isnan(total := self._rewards()[2]):
            self.totals.add_reward(total, self.scenario.reward.data)
        if status is not None and status.state_of_charge is not UNSET:
            self._charge = status.state_of_charge
        self._keep(step, self._move(step.position_m, status if step.is_measured else None), users, rates)

    @property
    def reason(self) -> str:
        """Reason of the end; empty in simulation."""
        return self.totals.reason if self.totals.is_over else ""

    def summary(self) -> dict[str, Any]:
        """The mission in numbers, with the keys of run_all's `--summary`."""
        (total, n), totals = self._sum_rates_bps, self.totals
        return {
            **({"reason": self.reason} if self.reason else {}),
            **({"steps_not_reached": totals.steps_not_reached} if totals.steps_not_reached else {}),
            "flight": self.flight,
            "mission": self.index,
            "seed": totals.seed,
            "outcome": totals.outcome,
            "steps": totals.steps,
            "users_collected": int(self._collected.sum()),
            "users_total": self.scenario.n_users,
            "data_bits": float(self._data_bits.sum()),
            "sum_rate_bps": total / max(n, 1),
            "distance_m": self._distance_m,
            "reward": (math.nan if totals.steps else 0.0) if totals.reward is None else totals.reward,
            "reward_data": self.scenario.reward.data,
            **totals.service_figures(self.scenario),
            **({name: getattr(totals, name) for name in BATTERY} if self.scenario.energy else {}),
        }

    def _rewards(self) -> tuple[float, float, float]:
        """The data and trajectory terms of r^t (eq. 7), and r^t; NaN where unknown."""
        if self._cell is None:
            return math.nan, math.nan, math.nan
        weights, data_bits = self.scenario.reward, self._counted_bits
        distance = mission.dock_distance_cells(self._cell, self.scenario.dock_cell, like=data_bits)
        trajectory = weights.zeta * reward.r_plus(distance, weights.r_plus)
        of_users = self.scenario.user_weights(data_bits)
        data = reward.total(
            data_bits, np.zeros(()), weights.beta, weights.zeta, weights.data_scale_bits, of_users
        )
        return float(data), float(trajectory), float(world.total_reward(self.scenario, self._cell, data_bits))

    def steps(self) -> list[dict[str, Any]]:
        """The steps shown, in order; the last one is always among them."""
        kept = self._steps.kept
        return kept if self._last is None or self._last is kept[-1] else [*kept, self._last]

    def data(self, path: VehiclePath | None) -> dict[str, Any]:
        """Page data, with the timeline of a real vehicle."""
        data = {"stride": self._steps.stride, "steps": self.steps(), "table": self._table()}
        return data if path is None or not self.timeline else data | {"timeline": self.timeline.data(path)}

    def _table(self) -> dict[str, list[Any]]:
        """Columns, an entry per user shown; SINR and rate are means over the steps in which it was served."""
        shown = self._shown
        served = self._served_steps[shown]
        sinr, rate_bps = (sums[shown] / np.maximum(served, 1) for sums in self._served_sums)
        with np.errstate(divide="ignore"):
            sinr_db = np.where(served > 0, 10 * np.log10(sinr), math.nan)
        return {
            "user": shown.tolist(),
            **({"name": [names[i] for i in shown]} if (names := self.scenario.users.names) else {}),
            "cluster": self.scenario.user_cluster[shown].tolist(),
            "data_bits": self._data_bits[shown].tolist(),
            "collected_at": [step if step >= 0 else None for step in self._collected_at[shown].tolist()],
            "served_steps": served.tolist(),
            "sinr_db": _finite(np.round(sinr_db, 2)),
            "rate_bps": _finite(np.where(served > 0, rate_bps, math.nan)),
        }

    def _checked(self, payload: Any) -> Any:
        try:
            payloads.check(payload, self.scenario)
        except MessageError as error:
            kind = type(payload).__name__.lower()
            self.faults[f"{kind} messages of another world ({error.reason})"] += 1
            return None
        return payload

    def _add_rates(self, step: int, rates: Rates) -> None:
        data_bits, collected = payloads.collection(rates, self.scenario)
        if (data_bits < self._data_bits).any() or (self._collected & ~collected).any():
            self.faults["steps with less collected data than before"] += 1
        self._collected_at[collected & (self._collected_at < 0)] = step
        self._data_bits, self._collected = data_bits, collected
        if step == 0:
            return  # nothing is collected before the first move
        self._counted_bits = payloads.counted_data(rates, self.scenario)
        self._sum_rates_bps[0] += rates.sum_rate_bps
        self._sum_rates_bps[1] += 1
        served = np.asarray(rates.served, dtype=bool)
        self._served_steps += served
        self._served_sums += served * np.asarray([rates.sinr, rates.rate_bps])

    def _move(self, position_m: Array | None, status: Mission | None) -> Array | None:
        """Position of the UAV: its pose, or else the centre of its cell; metres `[3]`, or None."""
        if position_m is None and status is not None:
            position_m = self.scenario.grid.centre_m(np.asarray(status.cell), like=np.zeros(1))
        if position_m is not None:
            if self._position_m is not None:
                self._distance_m += math.dist(position_m, self._position_m)
            self._position_m = position_m
        return position_m

    def _keep(
        self, step: RecordedStep, position_m: Array | None, users: Users | None, rates: Rates | None
    ) -> None:
        shown = self._shown
        served = np.asarray(rates.served, dtype=bool) if rates else np.zeros(len(self._collected), dtype=bool)
        state = np.where(self._collected, COLLECTED, np.where(served, SERVED, WAITING))[shown]
        reach_m = 0.0
        if position_m is not None:
            reach_m = radio.ground_reach_m(self.scenario.mission.d_cons_m, max(float(position_m[2]), 0.0))
        users_m = None if users is None else np.asarray([users.x_m, users.y_m])[:, shown]
        self._last = {
            "step": step.step,
            "uav_m": None if position_m is None else np.round(position_m, 2).tolist(),
            "reach_m": round(reach_m, 1),
            "action": step.move.action if step.move else None,
            "users_m": None if users_m is None else np.round(users_m, 1).tolist(),
            "data_bits": None if rates is None else significant(self._data_bits[shown]),
            "state": "".join(state.tolist()),
            "n_collected": int(self._collected.sum()),
            "sum_rate_bps": rates.sum_rate_bps if rates and step.step else None,
            "reward": _finite(np.asarray(self._rewards())),
            **({"state_of_charge": self._charge} if self.scenario.energy else {}),
        }
        self._steps.add(step.step, self._last)


def read_missions(steps: Iterable[RecordedStep], scenario: Scenario, real: bool) -> Iterator[MissionData]:
    """The missions of a bag one by one, with only the steps shown in memory."""
    for (flight, index), mission_steps in groupby(steps, attrgetter("flight", "mission")):
        data = MissionData(scenario, flight, index, real)
        for step in mission_steps:
            data.add(step)
        yield data


def significant(values: Array) -> list[float]:
    """Values rounded to four significant digits."""
    values = np.asarray(values, np.float64)
    with np.errstate(divide="ignore"):
        magnitude = np.where(values == 0, 0, np.floor(np.log10(np.abs(values))))
    scale = 10.0 ** (3 - magnitude)
    rounded: list[float] = (np.round(values * scale) / scale).tolist()
    return rounded


def _finite(values: Array) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]
