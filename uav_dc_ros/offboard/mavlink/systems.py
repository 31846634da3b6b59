"""The autopilots on one link, which of them the bridge flies, and evidence of others that command it."""

import math
from collections import deque
from typing import Any

from uav_dc_ros.offboard.flight_stacks import COPTERS, FLIGHT_STACKS, FlightStack
from uav_dc_ros.offboard.frames import Ned

SYSTEM, COMPONENT = 255, 191  # of this bridge: the system that FS_GCS_ENABLE watches; an onboard computer
AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: a camera, a ground station
PRESENT_S = 10.0  # a vehicle that was silent for longer has left the link, steady clock
MIN_HEARTBEATS = 4  # of the vehicle, one a second, before it counts as the only one
MIN_HEARTBEATS_AGAIN = 2  # of a vehicle that this mission already flew

# Evidence of another controller of the same vehicle: messages that answer nothing this bridge sent.
ENOUGH = 3  # pieces of evidence of one kind,
WITHIN_S = 10.0  # within this time, the last of them no older than that, vehicle time
TARGETS_WITHIN_S = 60.0  # the same for position targets, of which a mission has one every ten seconds or so
ACK_TIMEOUT_S = 60.0  # a later acknowledgement belongs to another command, vehicle time
SAME_M = 1.0  # two position targets that are nearer are the same
MAX_SETPOINTS, MAX_HEARTBEATS = 64, 8

HEARTBEATS = "heartbeats"
ANSWERS = "answers to commands"
TARGETS = "position targets"


class Systems:
    """Selects the vehicle: the one that is named, or the only one; and never another one after that."""

    def __init__(self, named: int | None, again: bool = False) -> None:
        self.named = named  # system number; None: the link has one vehicle only
        self.number = named  # of the vehicle; None: none was found yet
        self.flight_stack: FlightStack | None = None
        self._min_heartbeats = MIN_HEARTBEATS
        if again:  # this mission already flew the vehicle: the wait for others is shorter
            self._min_heartbeats = MIN_HEARTBEATS_AGAIN if named is None else 1
        self._heartbeats = 0  # of the vehicle
        self._present: dict[int, tuple[float, str]] = {}  # vehicles on the link: last heartbeat, description
        self._unsupported: str | None = None  # why a system with a heartbeat is not selected

    def __str__(self) -> str:
        """The vehicle's number and autopilot; empty until it is known."""
        return "" if self.flight_stack is None else f"system {self.number}, {self.flight_stack.name}"

    def on_heartbeat(self, heartbeat: Any, now_s: float) -> None:
        """Process a heartbeat received at a steady time."""
        if heartbeat.get_srcComponent() != AUTOPILOT or heartbeat.autopilot == NO_AUTOPILOT:
            return
        system, flight_stack = heartbeat.get_srcSystem(), FLIGHT_STACKS.get(heartbeat.autopilot)
        selects = self.flight_stack is None and self.number in (None, system)
        if flight_stack is None or heartbeat.type not in COPTERS:
            if selects:
                self._unsupported = _unsupported(system, heartbeat)
            return
        self._present[system] = now_s, f"system {system}, {flight_stack.name}"
        if selects:
            self.number, self.flight_stack, self._unsupported = system, flight_stack, None
        self._heartbeats += system == self.number

    def is_unambiguous(self, now_s: float) -> bool:
        """Whether the vehicle is named, or the only one on the link."""
        return self.named is not None or len(self._vehicles(now_s)) <= 1

    def _vehicles(self, now_s: float) -> list[str]:
        return [text for seen_s, text in self._present.values() if now_s - seen_s <= PRESENT_S]

    def missing(self, now_s: float) -> str | None:
        """Why the vehicle is not selected yet; None: it is."""
        present = self._vehicles(now_s)
        if self.flight_stack is None:
            others = f" (there is {'; '.join(present)})" if present else ""
            whose = "" if self.named is None else f" of system {self.named}"
            return self._unsupported or f"no heartbeat from an autopilot{whose}{others}"
        if not self.is_unambiguous(now_s):
            listed = "; ".join(present)
            return f"{len(present)} autopilots on this link: {listed}; expected --system N, one of them"
        if self._heartbeats < self._min_heartbeats:
            return f"{self}: waiting for its heartbeats, and for those of others on this link"
        return None


def _unsupported(system: int, heartbeat: Any) -> str:
    if heartbeat.autopilot in FLIGHT_STACKS:
        return f"system {system} is a vehicle of type {heartbeat.type}; expected a multicopter"
    known = " or ".join(f"{number} ({stack.name})" for number, stack in FLIGHT_STACKS.items())
    return f"system {system} has an autopilot of kind {heartbeat.autopilot}; expected {known}"


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
