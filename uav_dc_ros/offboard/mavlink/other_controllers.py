"""Evidence of another controller of the same vehicle: messages that answer nothing this bridge sent."""

import math
from collections import deque

from uav_dc_ros.offboard.frames import Ned

ENOUGH = 3  # pieces of evidence of one kind,
WITHIN_S = 10.0  # within this time, the last of them no older than that, vehicle time
TARGETS_WITHIN_S = 60.0  # the same for position targets, of which a mission has one every ten seconds or so
ACK_TIMEOUT_S = 60.0  # a later acknowledgement belongs to another command, vehicle time
SAME_M = 1.0  # two position targets that are nearer are the same
MAX_SETPOINTS, MAX_HEARTBEATS = 64, 8

HEARTBEATS = "heartbeats"
ANSWERS = "answers to commands"
TARGETS = "position targets"


class OtherControllers:
    """Compares what this bridge sent with what it receives. All times are the vehicle's.

    A message that a router sends back is recognised by its number. What an earlier process of the same
    bridge left behind arrives once or twice, which is not enough.
    """

    def __init__(self, system: int, component: int) -> None:
        self._identity = f"of system {system}, component {component}"
        self._heartbeats: deque[int] = deque(maxlen=MAX_HEARTBEATS)  # sequence numbers sent
        self._commands: dict[int, float] = {}
        self._setpoints: deque[Ned] = deque(maxlen=MAX_SETPOINTS)
        self._target: Ned | None = None  # reported last
        self._seen_s = {name: deque[float](maxlen=ENOUGH) for name in (HEARTBEATS, ANSWERS, TARGETS)}

    def sent_heartbeat(self, number: int) -> None:
        """Record the sequence number of a heartbeat that was sent."""
        self._heartbeats.append(number)

    def sent_command(self, command: int, vehicle_s: float) -> None:
        """Record a command that was sent."""
        self._commands[command] = vehicle_s

    def sent_setpoint(self, setpoint: Ned) -> None:
        """Record a setpoint that was sent."""
        if not self._setpoints or self._setpoints[-1] != setpoint:
            self._setpoints.append(setpoint)

    def on_heartbeat(self, number: int, vehicle_s: float) -> None:
        """Check a heartbeat with this bridge's identity."""
        if self._heartbeats and number not in self._heartbeats:
            self._seen_s[HEARTBEATS].append(vehicle_s)

    def on_ack(self, command: int, vehicle_s: float) -> None:
        """Check an acknowledgement that is addressed to this bridge."""
        if vehicle_s - self._commands.get(command, -math.inf) > ACK_TIMEOUT_S:
            self._seen_s[ANSWERS].append(vehicle_s)

    def on_target(self, target: Ned | None, vehicle_s: float) -> None:
        """Check the position target that a vehicle in the commanded mode reports; None: it has none."""
        before, self._target = self._target, target
        if before is None or target is None or math.dist(before, target) <= SAME_M:
            return
        if all(math.dist(sent, target) > SAME_M for sent in self._setpoints):
            self._seen_s[TARGETS].append(vehicle_s)

    def evidence(self, vehicle_s: float) -> str | None:
        """The evidence in words; None: there is not enough."""
        for name, seen_s in self._seen_s.items():
            within_s = TARGETS_WITHIN_S if name == TARGETS else WITHIN_S
            if len(seen_s) == ENOUGH and vehicle_s - seen_s[0] <= within_s:
                return f"{name} {self._identity} that this bridge did not send"
        return None
