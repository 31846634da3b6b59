"""Pairs the messages of one step."""

from uav_dc_ros.messages import Mission, Rates

WAITING_MAX = 1000  # unpaired steps; older ones are dropped


class StepSynchronizer:
    """Pairs the `mission` and the `rates` of a step, which arrive in any order."""

    def __init__(self) -> None:
        self._missions: dict[tuple[str, int, int], Mission] = {}
        self._rates: dict[tuple[str, int, int], Rates] = {}

    def add(self, payload: Mission | Rates) -> tuple[Mission, Rates] | None:
        """Add a payload; returns the pair of its step once both are there."""
        step = (payload.run, payload.mission, payload.step)
        if isinstance(payload, Mission):
            self._missions[step] = payload
        else:
            self._rates[step] = payload
        for waiting in (self._missions, self._rates):
            if len(waiting) > WAITING_MAX:
                del waiting[next(iter(waiting))]
        if step not in self._missions or step not in self._rates:
            return None
        return self._missions.pop(step), self._rates.pop(step)
