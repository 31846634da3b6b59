"""What the stand-ins share: their processes, the record of a flight, a policy."""

import contextlib
import json
import queue
import signal
import subprocess
import threading
import time
from typing import Any

from uav_dc_ros.core.grid import Action
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.mission.controller import MissionController


class FakeProcess:
    """A stand-in in a process of its own, which prints events as lines of JSON, and reads commands.

    Attributes:
        events: all of them so far.
    """

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self.process = process
        self.events: list[dict[str, Any]] = []
        self._new: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            event = json.loads(line) if line.startswith("{") else {"event": "printed", "line": line}
            self.events.append(event)
            self._new.put(event)

    def write(self, line: str) -> None:
        """Send a command."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def wait_for(self, event: str, seconds: float = 200.0) -> dict[str, Any]:
        """The next event of a name that was not waited for yet."""
        end = time.monotonic() + seconds
        while True:
            try:
                new = self._new.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"no {event!r} within {seconds} s: {self.events[-5:]}") from None
            if new["event"] == event:
                return new

    def all(self, event: str) -> list[dict[str, Any]]:
        """All events of a name so far."""
        return [each for each in list(self.events) if each["event"] == event]

    def close(self) -> None:
        """End the process; it must have lived until now."""
        died = self.process.poll()
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        try:
            self.process.wait(90.0)
        except subprocess.TimeoutExpired:
            self.process.send_signal(signal.SIGABRT)  # it prints its stack
            raise
        assert died is None, f"the stand-in died: {died}, {self.events[-20:]}"


class FlightRecord:
    """Record of a flight.

    Attributes:
        log: each change of phase or reason, with the step.
        executed, cells: the step of each move that was begun, and the cell that it led to.
    """

    def __init__(self) -> None:
        self.log: list[tuple[Phase, int, str]] = []
        self.executed: list[int] = []
        self.cells: list[tuple[int, int, int]] = []

    def record(self, bridge: MissionController) -> None:
        """Record the state of the mission, at each change."""
        if bridge.phase is Phase.MOVING and (not self.log or self.log[-1][0] is not Phase.MOVING):
            self.executed.append(bridge.step)
            self.cells.append(bridge.progress.goal)
        self.log.append((bridge.phase, bridge.step, bridge.reason))


def way_home(bridge: MissionController) -> Action:
    """A policy: straight to the dock, then hover."""
    (x, y, _), (dock_x, dock_y) = bridge.cell, bridge.scenario.dock_cell
    if x != dock_x:
        return Action.RIGHT if x < dock_x else Action.LEFT
    if y != dock_y:
        return Action.FORWARD if y < dock_y else Action.BACKWARD
    return Action.HOVER
