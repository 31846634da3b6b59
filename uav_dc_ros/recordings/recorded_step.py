"""Steps of a recorded mission: the messages that a bag holds of each, and the totals of all."""

import math
from bisect import insort
from dataclasses import dataclass, field
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple

import msgspec
import numpy as np

from uav_dc_ros import messages, payloads
from uav_dc_ros.core import energy
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.reward import RewardData, mission_reward
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users.service import FIGURES, ServiceRecord
from uav_dc_ros.messages import FaultKind, Mission, Phase, Rates
from uav_dc_ros.phases import BEFORE_START

STEP_POSES_MAX = 64
UNFINISHED = "unfinished"  # outcome of a mission whose end is not in the bag
PHASE_REPORTS_MAX = 1000  # of a step: a vehicle that waits for hours reports again and again


class RecordedPose(NamedTuple):
    """A pose: x, y, altitude in metres `[3]`; `order`: index of its message among all received ones."""

    stamp_ns: int
    position_m: Array
    log_ns: int
    publish_ns: int
    order: int = 0


class PhaseReport(NamedTuple):
    """Phase and reason as the vehicle reported them, with log and publish times (ns)."""

    phase: Phase
    reason: str
    held: bool
    fault: FaultKind | None
    log_ns: int
    publish_ns: int
    clock_resets: int = 0  # of the recorder's clock until then: times compare only between equal values


@dataclass(kw_only=True)
class RecordedStep:
    """One step of a mission; None for what the bag does not hold.

    Of repeated payloads the first counts. Of several statuses the end of the mission counts most, then the
    first with phase `ready`, then the newest.
    """

    flight: int  # counts the runs in a bag from 0
    mission: int  # index in the flight
    step: int  # steps flown
    position_m: Array | None = None  # first pose of the step's own time: x, y, altitude, `[3]`
    users: messages.Users | None = None
    rates: messages.Rates | None = None
    status: messages.Mission | None = None
    move: messages.Move | None = None
    phase_reports: list[PhaseReport] = field(default_factory=list)  # by publish time
    n_dropped_reports: int = 0  # beyond `PHASE_REPORTS_MAX`, from the middle
    order: int = 0  # index of the latest message among all received ones
    clock_resets: int = 0  # times that the clock had been set back when the users were received
    log_ns: dict[str, int] = field(default_factory=dict)  # log times since the epoch, by topic
    publish_ns: dict[str, int] = field(default_factory=dict)  # publish times likewise
    poses: list[RecordedPose] = field(default_factory=list)  # of the step's own time, by stamp
    # First differing repetition of a payload, by topic. Users that differ in time only count least.
    conflicts: dict[str, messages.Stepped] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Mission, step and flight as text."""
        return f"mission {self.mission}, step {self.step}{_of_flight(self.flight)}"

    @property
    def is_measured(self) -> bool:
        """Whether users and rates are expected: the vehicle has reached the start of the step.

        They are not before takeoff, nor where a restarted bridge resumes a mission.
        """
        reports = self.phase_reports
        if not reports or any(report.phase is Phase.READY for report in reports):
            return True
        return self.step > 0 and reports[0].phase not in BEFORE_START

    def follows(self, before: "RecordedStep | None") -> bool:
        """Whether `before` is the previous step of the same mission."""
        key = self.flight, self.mission, self.step - 1
        return before is not None and (before.flight, before.mission, before.step) == key

    def observed(self, scenario: Scenario) -> dict[str, Array] | None:
        """Arguments of `observations.encode`, or None without status or rates; may raise MessageError."""
        if self.status is None or self.rates is None:
            return None
        payloads.check(self.status, scenario)
        data_bits, collected = payloads.collection(self.rates, scenario)
        cell, left = np.asarray(self.status.cell), self.status.remaining_steps
        step = np.asarray(scenario.mission.max_steps - left)
        observed = {"cell": cell, "step": step, "data_bits": data_bits, "collected": collected}
        delivered_bits = payloads.delivered_bits(self.rates, scenario)
        return observed | {
            "delivered_bits": delivered_bits,
            "energy_used_j": payloads.energy_used_j(self.status),
        }

    @property
    def phase_changes(self) -> list[PhaseReport]:
        """The first report of each phase."""
        return [next(reports) for _, reports in groupby(self.phase_reports, attrgetter("phase"))]

    def add_report(self, status: Mission, log_ns: int, publish_ns: int, clock_resets: int = 0) -> bool:
        """Add the phase of a status; False if it repeats an earlier report."""
        # A vehicle that gives reasons may enter a phase twice. One that gives none repeats itself.
        state = status.phase, status.reason, status.held, status.fault
        for known in self.phase_reports:
            repeats = publish_ns == known.publish_ns or not status.reason or known is self.phase_reports[-1]
            if repeats and state == known[:4]:
                return False
        report = PhaseReport(*state, log_ns, publish_ns, clock_resets)
        insort(self.phase_reports, report, key=attrgetter("clock_resets", "publish_ns"))
        if len(self.phase_reports) > PHASE_REPORTS_MAX:
            del self.phase_reports[PHASE_REPORTS_MAX // 2]
            self.n_dropped_reports += 1
        return True


@dataclass(kw_only=True)
class MissionTotals:
    """Result of a mission; None where no rates, or no status, are recorded."""

    steps: int = 0  # flown
    outcome: str = UNFINISHED  # or landed, timeout, aborted
    reason: str = ""  # of the last phase; empty in simulation
    steps_not_reached: int = 0  # flown steps whose cell a real vehicle did not reach
    collected: int | None = None  # users collected at the last rates
    users: int | None = None  # all users
    data_bits: float | None = None  # from all users at the last rates
    reward: float | None = None  # of the mission, see `core.reward.mission_reward`
    n_rewards: int = 0  # steps with a known r^t: the end is the last of them, and the mean is over them
    energy_used_j: float | None = None  # at the last status; None in a scenario without a battery, too
    seed: int | None = None
    scenario: str | None = None
    fingerprint: str | None = None

    def __post_init__(self) -> None:
        """Attributes that are no fields: JSON does not hold them. Before the first rates they are unknown."""
        self._service: ServiceRecord | None = None  # of the steps with rates
        self._user_bits: Array | None = None  # data at the last rates, `[U]`

    @property
    def is_over(self) -> bool:
        """Whether the bag holds the end of the mission."""
        return self.outcome != UNFINISHED

    @property
    def energy_per_mbit_j(self) -> float | None:
        """Energy for each megabit collected, joules; None where unknown, or nothing was collected."""
        if self.energy_used_j is None or not self.data_bits:
            return None
        return float(energy.per_mbit_j(np.asarray(self.energy_used_j), np.asarray(self.data_bits)))

    def service_figures(self, scenario: Scenario) -> dict[str, Any]:
        """The `FIGURES` of `core.users.service`, as plain numbers; None where unknown."""
        if self._service is None or self._user_bits is None:
            return dict.fromkeys(FIGURES)
        found = self._service.figures(scenario, self._user_bits)
        known = {name: None if math.isnan(value) else float(value) for name, value in found.items()}
        last = known["last_collected_step"]
        return known | {"last_collected_step": None if last is None else int(last)}

    def add_reward(self, total: float, data: RewardData) -> None:
        """Add the r^t of the next step that has one."""
        self.n_rewards += 1
        self.reward = mission_reward(self.reward or 0.0, total, self.n_rewards, data)

    def add(self, step: int, status: Mission | None, rates: Rates | None) -> None:
        """Add the next step."""
        self.steps = max(self.steps, step)
        if rates is not None:
            self.collected, self.users = sum(rates.collected), len(rates.collected)
            self.data_bits = float(np.sum(rates.data_bits))
            self._user_bits = np.asarray(rates.data_bits, np.float64)
            if self._service is None:
                self._service = ServiceRecord(np.zeros(self.users))
            if step:  # step 0 is the start
                self._service.add(np.asarray(step), np.asarray(rates.served), np.asarray(rates.collected))
        if status is not None:
            self.seed, self.scenario, self.fingerprint = status.seed, status.scenario, status.fingerprint
            self.reason, self.steps_not_reached = status.reason, status.steps_not_reached
            self.energy_used_j = None if status.energy_used_j is msgspec.UNSET else status.energy_used_j
            if status.phase.is_over:
                self.outcome = status.phase.value


def mission_name(mission: int, flight: int) -> str:
    """Mission and flight as text."""
    return f"mission {mission}{_of_flight(flight)}"


def _of_flight(flight: int) -> str:
    return f" of flight {flight}" if flight else ""


def with_progress_of(status: Mission, other: Mission) -> Mission:
    """A status with the fields of another one that may change during a step."""
    changing = ("phase", "reason", "held", "fault", "steps_not_reached")
    return msgspec.structs.replace(status, **{name: getattr(other, name) for name in changing})


def differ_in_time_only(one: messages.Stepped, other: messages.Stepped) -> bool:
    """Whether both are the same users at different times: a vehicle was ready for the same step again."""
    if not isinstance(one, messages.Users) or not isinstance(other, messages.Users):
        return False
    return msgspec.structs.replace(one, stamp_ns=other.stamp_ns) == other


def supersedes(status: Mission, before: Mission, newer: bool) -> bool:
    """Whether a status replaces another of its step: see `RecordedStep`; of several ends the last counts."""
    ranks = _rank(status), _rank(before)
    return ranks[0] > ranks[1] or (newer and ranks in ((0, 0), (2, 2)))


def _rank(status: Mission) -> int:
    return 2 if status.phase.is_over else int(status.phase is Phase.READY)
