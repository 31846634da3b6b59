"""The autopilots on one link, and which of them the bridge flies."""

from typing import Any

from uav_dc_ros.offboard.flight_stacks import COPTERS, FLIGHT_STACKS, FlightStack

SYSTEM, COMPONENT = 255, 191  # of this bridge: the system that FS_GCS_ENABLE watches; an onboard computer
AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: a camera, a ground station
PRESENT_S = 10.0  # a vehicle that was silent for longer has left the link, steady clock
MIN_HEARTBEATS = 4  # of the vehicle, one a second, before it counts as the only one
MIN_HEARTBEATS_AGAIN = 2  # of a vehicle that this mission already flew


class Systems:
    """Selects the vehicle: the one that is named, or the only one; and never another one after that.

    Args:
        named: its system number; None: the link has one vehicle only.
        again: whether this mission already flew the vehicle; then the wait for others is shorter.

    Attributes:
        number: of the vehicle; None: none was found yet.
        flight_stack: of the vehicle.
    """

    def __init__(self, named: int | None, again: bool = False) -> None:
        self.named, self.number = named, named
        self.flight_stack: FlightStack | None = None
        self._min_heartbeats = MIN_HEARTBEATS
        if again:
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
