"""When a wish may be uttered again that was not fulfilled."""

from uav_dc_ros.autopilot.vehicle import TakeOff, Wish
from uav_dc_ros.autopilot.watch import Settings

# As many pauses between wishes to take off. Motors need two seconds to lift the vehicle. ArduPilot disarms it
# when it stands for ten seconds: within these, three wishes may be lost.
TAKEOFF_RETRIES = 1.5


class Asked:
    """The wishes of one phase.

    Args:
        settings: how long to wait for an answer.

    Attributes:
        last_s: when each was uttered last, vehicle time.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.last_s: dict[Wish, float] = {}

    def begin(self) -> None:
        """Forget what was asked for in another phase."""
        self.last_s.clear()

    def may(self, wish: Wish, vehicle_s: float) -> bool:
        """Utter a wish now: the first time, or long enough after the last; if so, it is."""
        last_s = self.last_s.get(wish)
        pause_s = self._settings.retry_s * (TAKEOFF_RETRIES if isinstance(wish, TakeOff) else 1.0)
        if last_s is not None and vehicle_s - last_s < pause_s:
            return False
        self.last_s[wish] = vehicle_s
        return True
