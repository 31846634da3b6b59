"""Send times of heartbeats and setpoints, the same for every transport; streaming with real-time priority.

A simulated vehicle's time may run faster than the steady clock, and its failsafes count vehicle time:
heartbeats and setpoints follow the faster of the two.
"""

import math
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

STREAM_S = 0.05  # steady clock
STREAM_VEHICLE_S = 0.2  # vehicle time; PX4 requires more than 2 Hz of it
HEARTBEAT_S = 1.0  # of either time
MIN_HEARTBEAT_S = 0.02  # steady clock
STREAM_TIMEOUT_S = 1.0  # age of the last decision at which the stream ends

Target = TypeVar("Target")


def next_due_s(due_s: float, period_s: float, now_s: float) -> float:
    """Next send time of a periodic message; missed periods are skipped."""
    return due_s + period_s if now_s < due_s + period_s else now_s + period_s


def use_realtime_priority() -> bool:
    """Set the calling thread to SCHED_RR at the lowest real-time priority; whether the system permits it.

    On a busy computer an ordinary thread runs tens of milliseconds late. The permission is CAP_SYS_NICE or
    RLIMIT_RTPRIO of 1 or more (systemd: `LimitRTPRIO=1`). Child threads and processes have normal priority.
    """
    if sys.platform != "linux":
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except OSError:
        return False
    return True


class Heartbeat:
    """Send times of heartbeats: at once on a new link, then every second of either clock."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Start on a new link."""
        self._due_s = self._sent_s = self._sent_vehicle_s = -math.inf

    def is_due(self, now_s: float, vehicle_s: float) -> bool:
        """Whether a heartbeat is due at a steady time and a vehicle time."""
        ahead = vehicle_s - self._sent_vehicle_s >= HEARTBEAT_S
        return now_s >= self._due_s or (ahead and now_s - self._sent_s >= MIN_HEARTBEAT_S)

    def sent(self, now_s: float, vehicle_s: float) -> None:
        """Note that a heartbeat was sent."""
        self._due_s = next_due_s(self._due_s, HEARTBEAT_S, now_s)
        self._sent_s, self._sent_vehicle_s = now_s, vehicle_s


class SetpointStream(Generic[Target]):
    """Thread that calls `send` with the target every `STREAM_S`, and at once when the target changes."""

    def __init__(self, send: Callable[[Target], None], name: str) -> None:
        self._send = send
        self._changed = threading.Condition()
        self._target: Target | None = None
        self._updated_s = 0.0
        self._urgent = self._ended = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread; it sends nothing before there is a target."""
        self._thread.start()

    def set_setpoint(self, target: Target | None) -> None:
        """Send this target from now on, or none, for at most `STREAM_TIMEOUT_S`.

        Raises the last error of `send`, so that the caller does not rely on a stream that has ended.
        """
        with self._changed:
            if self._failure is not None:
                raise self._failure
            changed = target != self._target
            self._target, self._updated_s = target, time.monotonic()
            if changed:
                self._changed.notify()

    def hurry(self) -> None:
        """Send once before the next period: a simulated vehicle's time may be faster than the clock."""
        with self._changed:
            self._urgent = True
            self._changed.notify()

    def stop(self) -> None:
        """End the stream; nothing is sent after the return. Further calls have no effect."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        use_realtime_priority()
        due_s, sent = time.monotonic(), None
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda sent=sent: self._ended or self._urgent or self._target != sent,  # type: ignore[misc]
                    timeout=max(0.0, due_s - time.monotonic()),
                )
                if self._ended:
                    return
                now_s = time.monotonic()
                is_current = now_s - self._updated_s <= STREAM_TIMEOUT_S
                sent, self._urgent = self._target, False
            if now_s >= due_s:
                due_s = next_due_s(due_s, STREAM_S, now_s)
            if is_current and sent is not None:
                try:
                    self._send(sent)
                except Exception as error:  # raised by the next call of set_setpoint
                    with self._changed:
                        self._failure = error
                    return
