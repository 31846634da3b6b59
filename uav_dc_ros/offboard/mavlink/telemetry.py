"""What is known of the vehicle, from the MAVLink messages that came. No input or output."""

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any

from uav_dc_ros.offboard import limits
from uav_dc_ros.offboard.flight_stacks import BATTERY, LANDING, ON_GROUND, FlightStack
from uav_dc_ros.offboard.frames import Enu, Geodetic, LocalFrame, Ned, sphere_scale
from uav_dc_ros.offboard.mavlink.message_order import Discard, Sequence, VehicleClock
from uav_dc_ros.offboard.mavlink.other_controllers import OtherControllers
from uav_dc_ros.offboard.mavlink.systems import AUTOPILOT, COMPONENT, SYSTEM, Systems
from uav_dc_ros.offboard.vehicle import Limits, Mode, Telemetry

ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
POSITION_IGNORED = 0x7  # POSITION_TARGET_TYPEMASK
ACCEPTED, IN_PROGRESS = 0, 5  # MAV_RESULT
WARNING = 4  # MAV_SEVERITY; what is below is worse
CHUNK = 50  # characters of a STATUSTEXT
NO_VOLTAGE = 65535
ADVICE_S = 60.0  # age of a reason not to arm that may still hold; ArduPilot repeats it every 30 s
TEXT_S = 2.0  # a reason comes within this time before or after the refusal, steady clock
STALE_S = 3.0  # age after which a report on an estimate, an attitude or a target says nothing, steady clock
FARTHEST_M = 1e5  # no vehicle is further from where it was switched on

# What is asked for, Hz of the vehicle's time; its dialect adds the estimate's message. Nobody flies without.
RATES_HZ = {
    "LOCAL_POSITION_NED": 20.0,
    "EXTENDED_SYS_STATE": 5.0,
    "SYSTEM_TIME": 5.0,
    "SYS_STATUS": 2.0,
    "GPS_GLOBAL_ORIGIN": 1.0,
}
# What helps where a vehicle sends it; few, for a telemetry radio carries a kilobyte or two a second.
HELPFUL_HZ = {"ATTITUDE": 4.0, "POSITION_TARGET_LOCAL_NED": 2.0, "HOME_POSITION": 0.5}
TIMED = frozenset({"LOCAL_POSITION_NED", "SYSTEM_TIME", "ATTITUDE", "POSITION_TARGET_LOCAL_NED"})
ONCE = frozenset({"GPS_GLOBAL_ORIGIN"})  # PX4 sends it when it changes, or is asked for this one
ESTIMATE_HZ = 5.0
ADVICE = ("PreArm", "Preflight", "Arm:")
BACK_S = 4.0  # a state that was left for so short a time is believed when two heartbeats report it
SEEN = 64  # texts that are kept


def _is_on_earth(message: Any) -> bool:
    return abs(message.latitude) <= 90e7 and abs(message.longitude) <= 180e7


# Messages whose values no vehicle can have are discarded.
IS_POSSIBLE: dict[str, Callable[[Any], bool]] = {
    "LOCAL_POSITION_NED": lambda m: all(abs(value) <= FARTHEST_M for value in (m.x, m.y, m.z)),
    "GPS_GLOBAL_ORIGIN": _is_on_earth,
    "HOME_POSITION": _is_on_earth,
    "ATTITUDE": lambda m: math.isfinite(m.roll) and math.isfinite(m.pitch),
    "SYS_STATUS": lambda m: -1 <= m.battery_remaining <= 100,
    "EXTENDED_SYS_STATE": lambda m: m.landed_state <= LANDING,
}


class MavlinkTelemetry:
    """One vehicle, as it tells of itself.

    Args:
        datum: of the grid. None: the vehicle stands at `place` when its first position comes.
        place: in the grid's ENU frame, see `datum`.
        system: whom to listen to; None: to the only autopilot.
        again: was the vehicle flown by this mission before?

    Attributes:
        systems: the vehicle among those on the link.
        rivals: evidence of another controller.
        parameters: of the vehicle.
        discarded: messages of the vehicle that were ignored, by reason.
        datum: of the grid, once it is known.
        texts: what it said of itself, with the steady time, seconds.
        landed_state: MAV_LANDED_STATE.
        heard: when a message of each name last came, steady time, seconds.
        frame: of its local position.
    """

    def __init__(
        self, datum: Geodetic | None, place: Enu, system: int | None = None, again: bool = False
    ) -> None:
        self.datum, self.place = datum, place
        self.systems, self.rivals = Systems(system, again), OtherControllers((SYSTEM, COMPONENT))
        self.parameters = limits.ParameterReader()
        self.discarded: Counter[str] = Counter()
        self._sequence, self._clock = Sequence(), VehicleClock()
        self.frame: LocalFrame | None = None
        self.texts: deque[tuple[float, str]] = deque(maxlen=SEEN)
        self.landed_state: int | None = None
        self.heard: dict[str, float] = {}
        self._custom_mode, self._armed = 0, False
        self._left_s: dict[tuple[int, bool], float] = {}  # when such a state was reported no more
        self._back_s: float | None = None  # when the last heartbeat came, if it reported such a state
        self._flags, self._health = 0, 0
        self._battery: float | None = None
        self._battery_v: float | None = None
        self._battery_fails = False
        self._origin: Geodetic | None = None
        self._ned: Ned | None = None
        self._position: Enu | None = None
        self._position_s: float | None = None
        self._home: Geodetic | None = None
        self._target: Ned | None = None
        self._tilt_rad: float | None = None
        self._refusals: dict[str, tuple[float, str]] = {}  # by what was refused
        self._chunks: dict[int, str] = {}

    @property
    def system(self) -> int | None:
        """The vehicle's number; None: it has not spoken yet, and was not named."""
        return self.systems.number

    @property
    def dialect(self) -> FlightStack | None:
        """What kind of autopilot it has; None: it has not spoken yet."""
        return self.systems.dialect

    @property
    def vehicle_s(self) -> float:
        """Its own time, seconds; goes on where it starts anew."""
        return self._clock.vehicle_s

    def doubts_mode(self, now_s: float) -> bool:
        """Does the last heartbeat report a mode that was left a moment ago: an old message, or a pilot."""
        return self._back_s is not None and now_s - self._back_s < STALE_S

    def hear(self, message: Any, now_s: float) -> bool:
        """Take in a message of pymavlink's, at a steady time; was it the vehicle's, and news."""
        name, source = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        known = self.dialect is not None and source == (self.system, AUTOPILOT)
        if name == "HEARTBEAT" and source == (SYSTEM, COMPONENT):
            self.rivals.heartbeat(message.get_seq(), self.vehicle_s)
        if name == "HEARTBEAT" and not known:
            self.systems.meet(message, now_s)
        if source != (self.system, AUTOPILOT) or self.dialect is None:
            return False
        if (why := self._discards(name, message, now_s)) is not None:
            self.discarded[why] += 1
            return False
        if name == "HEARTBEAT" and known:
            self.systems.meet(message, now_s)
        self.heard[name] = now_s
        if (take := getattr(self, f"_on_{name.lower()}", None)) is not None:
            take(message, now_s)
        return True

    def _discards(self, name: str, message: Any, now_s: float) -> Discard | None:
        """Why a message of the vehicle is ignored; None: it is not."""
        if (why := self._sequence.take(name, message.get_seq(), message.get_crc(), now_s)) is not None:
            return why
        if not IS_POSSIBLE.get(name, lambda _: True)(message):
            return Discard.IMPOSSIBLE
        if name not in TIMED:
            return None
        restarts = self._clock.restarts
        why = self._clock.take(name, message.time_boot_ms, now_s)
        if self._clock.restarts != restarts:
            self._forget()
        return why

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
        sure = dialect is not None and self._is_fresh(dialect.estimate_message, now_s)
        target = self._target if self._is_fresh("POSITION_TARGET_LOCAL_NED", now_s) else None
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
            estimate_s=estimate_s,
            battery=self._battery,
            battery_v=self._battery_v,
            battery_fails=self._battery_fails,
            vehicle_s=self.vehicle_s,
            missing=self._missing(now_s),
            refusal=self._refusal(),
            status_text="; ".join(self._said(now_s - TEXT_S, now_s)),
            home=self._home.enu_from(self.datum) if self._home and self.datum else None,
            target=self.frame.from_autopilot(target) if self.frame and target else None,
            target_s=self.heard.get("POSITION_TARGET_LOCAL_NED"),
            tilt_rad=self._tilt_rad if self._is_fresh("ATTITUDE", now_s) else None,
            limits=self._limits(),
            other_controller=self.rivals.found(self.vehicle_s),
            system=str(self.systems),
            system_id=self.system,
            is_selected=self.systems.is_meant(now_s),
            discarded=dict(self.discarded),
        )

    def wanted(self) -> Mapping[str, float]:
        """The messages that the vehicle shall send, Hz."""
        return {**self._needed(), **HELPFUL_HZ} if self.dialect else {}

    def unanswered(self, now_s: float) -> list[str]:
        """Parameters to ask for now, at a steady time; they count as asked for."""
        return self.parameters.due(self.dialect.parameters, now_s) if self.dialect else []

    def _needed(self) -> dict[str, float]:
        return {**RATES_HZ, self.dialect.estimate_message: ESTIMATE_HZ} if self.dialect else {}

    def _is_fresh(self, name: str, now_s: float) -> bool:
        return now_s - self.heard.get(name, -math.inf) <= STALE_S

    def _limits(self) -> Limits | None:
        return (
            self.dialect.limits(self.parameters.values) if self.dialect and self.parameters.values else None
        )

    def _missing(self, now_s: float) -> str | None:
        if (missing := self.systems.missing(now_s)) is not None or self.dialect is None:
            return missing
        lacking = [name for name in self._needed() if name not in self.heard]
        if lacking:
            return f"the autopilot has not sent {', '.join(lacking)} yet"
        if not self._armed and self.parameters.are_pending(self.dialect.parameters, now_s):
            return "the autopilot has not answered for its parameters yet"
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
        state = message.custom_mode, bool(message.base_mode & ARMED)
        if state != (self._custom_mode, self._armed):
            # A heartbeat that was late for seconds, and whose number is news again, tells of a state before.
            is_back = state in self._left_s and now_s - self._left_s[state] < BACK_S
            if is_back and self._back_s is None:
                self._back_s = now_s
                self.discarded[Discard.LATE] += 1
                return
            self._left_s[self._custom_mode, self._armed] = now_s
        self._back_s = None
        self._custom_mode, self._armed = state
        if self._armed:
            self.granted("arming")

    def _on_gps_global_origin(self, message: Any, now_s: float) -> None:
        self._origin = _geodetic(message)
        if self.datum is not None:
            self.frame = self._frame_at(self._origin.enu_from(self.datum))
        self._place()

    def _on_home_position(self, message: Any, now_s: float) -> None:
        self._home = _geodetic(message)

    def _on_local_position_ned(self, message: Any, now_s: float) -> None:
        self._ned = Ned(message.x, message.y, message.z)
        self._position_s = now_s - self._clock.lag_s(message.time_boot_ms)
        self._place()

    def _on_position_target_local_ned(self, message: Any, now_s: float) -> None:
        target = Ned(message.x, message.y, message.z)
        has_one = not message.type_mask & POSITION_IGNORED and all(map(math.isfinite, target))
        self._target = target if has_one else None
        if self.dialect is not None and self.dialect.mode(self._custom_mode) is Mode.COMMANDED:
            self.rivals.target(self._target, self.vehicle_s)

    def _on_attitude(self, message: Any, now_s: float) -> None:
        self._tilt_rad = math.acos(math.cos(message.roll) * math.cos(message.pitch))

    def _on_param_value(self, message: Any, now_s: float) -> None:
        if self.dialect is not None:
            value = limits.decode(message, bytewise=self.dialect.parameters_are_bytes)
            self.parameters.receive(message.param_id, value)

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
            here = self._frame_at(Enu(0.0, 0.0, 0.0)).from_autopilot(self._ned)
            self.datum = self._origin.at(here.minus(self.place))
            self.frame = self._frame_at(self._origin.enu_from(self.datum))
        if self.frame is not None:
            self._position = self.frame.from_autopilot(self._ned)

    def _flags_ok(self) -> bool:
        return self.dialect is not None and self.dialect.estimate_ok(self._flags, self._health, self._armed)

    def _frame_at(self, origin: Enu) -> LocalFrame:
        """The autopilot's local frame; it has spoken, and told its origin."""
        assert self.dialect is not None
        assert self._origin is not None
        return LocalFrame(origin=origin, scale=sphere_scale(self._origin, self.dialect.earth_radius_m))

    def _forget(self) -> None:
        """It was started anew: what it told before says nothing."""
        self.heard = {"HEARTBEAT": self.heard["HEARTBEAT"]} if "HEARTBEAT" in self.heard else {}
        self._position, self._ned, self._origin, self._position_s = None, None, None, None
        self._home, self._target, self._tilt_rad = None, None, None
        self.landed_state, self._flags = None, 0
        self.parameters = limits.ParameterReader()

    def _said(self, from_s: float, to_s: float) -> list[str]:
        """What it warned of between two steady times, each of it once."""
        return list(dict.fromkeys(text for text_s, text in self.texts if from_s <= text_s <= to_s))

    def _refusal(self) -> str | None:
        if not self._refusals:
            return None
        what, (at_s, result) = max(self._refusals.items(), key=lambda refusal: refusal[1][0])
        said = self._said(at_s - TEXT_S, at_s + TEXT_S)
        return f"{what} refused: {'; '.join(said) or result}"


def _geodetic(message: Any) -> Geodetic:
    """The place of a message, which has degrees times 1e7 and millimetres."""
    return Geodetic(
        latitude_deg=message.latitude / 1e7,
        longitude_deg=message.longitude / 1e7,
        altitude_m=message.altitude / 1e3,
    )
