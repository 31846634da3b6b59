"""What is known of the vehicle, from the MAVLink messages that came. No input or output."""

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

from uav_dc_ros.autopilot.dialects import BATTERY, COPTERS, DIALECTS, ON_GROUND, Dialect
from uav_dc_ros.autopilot.frames import Enu, Geodetic, LocalFrame, Ned
from uav_dc_ros.autopilot.vehicle import Mode, Telemetry

AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: a camera, a ground station
ACCEPTED, IN_PROGRESS = 0, 5  # MAV_RESULT
WARNING = 4  # MAV_SEVERITY; what is below is worse
CHUNK = 50  # characters of a STATUSTEXT
NO_VOLTAGE = 65535
ADVICE_S = 60.0  # age of a reason not to arm that may still hold; ArduPilot repeats it every 30 s
TEXT_S = 2.0  # a reason comes within this time before or after the refusal, steady clock
STALE_S = 3.0  # age after which the last report on an estimate says nothing, steady clock
REBOOT_S = 1.0  # a vehicle whose time goes back by more has started anew

# What is asked for, Hz of the vehicle's time; its dialect adds the estimate's message.
RATES_HZ = {
    "LOCAL_POSITION_NED": 20.0,
    "EXTENDED_SYS_STATE": 5.0,
    "SYSTEM_TIME": 5.0,
    "SYS_STATUS": 2.0,
    "GPS_GLOBAL_ORIGIN": 1.0,
}
ONCE = frozenset({"GPS_GLOBAL_ORIGIN"})  # PX4 sends it when it changes, or is asked for this one
ESTIMATE_HZ = 5.0
ADVICE = ("PreArm", "Preflight", "Arm:")
SEEN = 64  # texts that are kept


class Hearing:
    """One vehicle, as it tells of itself.

    Args:
        datum: of the grid. None: the vehicle stands at `place` when its first position comes.
        place: in the grid's ENU frame, see `datum`.
        system: whom to listen to; None: to the first autopilot that speaks.

    Attributes:
        system: the vehicle's number; None: nobody spoke yet.
        dialect: what kind of autopilot it has.
        datum: of the grid, once it is known.
        texts: what it said of itself, with the steady time, seconds.
        landed_state: MAV_LANDED_STATE.
        heard: when a message of each name last came, steady time, seconds.
        frame: of its local position.
        vehicle_s: its own time, seconds; goes on where it starts anew.
    """

    def __init__(self, datum: Geodetic | None, place: Enu, system: int | None = None) -> None:
        self.datum, self.place, self.system = datum, place, system
        self.dialect: Dialect | None = None
        self.frame: LocalFrame | None = None
        self.texts: deque[tuple[float, str]] = deque(maxlen=SEEN)
        self.landed_state: int | None = None
        self.heard: dict[str, float] = {}
        self._stranger: str | None = None  # why somebody who spoke was not listened to
        self._custom_mode, self._armed = 0, False
        self._flags, self._health = 0, 0
        self._battery: float | None = None
        self._battery_v: float | None = None
        self._battery_fails = False
        self._origin: Geodetic | None = None
        self._ned: Ned | None = None
        self._position: Enu | None = None
        self._position_s: float | None = None
        self._position_ms = -1
        self._boot_s, self.vehicle_s = 0.0, 0.0
        self._refusals: dict[str, tuple[float, str]] = {}  # by what was refused
        self._chunks: dict[int, str] = {}

    def hear(self, message: Any, now_s: float) -> None:
        """Take in a message of pymavlink's, at a steady time."""
        name = message.get_type()
        if name == "HEARTBEAT":
            self._meet(message)
        if message.get_srcSystem() != self.system or message.get_srcComponent() != AUTOPILOT:
            return
        self.heard[name] = now_s
        if (boot_ms := getattr(message, "time_boot_ms", None)) is not None:
            self._pass_time(boot_ms / 1e3)
        if (take := getattr(self, f"_on_{name.lower()}", None)) is not None:
            take(message, now_s)

    def refused(self, what: str, result: str, now_s: float) -> None:
        """Keep that something was refused."""
        self._refusals[what] = now_s, result

    def granted(self, what: str) -> None:
        """Forget that something was refused."""
        self._refusals.pop(what, None)

    def telemetry(self, now_s: float) -> Telemetry:
        """What is known now."""
        dialect = self.dialect
        estimate_s = self.heard.get(dialect.estimate_message) if dialect else None
        sure = estimate_s is not None and now_s - estimate_s <= STALE_S and dialect is not None
        return Telemetry(
            heartbeat_s=self.heard.get("HEARTBEAT"),
            mode=dialect.mode(self._custom_mode) if dialect else Mode.OTHER,
            mode_name=dialect.mode_name(self._custom_mode) if dialect else "",
            armed=self._armed,
            on_ground=None if not self.landed_state else self.landed_state == ON_GROUND,
            position=self._position,
            position_s=self._position_s,
            estimate_ok=bool(
                sure and dialect and dialect.estimate_ok(self._flags, self._health, self._armed)
            ),
            battery=self._battery,
            battery_v=self._battery_v,
            battery_fails=self._battery_fails,
            vehicle_s=self.vehicle_s,
            missing=self._missing(now_s),
            refusal=self._refusal(),
            said="; ".join(self._said(now_s - TEXT_S, now_s)),
        )

    def wanted(self) -> Mapping[str, float]:
        """The messages that the vehicle shall send, Hz."""
        return {**RATES_HZ, self.dialect.estimate_message: ESTIMATE_HZ} if self.dialect else {}

    # Who speaks.

    def _meet(self, heartbeat: Any) -> None:
        if heartbeat.get_srcComponent() != AUTOPILOT or heartbeat.autopilot == NO_AUTOPILOT:
            return
        system = heartbeat.get_srcSystem()
        if self.system is not None and (system != self.system or self.dialect is not None):
            return
        dialect = DIALECTS.get(heartbeat.autopilot)
        if dialect is None:
            self._stranger = f"system {system} has an autopilot of kind {heartbeat.autopilot}; expected " + (
                " or ".join(f"{number} ({known.name})" for number, known in DIALECTS.items())
            )
        elif heartbeat.type not in COPTERS:
            self._stranger = f"system {system} is a vehicle of type {heartbeat.type}; expected a multicopter"
        else:
            self.system, self.dialect, self._stranger = system, dialect, None

    def _missing(self, now_s: float) -> str | None:
        if self.dialect is None:
            return self._stranger or (
                "no heartbeat from an autopilot"
                + (f" of system {self.system}" if self.system is not None else "")
            )
        lacking = [name for name in self.wanted() if name not in self.heard]
        if lacking:
            return f"the autopilot has not sent {', '.join(lacking)} yet"
        if not self._armed and not self._flags_ok():
            told = [text for text in self._said(now_s - ADVICE_S, now_s) if text.startswith(ADVICE)]
            return f"the autopilot is not ready to arm: {told[-1] if told else 'no position estimate yet'}"
        if self._position is None and self.landed_state == ON_GROUND:
            return "the autopilot has no estimate of its position yet"
        if self._position is None:
            return "the grid has no datum, and the vehicle does not stand on the ground; expected a datum"
        return None

    # What it says.

    def _on_heartbeat(self, message: Any, now_s: float) -> None:
        self._custom_mode, self._armed = message.custom_mode, bool(message.base_mode & ARMED)
        if self._armed:
            self.granted("arming")

    def _on_gps_global_origin(self, message: Any, now_s: float) -> None:
        if abs(message.latitude) > 90e7 or abs(message.longitude) > 180e7:
            return  # nowhere on the Earth
        self._origin = Geodetic(
            latitude_deg=message.latitude / 1e7,
            longitude_deg=message.longitude / 1e7,
            altitude_m=message.altitude / 1e3,
        )
        if self.datum is not None:
            self.frame = LocalFrame(origin=self._origin.seen_from(self.datum))
        self._place()

    def _on_local_position_ned(self, message: Any, now_s: float) -> None:
        if message.time_boot_ms == self._position_ms:
            return  # the same again
        if not all(map(math.isfinite, (message.x, message.y, message.z))):
            return  # no position
        self._position_ms = message.time_boot_ms
        self._ned, self._position_s = Ned(message.x, message.y, message.z), now_s
        self._place()

    def _on_extended_sys_state(self, message: Any, now_s: float) -> None:
        self.landed_state = message.landed_state

    def _on_sys_status(self, message: Any, now_s: float) -> None:
        self._health = message.onboard_control_sensors_health
        self._battery = message.battery_remaining / 100 if message.battery_remaining >= 0 else None
        volts = message.voltage_battery / 1e3
        self._battery_v = volts if 0 < message.voltage_battery < NO_VOLTAGE else None
        watched = message.onboard_control_sensors_enabled & BATTERY
        self._battery_fails = bool(watched and not self._health & BATTERY)

    def _on_ekf_status_report(self, message: Any, now_s: float) -> None:
        self._flags = message.flags

    def _on_estimator_status(self, message: Any, now_s: float) -> None:
        self._flags = message.flags

    def _on_statustext(self, message: Any, now_s: float) -> None:
        text = self._chunks.pop(message.id, "") + message.text
        if message.id and len(message.text) == CHUNK:
            self._chunks[message.id] = text
            return
        if message.severity <= WARNING:
            self.texts.append((now_s, text.strip()))

    # What follows from it.

    def _place(self) -> None:
        """Bring the local position into the grid's frame."""
        if self._ned is None or self._origin is None:
            return
        if self.datum is None:
            if self.landed_state != ON_GROUND or not self._flags_ok():
                return
            # Here is `place`, as far as the autopilot knows: the datum lies as far away as that says.
            here = LocalFrame(origin=Enu(0.0, 0.0, 0.0)).from_autopilot(self._ned)
            offset = Enu(*(h - p for h, p in zip(here, self.place, strict=True)))
            self.datum = self._origin.at(offset)
            self.frame = LocalFrame(origin=self._origin.seen_from(self.datum))
        if self.frame is not None:
            self._position = self.frame.from_autopilot(self._ned)

    def _flags_ok(self) -> bool:
        return self.dialect is not None and self.dialect.estimate_ok(self._flags, self._health, self._armed)

    def _pass_time(self, boot_s: float) -> None:
        vehicle_s = self._boot_s + boot_s
        if vehicle_s < self.vehicle_s - REBOOT_S:
            self._boot_s = self.vehicle_s
            self.heard = {"HEARTBEAT": self.heard["HEARTBEAT"]} if "HEARTBEAT" in self.heard else {}
            self._position, self._ned, self._origin, self._position_s = None, None, None, None
            self.landed_state, self._flags = None, 0
            vehicle_s = self._boot_s + boot_s
        self.vehicle_s = max(self.vehicle_s, vehicle_s)

    def _said(self, from_s: float, to_s: float) -> list[str]:
        """What it warned of between two steady times, each of it once."""
        return list(dict.fromkeys(text for text_s, text in self.texts if from_s <= text_s <= to_s))

    def _refusal(self) -> str | None:
        if not self._refusals:
            return None
        what, (at_s, result) = max(self._refusals.items(), key=lambda refusal: refusal[1][0])
        said = self._said(at_s - TEXT_S, at_s + TEXT_S)
        return f"{what} refused: {'; '.join(said) or result}"
