"""How users were served in the missions of a bag, by its recorded rates."""

from typing import Any

import numpy as np

from uav_dc_ros import payloads
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users.service import FIGURES
from uav_dc_ros.errors import MessageError
from uav_dc_ros.recordings.recorded_step import MissionTotals, RecordedStep

_DIGITS = dict(zip(FIGURES, (1, 3, 1), strict=True))


class ServiceSummary:
    """The figures of `core.users.service`, as means over the missions."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._totals = MissionTotals()
        self._missions: list[dict[str, Any]] = []

    def add(self, step: RecordedStep) -> None:
        """Add a step of the mission; rates of another world are left out."""
        if step.rates is None:
            return
        try:
            payloads.check(step.rates, self._scenario)
        except MessageError:
            return
        self._totals.add(step.step, None, step.rates)

    def end_mission(self) -> None:
        """Add the mission after its last step."""
        self._missions.append(self._totals.service_figures(self._scenario))
        self._totals = MissionTotals()

    def means(self) -> dict[str, float | None]:
        """The figures; None where no mission has one."""
        known = {name: [one[name] for one in self._missions if one[name] is not None] for name in FIGURES}
        return {name: float(np.mean(values)) if values else None for name, values in known.items()}

    def lines(self) -> list[str]:
        """The figures as text; nothing where none is known."""
        age_s, fairness, last = (
            "-" if mean is None else f"{mean:.{_DIGITS[name]}f}" for name, mean in self.means().items()
        )
        if age_s == "-":
            return []
        n = len(self._missions)
        return [
            f"users: age of information {age_s} s, fairness {fairness}, last user collected at step {last}"
            + (f" (means of {n} missions)" if n > 1 else "")
        ]
