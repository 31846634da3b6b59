"""What a ground station shows of a mission: a text for each phase and fault, and values."""

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple, Protocol, runtime_checkable

from uav_dc_ros.messages import Mission, Phase, Rates
from uav_dc_ros.phases import POLICY_CONTROLLED

NAME = "uav_dc"  # at the head of each text: the autopilot's own texts stand beside them


class Severity(IntEnum):
    """Severity of a text, as MAV_SEVERITY: a lower number is more severe."""

    CRITICAL = 2
    WARNING = 4
    NOTICE = 5
    INFO = 6


class StatusText(NamedTuple):
    """A text for the ground station."""

    severity: Severity
    text: str


@runtime_checkable
class GroundStationLink(Protocol):
    """A transport that reaches ground stations, too. It limits the rate of both."""

    def report_text(self, text: StatusText) -> None:
        """Send a text to every ground station."""

    def report_values(self, values: Mapping[str, float]) -> None:
        """Send these values from now on; names have at most ten characters."""


class MissionTexts:
    """Selects the changes of a mission that a ground station shows.

    While the policy flies, `ready` and `moving` are shown once, and then only faults and their ends: the
    values show the progress.
    """

    def __init__(self) -> None:
        self._shown: tuple[Phase, bool, str] | None = None
        self._flown: set[Phase] = set()  # shown since the policy took control

    def update(self, status: Mission, outcome: Phase | None) -> StatusText | None:
        """The text of a new status, if any; `outcome`: final phase of a mission that is landing or over."""
        before, self._shown = self._shown, (status.phase, status.held, status.reason)
        if status.phase not in POLICY_CONTROLLED:
            self._flown.clear()
        elif status.phase in self._flown and not status.held and not (before and before[1]):
            return None
        else:
            self._flown.add(status.phase)
        if self._shown == before:
            return None
        colon = ": " if status.reason else ""
        return StatusText(_severity(status, outcome), f"{NAME} {status.state}{colon}{status.reason}")


def _severity(status: Mission, outcome: Phase | None) -> Severity:
    if outcome is Phase.ABORTED:
        return Severity.CRITICAL
    if status.held or outcome is Phase.TIMEOUT:
        return Severity.WARNING
    quiet = status.phase in (*POLICY_CONTROLLED, Phase.IDLE, Phase.CONNECTING)
    return Severity.INFO if quiet else Severity.NOTICE


def values(rates: Rates) -> dict[str, float]:
    """Values of a step: users collected, and sum-rate in Mbit/s."""
    return {"collected": float(sum(rates.collected)), "rate_mbps": rates.sum_rate_bps / 1e6}
