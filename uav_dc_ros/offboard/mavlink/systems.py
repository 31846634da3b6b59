"""The autopilots on one link, and which of them is meant."""

from typing import Any

from uav_dc_ros.offboard.flight_stacks import COPTERS, FLIGHT_STACKS, FlightStack

SYSTEM, COMPONENT = 255, 191  # of this end: what FS_GCS_ENABLE of ArduPilot looks after; an onboard computer
AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: a camera, a ground station
PRESENT_S = 10.0  # a vehicle that was silent for so long is no longer on the link, steady clock
LISTENED = 4  # heartbeats of a vehicle, once a second, between which every other one speaks
LISTENED_AGAIN = 2  # of one that was flown by this mission before


class Systems:
    """Finds the vehicle that is meant: the one that is named, or the only one; and never another after that.

    Args:
        named: its number; None: the link has one vehicle only.
        again: was the vehicle flown by this mission before? Then nobody is waited for longer than needed.

    Attributes:
        number: of the vehicle; None: none was found yet.
        dialect: what kind of autopilot it has.
    """

    def __init__(self, named: int | None, again: bool = False) -> None:
        self.named, self.number = named, named
        self.dialect: FlightStack | None = None
        self._listens = LISTENED if not again else LISTENED_AGAIN if named is None else 1
        self._heartbeats = 0  # of the vehicle
        self._present: dict[int, tuple[float, str]] = {}  # vehicles that could be meant: when they spoke last
        self._stranger: str | None = None  # why somebody who spoke is not meant

    def __str__(self) -> str:
        """The vehicle's number and autopilot; empty until it is known."""
        return "" if self.dialect is None else f"system {self.number}, {self.dialect.name}"

    def meet(self, heartbeat: Any, now_s: float) -> None:
        """Take in a heartbeat, at a steady time."""
        if heartbeat.get_srcComponent() != AUTOPILOT or heartbeat.autopilot == NO_AUTOPILOT:
            return
        system, dialect = heartbeat.get_srcSystem(), FLIGHT_STACKS.get(heartbeat.autopilot)
        meant = self.number in (None, system)
        if dialect is None or heartbeat.type not in COPTERS:
            if meant and self.dialect is None:
                self._stranger = _stranger(system, heartbeat)
            return
        self._present[system] = now_s, f"system {system}, {dialect.name}"
        if meant and self.dialect is None:
            self.number, self.dialect, self._stranger = system, dialect, None
        self._heartbeats += system == self.number

    def is_meant(self, now_s: float) -> bool:
        """Is the vehicle surely the one that is meant: it is named, or there is no other."""
        return self.named is not None or len(self._vehicles(now_s)) <= 1

    def _vehicles(self, now_s: float) -> list[str]:
        """The vehicles on the link."""
        return [text for seen_s, text in self._present.values() if now_s - seen_s <= PRESENT_S]

    def missing(self, now_s: float) -> str | None:
        """Why nobody knows yet which vehicle is meant; None: it is known."""
        present = self._vehicles(now_s)
        if self.dialect is None:
            others = f" (there is {'; '.join(present)})" if present else ""
            whose = "" if self.named is None else f" of system {self.named}"
            return self._stranger or f"no heartbeat from an autopilot{whose}{others}"
        if not self.is_meant(now_s):
            listed = "; ".join(present)
            return f"{len(present)} autopilots on this link: {listed}; expected --system N, one of them"
        if self._heartbeats < self._listens:
            return f"{self}: waiting for its heartbeats, and for those of others on this link"
        return None


def _stranger(system: int, heartbeat: Any) -> str:
    """Why a vehicle is not one that this system can fly."""
    if heartbeat.autopilot in FLIGHT_STACKS:
        return f"system {system} is a vehicle of type {heartbeat.type}; expected a multicopter"
    known = " or ".join(f"{number} ({dialect.name})" for number, dialect in FLIGHT_STACKS.items())
    return f"system {system} has an autopilot of kind {heartbeat.autopilot}; expected {known}"
