"""State of the vehicle, from the MAVLink messages that it sends. No input or output."""

import math
from collections import Counter
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from uav_dc_ros.offboard import limits
from uav_dc_ros.offboard.flight_stacks import BATTERY, IN_AIR, LANDING, ON_GROUND, FlightStack
from uav_dc_ros.offboard.frames import Enu, Geodetic, LocalFrame, Ned, sphere_scale
from uav_dc_ros.offboard.mavlink.fence_upload import FenceUpload
from uav_dc_ros.offboard.mavlink.systems import AUTOPILOT, COMPONENT, SYSTEM, OtherControllers, Systems
from uav_dc_ros.offboard.message_order import Discard, Sequence, VehicleClock
from uav_dc_ros.offboard.rejections import Rejections
from uav_dc_ros.offboard.vehicle import ALTITUDE_UNKNOWN, Limits, Mode, Telemetry

ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
POSITION_IGNORED = 0x7  # POSITION_TARGET_TYPEMASK
CHUNK = 50  # characters of a STATUSTEXT
NO_VOLTAGE = 65535
PREARM_TEXT_S = 60.0  # a reason not to arm may hold for this long; ArduPilot repeats it every 30 s
STALE_S = 3.0  # maximum age of a report on an estimate, an attitude or a target, steady clock
MAX_POSITION_M = 1e5  # no vehicle is further from where it was switched on

# Rates to request, Hz of the vehicle's time; the flight stack adds its estimate's message. All are required.
RATES_HZ = {
    "LOCAL_POSITION_NED": 20.0,
    "EXTENDED_SYS_STATE": 5.0,
    "SYSTEM_TIME": 5.0,
    "SYS_STATUS": 2.0,
    "GPS_GLOBAL_ORIGIN": 1.0,
}
# Used if the vehicle sends them; low rates, since a telemetry radio carries a kilobyte or two a second.
OPTIONAL_RATES_HZ = {"ATTITUDE": 4.0, "POSITION_TARGET_LOCAL_NED": 2.0, "HOME_POSITION": 0.5}
TIMED = frozenset({"LOCAL_POSITION_NED", "SYSTEM_TIME", "ATTITUDE", "POSITION_TARGET_LOCAL_NED"})
ESTIMATE_HZ = 5.0
PREARM_TEXTS = ("PreArm", "Preflight", "Arm:")
RETURNED_S = 4.0  # a state that was left for a shorter time is accepted from the second heartbeat on

_enu_from = lru_cache(maxsize=64)(Geodetic.enu_from)  # costly, and the same at each tick


def _is_on_earth(message: Any) -> bool:
    return abs(message.latitude) <= 90e7 and abs(message.longitude) <= 180e7


# A message whose values no vehicle can have is discarded.
IS_POSSIBLE: dict[str, Callable[[Any], bool]] = {
    "LOCAL_POSITION_NED": lambda m: all(abs(value) <= MAX_POSITION_M for value in (m.x, m.y, m.z)),
    "GPS_GLOBAL_ORIGIN": _is_on_earth,
    "HOME_POSITION": _is_on_earth,
    "ATTITUDE": lambda m: math.isfinite(m.roll) and math.isfinite(m.pitch),
    "SYS_STATUS": lambda m: -1 <= m.battery_remaining <= 100,
    "EXTENDED_SYS_STATE": lambda m: m.landed_state <= LANDING,
}


class MavlinkTelemetry:
    """State of one vehicle. Arguments: see `MavlinkVehicle`."""

    def __init__(
        self,
        datum: Geodetic | None,
        start: Enu,
        system: int | None = None,
        again: bool = False,
        datum_deg: tuple[float, float] | None = None,
        fence: FenceUpload | None = None,
    ) -> None:
        self.datum, self.start = datum, start  # of the grid, None: not known yet; see `MavlinkVehicle`
        self.datum_deg = datum_deg
        self.fence = fence  # to be uploaded before take-off; None: none
        self.systems, self.other_controllers = Systems(system, again), OtherControllers(SYSTEM, COMPONENT)
        self.rejections = Rejections()
        self.discarded: Counter[str] = Counter()
        self._sequence, self._clock = Sequence(), VehicleClock()
        self.frame: LocalFrame | None = None  # of the vehicle's local position; None: not known yet
        self.received_s: dict[str, float] = {}  # by message name, steady clock: when the last one came
        self._custom_mode, self._armed = 0, False
        self._left_s: dict[tuple[int, bool], float] = {}  # when the vehicle last left a state
        self._returned_s: float | None = None  # last heartbeat, if it reports a state left a moment ago
        self._messages: dict[str, Any] = {}  # the last one of each name
        self._chunks: dict[int, str] = {}
        self._reset()

    def _reset(self) -> None:
        """Drop what a vehicle reported before it was started anew."""
        self.received_s = {name: at_s for name, at_s in self.received_s.items() if name == "HEARTBEAT"}
        self._messages = {name: last for name, last in self._messages.items() if name == "SYS_STATUS"}
        self.position: Enu | None = None  # in the grid's ENU frame
        self._position_s: float | None = None
        self._ned: Ned | None = None
        self._origin: Geodetic | None = None
        self.parameters = limits.ParameterReader()
        self._limits: Limits | None = None

    @property
    def system(self) -> int | None:
        """The vehicle's system number; None: not known yet."""
        return self.systems.number

    @property
    def flight_stack(self) -> FlightStack | None:
        """The vehicle's autopilot; None: not known yet."""
        return self.systems.flight_stack

    @property
    def vehicle_s(self) -> float:
        """The vehicle's own time, seconds; monotonic across its restarts."""
        return self._clock.vehicle_s

    @property
    def landed_state(self) -> int | None:
        """MAV_LANDED_STATE; None: not reported."""
        message = self._messages.get("EXTENDED_SYS_STATE")
        return message.landed_state if message is not None else None

    @property
    def is_at_rest(self) -> bool:
        """Whether the vehicle is disarmed, and reports that it stands on the ground."""
        return not self._armed and self.landed_state == ON_GROUND

    @property
    def is_flown_by_others(self) -> bool:
        """Whether a pilot or a failsafe flies: it is armed in another mode than the commanded one."""
        stack = self.flight_stack
        return self._armed and (stack is None or stack.mode(self._custom_mode) is not Mode.COMMANDED)

    def is_mode_uncertain(self, now_s: float) -> bool:
        """Whether the last heartbeat reports a state left a moment ago: a late message, or a pilot."""
        return self._returned_s is not None and now_s - self._returned_s < STALE_S

    def update(self, message: Any, now_s: float) -> bool:
        """Process a pymavlink message; returns whether it is new, and the vehicle's."""
        name, source = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        known = self.flight_stack is not None and source == (self.system, AUTOPILOT)
        if name == "HEARTBEAT" and source == (SYSTEM, COMPONENT):
            self.other_controllers.on_heartbeat(message.get_seq(), self.vehicle_s)
        if name == "HEARTBEAT" and not known:
            self.systems.on_heartbeat(message, now_s)
        if source != (self.system, AUTOPILOT) or self.flight_stack is None:
            return False
        if (why := self._discard_reason(name, message, now_s)) is not None:
            self.discarded[why] += 1
            return False
        if name == "HEARTBEAT" and known:
            self.systems.on_heartbeat(message, now_s)
        self.received_s[name], self._messages[name] = now_s, message
        if (handler := getattr(self, f"_on_{name.lower()}", None)) is not None:
            handler(message, now_s)
        return True

    def _discard_reason(self, name: str, message: Any, now_s: float) -> Discard | None:
        if (why := self._sequence.check(name, message.get_seq(), message.get_crc(), now_s)) is not None:
            return why
        if name in IS_POSSIBLE and not IS_POSSIBLE[name](message):
            return Discard.IMPOSSIBLE
        if name not in TIMED:
            return None
        restarts = self._clock.restarts
        why = self._clock.check(name, message.time_boot_ms, now_s)
        if self._clock.restarts != restarts:
            self._reset()
        return why

    def snapshot(self, now_s: float) -> Telemetry:
        """The vehicle's state at a steady time."""
        stack, received_s, landed_state = self.flight_stack, self.received_s, self.landed_state
        target = _target(self._fresh("POSITION_TARGET_LOCAL_NED", now_s))
        attitude, status = self._fresh("ATTITUDE", now_s), self._messages.get("SYS_STATUS")
        home = self._messages.get("HOME_POSITION")
        charge, volts, fails = _battery(status) if status is not None else (None, None, False)
        return Telemetry(
            heartbeat_s=received_s.get("HEARTBEAT"),
            mode=stack.mode(self._custom_mode) if stack else Mode.OTHER,
            mode_name=stack.mode_name(self._custom_mode) if stack else "",
            armed=self._armed,
            on_ground=landed_state == ON_GROUND if landed_state else None,
            position=self.position,
            position_s=self._position_s,
            estimate_ok=bool(stack and self._fresh(stack.estimate_message, now_s) and self._estimate_ok()),
            estimate_s=received_s.get(stack.estimate_message) if stack else None,
            battery=charge,
            battery_v=volts,
            battery_fails=fails,
            vehicle_s=self.vehicle_s,
            missing=self._missing(now_s),
            fence_refusal=self._fence_refusal(),
            refusal=self.rejections.latest(self._executed()),
            status_text=self.rejections.recent_texts(now_s),
            home=_enu_from(_geodetic(home), self.datum) if home is not None and self.datum else None,
            target=self.frame.from_autopilot(target) if self.frame and target else None,
            target_s=received_s.get("POSITION_TARGET_LOCAL_NED"),
            tilt_rad=math.acos(math.cos(attitude.roll) * math.cos(attitude.pitch))
            if attitude is not None
            else None,
            limits=self._limits,
            other_controller=self.other_controllers.evidence(self.vehicle_s),
            system=str(self.systems),
            system_id=self.system,
            is_selected=self.systems.is_unambiguous(now_s),
            discarded=dict(self.discarded),
            autopilot=stack.name if stack else "",
            datum=self.datum,
            grid_origin=str(self.datum or ""),
        )

    def rates_hz(self) -> dict[str, float]:
        """The messages that the vehicle shall send, and their rates, Hz."""
        return {**self._required_rates_hz(), **OPTIONAL_RATES_HZ} if self.flight_stack else {}

    def parameters_to_request(self, now_s: float) -> list[str]:
        """Parameters to request at a steady time; they count as requested."""
        return self.parameters.due(self.flight_stack.parameters, now_s) if self.flight_stack else []

    def _required_rates_hz(self) -> dict[str, float]:
        return {**RATES_HZ, self.flight_stack.estimate_message: ESTIMATE_HZ} if self.flight_stack else {}

    def _fresh(self, name: str, now_s: float) -> Any:
        """The last message of a name; None: it is stale."""
        is_fresh = now_s - self.received_s.get(name, -math.inf) <= STALE_S
        return self._messages[name] if is_fresh else None

    def _missing(self, now_s: float) -> str | None:
        if (missing := self.systems.missing(now_s)) is not None or self.flight_stack is None:
            return missing
        lacking = [name for name in self._required_rates_hz() if name not in self.received_s]
        if lacking:
            return f"the autopilot has not sent {', '.join(lacking)} yet"
        if not self._armed and self.parameters.are_pending(self.flight_stack.parameters, now_s):
            return "the autopilot has not answered for its parameters yet"
        if not self._armed and not self._estimate_ok():
            texts = self.rejections.texts(now_s - PREARM_TEXT_S, now_s)
            reasons = [text for text in texts if text.startswith(PREARM_TEXTS)]
            return f"the autopilot is not ready to arm: {(reasons or ['no position estimate yet'])[-1]}"
        if self.position is None and self.landed_state == ON_GROUND:
            return "the autopilot has no estimate of its position yet"
        if self.position is None and self.datum_deg is not None:
            return ALTITUDE_UNKNOWN
        if self.position is None:
            return "the grid has no datum, and the vehicle does not stand on the ground; expected a datum"
        if self.fence is not None and not self.fence.is_over:
            wait = "the fence is uploaded once the vehicle is disarmed on the ground"
            return str(self.fence.state) if self.is_at_rest else wait
        return None

    def _executed(self) -> list[str]:
        """Commands that the vehicle's state shows to be executed."""
        shown = {"arming": self._armed, "taking off": self.landed_state == IN_AIR}
        return [command for command, is_executed in shown.items() if is_executed]

    def _fence_refusal(self) -> str | None:
        if self.fence is None or (self.fence.is_over and self.fence.refusal is None):
            return None
        if not self.fence.is_over and self._armed and self.landed_state == IN_AIR:
            return "the fence was not uploaded before take-off"
        return self.fence.refusal and f"the fence is not uploaded: {self.fence.refusal}"

    # Handlers, by message name.

    def _on_heartbeat(self, message: Any, now_s: float) -> None:
        state = message.custom_mode, bool(message.base_mode & ARMED)
        if state != (self._custom_mode, self._armed):
            # A heartbeat that is seconds late, and whose number is accepted again, reports an earlier state.
            returned = state in self._left_s and now_s - self._left_s[state] < RETURNED_S
            if returned and self._returned_s is None:
                self._returned_s = now_s
                self.discarded[Discard.LATE] += 1
                return
            self._left_s[self._custom_mode, self._armed] = now_s
        self._returned_s = None
        self._custom_mode, self._armed = state
        if self._armed:
            self.rejections.accept("arming")

    def _on_gps_global_origin(self, message: Any, now_s: float) -> None:
        self._origin = _geodetic(message)
        if self.datum is not None:
            self.frame = self._frame_at(self._origin.enu_from(self.datum))
        self._locate()

    def _on_local_position_ned(self, message: Any, now_s: float) -> None:
        self._ned = Ned(message.x, message.y, message.z)
        self._position_s = now_s - self._clock.lag_s(message.time_boot_ms)
        self._locate()

    def _on_position_target_local_ned(self, message: Any, now_s: float) -> None:
        if self.flight_stack is not None and self.flight_stack.mode(self._custom_mode) is Mode.COMMANDED:
            self.other_controllers.on_target(_target(message), self.vehicle_s)

    def _on_param_value(self, message: Any, now_s: float) -> None:
        if (stack := self.flight_stack) is not None:
            value = limits.decode(message, bytewise=stack.parameters_are_bytes)
            self.parameters.receive(message.param_id, value)
            values = self.parameters.values
            self._limits = stack.limits(values) if values else None

    def _on_statustext(self, message: Any, now_s: float) -> None:
        text = self._chunks.pop(message.id, "") + message.text
        if message.id and len(message.text) == CHUNK:
            self._chunks[message.id] = text
        else:
            self.rejections.on_status_text(message.severity, text, now_s)

    def _locate(self) -> None:
        """Convert the local position into the grid's frame, which the first one on the ground may define."""
        if self._ned is None or self._origin is None:
            return
        if self.datum is None:
            if self.landed_state != ON_GROUND or not self._estimate_ok():
                return
            here = self._frame_at(Enu(0.0, 0.0, 0.0)).from_autopilot(self._ned)
            if self.datum_deg is None:
                self.datum = self._origin.at(here.minus(self.start))
            else:
                self.datum = Geodetic(*self.datum_deg, self._origin.at(here).altitude_m)
            self.frame = self._frame_at(self._origin.enu_from(self.datum))
        if self.frame is not None:
            self.position = self.frame.from_autopilot(self._ned)

    def _estimate_ok(self) -> bool:
        if (stack := self.flight_stack) is None:
            return False
        estimate, status = self._messages.get(stack.estimate_message), self._messages.get("SYS_STATUS")
        health = status.onboard_control_sensors_health if status is not None else 0
        return stack.estimate_ok(estimate.flags if estimate is not None else 0, health, self._armed)

    def _frame_at(self, origin: Enu) -> LocalFrame:
        assert self.flight_stack is not None
        assert self._origin is not None
        return LocalFrame(origin=origin, scale=sphere_scale(self._origin, self.flight_stack.earth_radius_m))


def _geodetic(message: Any) -> Geodetic:
    """The position of a message that has degrees times 1e7, and millimetres."""
    return Geodetic(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)


def _target(message: Any) -> Ned | None:
    """Position of a POSITION_TARGET_LOCAL_NED."""
    if message is None or message.type_mask & POSITION_IGNORED:
        return None
    target = Ned(message.x, message.y, message.z)
    return target if all(map(math.isfinite, target)) else None


def _battery(status: Any) -> tuple[float | None, float | None, bool]:
    """Charge, voltage and failure in a SYS_STATUS."""
    charge = status.battery_remaining / 100 if status.battery_remaining >= 0 else None
    volts = status.voltage_battery / 1e3 if 0 < status.voltage_battery < NO_VOLTAGE else None
    fails = status.onboard_control_sensors_enabled & BATTERY & ~status.onboard_control_sensors_health
    return charge, volts, bool(fails)
