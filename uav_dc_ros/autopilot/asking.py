"""When to utter a wish: at once, and again after a pause while it is not fulfilled."""

from uav_dc_ros.autopilot.vehicle import TakeOff, Wish

TAKEOFF_PAUSES = 2.5  # as long a pause after a wish to take off: motors need seconds to lift a vehicle


class Asking:
    """Keeps when wishes were uttered, in vehicle time.

    Args:
        retry_s: the pause, vehicle time.
    """

    def __init__(self, retry_s: float) -> None:
        self.retry_s = retry_s
        self.asked_s: dict[Wish, float] = {}

    def may(self, wish: Wish, vehicle_s: float) -> bool:
        """Utter it now; keeps that it was."""
        pause_s = self.retry_s * (TAKEOFF_PAUSES if isinstance(wish, TakeOff) else 1.0)
        last_s = self.asked_s.get(wish)
        if last_s is not None and vehicle_s - last_s < pause_s:
            return False
        self.asked_s[wish] = vehicle_s
        return True
