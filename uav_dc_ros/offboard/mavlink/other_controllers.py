"""Evidence of another controller of the same vehicle: messages that answer nothing that was sent here."""

import math
from collections import deque

from uav_dc_ros.offboard.frames import Ned

ENOUGH = 3  # pieces of evidence of one kind,
WITHIN_S = 10.0  # in so much of the vehicle's time, and the last of them not older than that
TARGETS_WITHIN_S = 60.0  # the same of position targets: a mission has one every ten seconds or so
ANSWERED_S = 60.0  # a command is answered within that time, vehicle time
SAME_M = 1.0  # two position targets that are nearer are the same
KEPT, KEPT_HEARTBEATS = 64, 8

HEARTBEATS = "heartbeats"
ANSWERS = "answers to commands"
TARGETS = "position targets"


class OtherControllers:
    """Compares what was sent with what comes back. All times are the vehicle's.

    What a router sends back is known by its number; what an earlier process of the same bridge left behind
    comes once or twice, and is not enough.

    Args:
        identity: system and component of this end.
    """

    def __init__(self, identity: tuple[int, int]) -> None:
        self._who = f"of system {identity[0]}, component {identity[1]}"
        self._heartbeats: deque[int] = deque(maxlen=KEPT_HEARTBEATS)  # numbers of those that were sent
        self._commands: dict[int, float] = {}
        self._setpoints: deque[Ned] = deque(maxlen=KEPT)
        self._target: Ned | None = None  # reported last
        self._seen: dict[str, deque[float]] = {
            name: deque(maxlen=ENOUGH) for name in (HEARTBEATS, ANSWERS, TARGETS)
        }

    def sent_heartbeat(self, number: int) -> None:
        """Note that a heartbeat with this number went out."""
        self._heartbeats.append(number)

    def sent_command(self, command: int, vehicle_s: float) -> None:
        """Note that a command went out."""
        self._commands[command] = vehicle_s

    def sent_setpoint(self, setpoint: Ned) -> None:
        """Note that a setpoint went out."""
        if not self._setpoints or self._setpoints[-1] != setpoint:
            self._setpoints.append(setpoint)

    def heartbeat(self, number: int, vehicle_s: float) -> None:
        """Take in a heartbeat of this end's own identity."""
        if self._heartbeats and number not in self._heartbeats:
            self._seen[HEARTBEATS].append(vehicle_s)

    def answer(self, command: int, vehicle_s: float) -> None:
        """Take in an answer that is addressed to this end."""
        if vehicle_s - self._commands.get(command, -math.inf) > ANSWERED_S:
            self._seen[ANSWERS].append(vehicle_s)

    def target(self, target: Ned | None, vehicle_s: float) -> None:
        """Take in the position target that a vehicle in the commanded mode reports; None: it has none."""
        before, self._target = self._target, target
        if before is None or target is None or math.dist(before, target) <= SAME_M:
            return
        if all(math.dist(sent, target) > SAME_M for sent in self._setpoints):
            self._seen[TARGETS].append(vehicle_s)

    def found(self, vehicle_s: float) -> str | None:
        """The evidence, in words; None: there is not enough."""
        for name, seen in self._seen.items():
            within_s = TARGETS_WITHIN_S if name == TARGETS else WITHIN_S
            if len(seen) == ENOUGH and vehicle_s - seen[0] <= within_s:
                return f"{name} {self._who} that this bridge did not send"
        return None
