"""Timeouts of faults, policy and progress, and retries of commands. None of them reads a clock."""

from typing import Literal, NamedTuple

from uav_dc_ros.messages import FaultKind
from uav_dc_ros.offboard.mission.fault_detector import Fault, SafetySettings
from uav_dc_ros.offboard.vehicle import Command, TakeOff

# Pauses between take-off commands. Motors need two seconds to lift the vehicle. ArduPilot disarms a vehicle
# that stands for ten seconds: three commands may be lost before.
TAKEOFF_RETRIES = 1.5
# One loss of telemetry shows as several of these faults, one after the other.
TELEMETRY_FAULTS = {FaultKind.LINK, FaultKind.ESTIMATE, FaultKind.POSITION, FaultKind.CLOCK}


class Instant(NamedTuple):
    """One instant on both clocks, seconds."""

    vehicle_s: float
    steady_s: float


class FaultTimer:
    """Duration of the current fault."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self.fault: Fault | None = None
        self.since = Instant(0.0, 0.0)  # start of the fault
        self._first: Fault | None = None

    @property
    def cause(self) -> Fault | None:
        """The fault with which the vehicle began to hold; others may have replaced it. None: no fault."""
        return None if self.fault is None else self._first

    def update(self, now: Instant, fault: Fault | None) -> Literal["changed", "cleared", "expired"] | None:
        """Note the present fault; returns the change. `expired`: the timeout has passed on either clock.

        A lost link causes the faults that follow it, and stays the current fault until all are cleared.
        """
        before, self.fault = self.fault, fault
        if fault is None:
            return None if before is None else "cleared"
        if before is None:
            self.since, self._first = now, fault
            return "changed"
        if before.kind in (fault.kind, FaultKind.LINK):
            self.fault = fault = before
        if self._first is None or {self._first.kind, fault.kind} <= TELEMETRY_FAULTS:
            self._first = fault
        if max(now.steady_s - self.since.steady_s, now.vehicle_s - self.since.vehicle_s) > self._timeout_s:
            return "expired"
        return None if self.fault is before else "changed"


class PolicyTimeout:
    """Timeout of a policy that publishes no moves, or is lost."""

    def __init__(self, settings: SafetySettings, step_s: float) -> None:
        self.limit_s = settings.policy_timeout_steps * step_s  # vehicle time
        self._min_s = settings.policy_timeout_s  # steady time
        self.lost_since: Instant | None = None  # loss of the policy; None: it is alive

    def has_expired(self, since: Instant, now: Instant) -> bool:
        """Whether the time since an instant exceeds both limits."""
        return now.vehicle_s - since.vehicle_s > self.limit_s and now.steady_s - since.steady_s > self._min_s


class CommandRetry:
    """Send times of the commands of one phase, for repetitions of those that are not executed.

    It counts vehicle time, and steady time while the vehicle's time does not advance: a command may be lost
    while little more than heartbeats arrives, too.
    """

    def __init__(self, settings: SafetySettings) -> None:
        self._settings = settings
        self._time_s = 0.0
        self._now: Instant | None = None
        self._sent_s: dict[Command, float] = {}

    def reset(self) -> None:
        """Start another phase."""
        self._sent_s.clear()

    def update(self, now: Instant, *, clock_stopped: bool) -> None:
        """Advance to an instant; `clock_stopped`: see `FaultDetector`."""
        if self._now is not None:
            vehicle_s = max(0.0, now.vehicle_s - self._now.vehicle_s)
            self._time_s += now.steady_s - self._now.steady_s if clock_stopped else vehicle_s
        self._now = now

    def waited_s(self, command: Command) -> float | None:
        """Time since a command was sent last; None: it was not sent."""
        sent_s = self._sent_s.get(command)
        return None if sent_s is None else self._time_s - sent_s

    def may_send(self, command: Command) -> bool:
        """Whether to send a command now; if so, it counts as sent."""
        waited_s = self.waited_s(command)
        pause_s = self._settings.command_retry_s * (TAKEOFF_RETRIES if isinstance(command, TakeOff) else 1.0)
        if waited_s is not None and waited_s < pause_s:
            return False
        self._sent_s[command] = self._time_s
        return True


class ProgressTimer:
    """Time since a distance last reached a new minimum, lower by `min_decrease_m` than the one before."""

    def __init__(self, min_decrease_m: float) -> None:
        self._min_decrease_m = min_decrease_m
        self.reset()

    def reset(self) -> None:
        """Start with the next distance."""
        self._min_m: float | None = None
        self._since_s = self._updated_s = 0.0
        self._paused = False

    def pause(self) -> None:
        """Do not count the time until the next update."""
        self._paused = True

    def update(self, distance_m: float, vehicle_s: float) -> float:
        """Time without progress, seconds of vehicle time."""
        if self._paused:
            self._since_s += vehicle_s - self._updated_s
        if self._min_m is None or distance_m <= self._min_m - self._min_decrease_m:
            self._min_m, self._since_s = distance_m, vehicle_s
        self._updated_s, self._paused = vehicle_s, False
        return vehicle_s - self._since_s
