"""Collects the messages of one step."""

from typing import Any

from uav_dc_ros.messages import Stepped

WAITING_MAX = 1000  # incomplete steps; older ones are dropped


class StepSynchronizer:
    """Collects one payload of each kind for a step, which arrive in any order."""

    def __init__(self, *kinds: type[Stepped]) -> None:
        self._waiting: dict[type[Stepped], dict[tuple[str, int, int], Any]] = {kind: {} for kind in kinds}

    def add(self, payload: Stepped) -> tuple[Any, ...] | None:
        """Add a payload; returns those of its step, in the order of the kinds, once all are there."""
        step = (payload.run, payload.mission, payload.step)
        own = self._waiting[type(payload)]
        own[step] = payload
        if len(own) > WAITING_MAX:
            del own[next(iter(own))]
        if not all(step in waiting for waiting in self._waiting.values()):
            return None
        return tuple(waiting.pop(step) for waiting in self._waiting.values())
