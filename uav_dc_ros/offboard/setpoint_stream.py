"""A stream of setpoints that keeps its pace whatever the node's executor does, and ends with who decides."""

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from uav_dc_ros.offboard.realtime import run_when_due
from uav_dc_ros.offboard.send_timer import LIFE_S, STREAM_S, following

Target = TypeVar("Target")


class SetpointStream(Generic[Target]):
    """Calls `send` every `STREAM_S` in a thread of its own, and at once when there is another target.

    Args:
        send: what to do with the target; must be safe to call in any thread.
        name: of the thread.
    """

    def __init__(self, send: Callable[[Target], None], name: str) -> None:
        self._send = send
        self._changed = threading.Condition()
        self._target: Target | None = None
        self._alive_s = 0.0
        self._urgent = self._ended = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin; nothing is sent before there is a target."""
        self._thread.start()

    def set_setpoint(self, target: Target | None) -> None:
        """Send this from now on, or nothing; it counts as a sign of life.

        Raises:
            Exception: what `send` raised last: who decides must not believe that somebody listens.
        """
        with self._changed:
            if self._failure is not None:
                raise self._failure
            changed = target != self._target
            self._target, self._alive_s = target, time.monotonic()
            if changed:
                self._changed.notify()

    def hurry(self) -> None:
        """Send before the next beat, too: a simulated vehicle's time may be faster than the clock."""
        with self._changed:
            self._urgent = True
            self._changed.notify()

    def stop(self) -> None:
        """End it; more than once is as good as once. Nothing is sent any more when this returns."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        run_when_due()
        due_s, sent = time.monotonic(), None
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda sent=sent: (  # type: ignore[misc]
                        self._ended or self._urgent or self._target != sent
                    ),
                    timeout=max(0.0, due_s - time.monotonic()),
                )
                if self._ended:
                    return
                now_s = time.monotonic()
                alive = now_s - self._alive_s <= LIFE_S
                sent, self._urgent = self._target, False
            if now_s >= due_s:
                due_s = following(due_s, STREAM_S, now_s)
            if alive and sent is not None:
                try:
                    self._send(sent)
                except Exception as error:  # told to who decides next
                    with self._changed:
                        self._failure = error
                    return
