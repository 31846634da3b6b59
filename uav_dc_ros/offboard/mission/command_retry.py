"""When a command may be sent again that was not executed."""

from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Command, TakeOff

# As many pauses between commands to take off. Motors need two seconds to lift the vehicle. ArduPilot disarms
# it when it stands for ten seconds: within these, three commands may be lost.
TAKEOFF_RETRIES = 1.5


class CommandRetry:
    """The commands of one phase.

    Args:
        settings: how long to wait for an answer.

    The time is the vehicle's; where that stands still, as it does when little more than heartbeats comes,
    the clock's: a request may be lost then, too.
    """

    def __init__(self, settings: SafetySettings) -> None:
        self._settings = settings
        self._time_s = 0.0
        self._seen_s: tuple[float, float] | None = None  # vehicle time and steady clock, at the last look
        self._last_s: dict[Command, float] = {}  # when each was sent last

    def begin(self) -> None:
        """Forget what was asked for in another phase."""
        self._last_s.clear()

    def pass_time(self, vehicle_s: float, now_s: float, *, stands: bool) -> None:
        """Let time go on, at each look.

        Args:
            vehicle_s: the vehicle's.
            now_s: steady clock.
            stands: does the vehicle's stand still?
        """
        if self._seen_s is not None:
            before_vehicle_s, before_s = self._seen_s
            self._time_s += now_s - before_s if stands else max(0.0, vehicle_s - before_vehicle_s)
        self._seen_s = vehicle_s, now_s

    def waited_s(self, command: Command) -> float | None:
        """For how long an answer was waited for; None: it was not sent."""
        last_s = self._last_s.get(command)
        return None if last_s is None else self._time_s - last_s

    def may(self, command: Command) -> bool:
        """Utter a command now: the first time, or long enough after the last; if so, it is."""
        waited_s = self.waited_s(command)
        pause_s = self._settings.command_retry_s * (TAKEOFF_RETRIES if isinstance(command, TakeOff) else 1.0)
        if waited_s is not None and waited_s < pause_s:
            return False
        self._last_s[command] = self._time_s
        return True
