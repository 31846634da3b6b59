"""Result of a recorded mission, in numbers, for info, export and report."""

from dataclasses import dataclass

import numpy as np

from uav_dc_ros.messages import Mission, Rates

UNFINISHED = "unfinished"  # outcome of a mission whose end is not in the bag


@dataclass(kw_only=True)
class MissionTotals:
    """Result of a mission.

    Attributes:
        steps: steps flown.
        outcome: `landed`, `timeout`, `aborted`, or `unfinished`.
        reason: reason of the last phase; empty in simulation.
        steps_not_reached: steps flown whose cell a real vehicle did not reach, as it reports.
        collected, users: users collected at the last rates, and all users; None without rates.
        data_bits: data collected from all users at the last rates, bit; None without rates.
        seed, scenario, fingerprint: as the vehicle reports; None without a status.
    """

    steps: int = 0
    outcome: str = UNFINISHED
    reason: str = ""
    steps_not_reached: int = 0
    collected: int | None = None
    users: int | None = None
    data_bits: float | None = None
    seed: int | None = None
    scenario: str | None = None
    fingerprint: str | None = None

    @property
    def is_over(self) -> bool:
        """Whether the bag holds the end of the mission."""
        return self.outcome != UNFINISHED

    def add(self, step: int, status: Mission | None, rates: Rates | None) -> None:
        """Add the next step."""
        self.steps = max(self.steps, step)
        if rates is not None:
            self.collected, self.users = sum(rates.collected), len(rates.collected)
            self.data_bits = float(np.sum(rates.data_bits))
        if status is not None:
            self.seed, self.scenario, self.fingerprint = status.seed, status.scenario, status.fingerprint
            self.reason, self.steps_not_reached = status.reason, status.steps_not_reached
            if status.phase.is_over:
                self.outcome = status.phase.value
