"""What belongs to one step, brought together."""

from typing import TypeVar

from uav_dc_ros.messages import Mission, Rates

V = TypeVar("V", Mission, Rates)

WAITING_MAX = 1000  # steps of which one half was heard: more are rubbish, or long past


class StepSynchronizer:
    """Brings together the `mission` and the `rates` of a step, which arrive in any order."""

    def __init__(self) -> None:
        self._missions: dict[tuple[str, int, int], Mission] = {}
        self._rates: dict[tuple[str, int, int], Rates] = {}

    def add(self, payload: Mission | Rates) -> tuple[Mission, Rates] | None:
        """Add one half; both, once the other half of its step is there."""
        step = (payload.run, payload.mission, payload.step)
        if isinstance(payload, Mission):
            _keep(self._missions, step, payload)
        else:
            _keep(self._rates, step, payload)
        if step not in self._missions or step not in self._rates:
            return None
        return self._missions.pop(step), self._rates.pop(step)


def _keep(waiting: dict[tuple[str, int, int], V], step: tuple[str, int, int], payload: V) -> None:
    waiting[step] = payload
    if len(waiting) > WAITING_MAX:
        del waiting[next(iter(waiting))]
