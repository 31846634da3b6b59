"""State of a vehicle with PX4, from the messages of its uXRCE-DDS topics. No input or output.

Positions are in PX4's local NED here, and nowhere beyond.
"""

import math
from collections import Counter
from typing import Any

from uav_dc_ros.offboard.flight_stacks import COPTERS, PX4
from uav_dc_ros.offboard.frames import Enu, Geodetic, LocalFrame, Ned, tilt_rad, to_enu
from uav_dc_ros.offboard.message_order import StampOrder
from uav_dc_ros.offboard.vehicle import ALTITUDE_UNKNOWN, Mode, Telemetry

COMPANION = 191  # MAV_COMP_ID_ONBOARD_COMPUTER: source of commands, by which their answers are recognised
MAX_STEP_S = 10.0  # between two stamps; a longer step, or one back, is a change of clock
LOCAL = "local:"  # before the grid origin of a vehicle without a global position

ARMED = 2  # ARMING_STATE
BATTERY_LOW = 1  # BATTERY_WARNING; a higher number is more severe
ACCEPTED, IN_PROGRESS = 0, 5  # VEHICLE_CMD_RESULT
RESULTS = {1: "temporarily rejected", 2: "denied", 3: "unsupported", 4: "failed", 6: "cancelled"}
ARM = 400
COMMANDS = {20: "returning", 21: "landing", 176: "the change of mode", ARM: "arming"}  # VEHICLE_CMD
# By NAVIGATION_STATE; 12 is DESCEND, which lands without a position.
MODES = {14: Mode.COMMANDED, 4: Mode.HOLD, 5: Mode.RETURN, 12: Mode.LAND, 18: Mode.LAND, 20: Mode.LAND}
MODE_NAMES = {
    0: "MANUAL", 1: "ALTCTL", 2: "POSCTL", 3: "AUTO_MISSION", 4: "AUTO_LOITER", 5: "AUTO_RTL",
    6: "POSITION_SLOW", 10: "ACRO", 12: "DESCEND", 13: "TERMINATION", 14: "OFFBOARD", 15: "STAB",
    17: "AUTO_TAKEOFF", 18: "AUTO_LAND", 19: "AUTO_FOLLOW_TARGET", 20: "AUTO_PRECLAND", 21: "ORBIT",
}  # fmt: skip
ORDERED = {"vehicle_status", "vehicle_local_position", "vehicle_land_detected", "vehicle_attitude"}
REASONS = (  # of failsafe_flags: what keeps PX4 from OFFBOARD, or from arming
    *("angular_velocity_invalid", "attitude_invalid", "local_position_invalid", "global_position_invalid"),
    *("home_position_invalid", "offboard_control_signal_lost", "battery_unhealthy"),
)


class Px4Telemetry:
    """State of one vehicle. Times are of the steady clock, seconds. Arguments: see `vehicles.make`."""

    def __init__(
        self,
        *,
        start: Enu,
        grid_origin: str = "",
        datum: Geodetic | None = None,
        datum_deg: tuple[float, float] | None = None,
    ) -> None:
        self.start, self.datum, self.datum_deg = start, datum, datum_deg
        self.frame: LocalFrame | None = None  # of PX4's local position in the grid; None: not known yet
        if grid_origin.startswith(LOCAL):
            self.datum, self.frame = None, LocalFrame(origin=Enu.parse(grid_origin.removeprefix(LOCAL)))
        elif grid_origin:
            self.datum = Geodetic.parse(grid_origin)
        self.status: Any = None  # the last VehicleStatus; None: none came yet
        self.position_s: float | None = None  # when the last position came that PX4 trusts
        self.vehicle_s = 0.0  # the vehicle's own time
        self.discarded: Counter[str] = Counter()
        self._reference: Geodetic | None = None  # origin of PX4's local position
        self._position: Enu | None = None
        self._estimate_ok = False
        self._estimate_s: float | None = None
        self._status_s: float | None = None
        self._batteries: dict[int, tuple[float, float, bool]] = {}  # charge, volts, failing
        self._orders = {name: StampOrder() for name in ORDERED}
        self._messages: dict[str, Any] = {}  # the last one by topic
        self._rejections: dict[str, str] = {}  # by command, the newest last
        self._stamp_us = 0

    @property
    def armed(self) -> bool:
        """Whether the vehicle is armed."""
        return self.status is not None and self.status.arming_state == ARMED

    def snapshot(self, other_controller: str | None = None) -> Telemetry:
        """The vehicle's state now."""
        mode, name = Mode.OTHER, ""
        if (status := self.status) is not None:
            mode = MODES.get(status.nav_state, Mode.OTHER)
            name = MODE_NAMES.get(status.nav_state, f"nav_state {status.nav_state}")
            name += " (failsafe)" if status.failsafe else ""
        grid_origin = LOCAL + self.frame.origin.to_text() if self.frame else ""
        if self.datum is not None:
            grid_origin = str(self.datum)
        home, attitude = self._home(), self._messages.get("vehicle_attitude")
        charge, volts, fails = min(self._batteries.values(), default=(None, None, False))
        return Telemetry(
            heartbeat_s=self._status_s,
            mode=mode,
            mode_name=name,
            armed=self.armed,
            on_ground=self._landed(),
            position=self._position,
            position_s=self.position_s,
            estimate_ok=self._estimate_ok,
            estimate_s=self._estimate_s,
            battery=charge,
            battery_v=volts or None,
            battery_fails=fails,
            vehicle_s=self.vehicle_s,
            missing=self._missing(),
            refusal=self._rejection(),
            home=self.frame.from_autopilot(home) if self.frame and home else None,
            tilt_rad=tilt_rad(*map(float, attitude.q)) if attitude is not None else None,
            other_controller=other_controller,
            system="" if status is None else f"system {status.system_id}",
            discarded=dict(self.discarded),
            autopilot="" if status is None else PX4.name,
            datum=self.datum,
            grid_origin=grid_origin,
        )

    def update(self, topic: str, message: Any, now_s: float) -> None:
        """Process a message, unless it is another vehicle's or out of order."""
        why: str | None = None
        status = self.status
        if topic == "vehicle_status" and status is not None and message.system_id != status.system_id:
            why = "of another system"
        elif (order := self._orders.get(topic)) is not None:
            why = order.check(message.timestamp / 1e6, now_s)
        if why is not None:
            self.discarded[why] += 1
            return
        self._messages[topic] = message
        if (handler := getattr(self, f"on_{topic}", None)) is not None:
            handler(message, now_s)

    def on_vehicle_status(self, message: Any, now_s: float) -> None:
        """Process a VehicleStatus."""
        self.status, self._status_s = message, now_s
        self._advance_time(message.timestamp)
        if self.armed:
            self._rejections.pop(COMMANDS[ARM], None)

    def on_vehicle_local_position(self, message: Any, now_s: float) -> None:
        """Process a VehicleLocalPosition; a position that PX4 does not trust is not used."""
        self._advance_time(message.timestamp)
        ned = Ned(message.x, message.y, message.z)
        valid = message.xy_valid and message.z_valid and message.v_xy_valid and message.v_z_valid
        self._estimate_s = now_s
        self._estimate_ok = valid and not message.dead_reckoning and all(map(math.isfinite, ned))
        if self._estimate_ok:
            self._locate(ned, _reference(message))
            if self.frame is not None:
                self._position, self.position_s = self.frame.from_autopilot(ned), now_s

    def on_battery_status(self, message: Any, now_s: float) -> None:
        """Process a BatteryStatus of one of the batteries."""
        if message.connected and message.remaining >= 0:
            fails = message.warning >= BATTERY_LOW
            self._batteries[message.id] = float(message.remaining), float(message.voltage_v), fails
        else:
            self._batteries.pop(message.id, None)

    def on_vehicle_command_ack(self, message: Any, now_s: float) -> None:
        """Process a VehicleCommandAck; those for other senders are ignored."""
        command = COMMANDS.get(message.command)
        system = None if self.status is None else self.status.system_id
        ours = (message.target_system, message.target_component) == (system, COMPANION)
        if command is None or not ours or message.result == IN_PROGRESS:
            return
        self._rejections.pop(command, None)
        if message.result != ACCEPTED:
            self._rejections[command] = RESULTS.get(message.result, f"result {message.result}")

    def _landed(self) -> bool | None:
        message = self._messages.get("vehicle_land_detected")
        return bool(message.landed) if message is not None else None

    def _home(self) -> Ned | None:
        message = self._messages.get("home_position")
        if message is None or not message.valid_lpos:
            return None
        ned = Ned(message.x, message.y, message.z)
        return ned if all(map(math.isfinite, ned)) else None

    def _locate(self, ned: Ned, reference: Geodetic | None) -> None:
        """Find PX4's local frame in the grid's.

        The first position on the ground is `start`, or has the altitude of `datum_deg`. Once PX4 knows the
        global position of its origin, the datum follows, and from then on the frame from the datum: PX4 may
        move its origin in flight.
        """
        landed = self._landed()
        on_ground = landed if landed is not None else self.status is not None and not self.armed
        if self.datum is None and self.frame is None and on_ground:
            if self.datum_deg is None:
                self.frame = LocalFrame(origin=self.start.minus(to_enu(ned)))
            elif reference is not None:
                self.datum = Geodetic(*self.datum_deg, reference.at(to_enu(ned)).altitude_m)
        if reference is None or reference == self._reference:
            return
        if self.datum is None and self.frame is not None:
            self.datum = reference.at(Enu(*(-o for o in self.frame.origin)))
        if self.datum is not None:
            self.frame, self._reference = LocalFrame(origin=reference.enu_from(self.datum)), reference

    def _advance_time(self, stamp_us: int) -> None:
        """Advance the vehicle's time; stamps leap when PX4 synchronises with the agent, or boots."""
        if not stamp_us:
            return
        passed_s = (stamp_us - self._stamp_us) / 1e6
        if 0 < passed_s <= MAX_STEP_S:
            self.vehicle_s += passed_s
        if passed_s > 0 or passed_s < -MAX_STEP_S:  # a smaller step back is a message that was overtaken
            self._stamp_us = stamp_us

    def _missing(self) -> str | None:
        if self.status is not None and self.status.system_type not in COPTERS:
            return f"PX4 has a vehicle of type {self.status.system_type}; expected a multicopter"
        if self._position is not None:
            return None
        if not self._estimate_ok:
            return "PX4 has no estimate of its position yet"
        if self.datum is not None:
            return "PX4 has no global position, and the grid has a datum; expected GPS, or no datum"
        if self.datum_deg is not None:
            return ALTITUDE_UNKNOWN
        return "the grid has no datum, and the vehicle does not stand on the ground; expected a datum"

    def _rejection(self) -> str | None:
        if not self._rejections:
            return None
        command, result = list(self._rejections.items())[-1]
        flags = self._messages.get("failsafe_flags")
        reasons = [flag.replace("_", " ") for flag in REASONS if getattr(flags, flag, False)]
        if not self.status.pre_flight_checks_pass:
            reasons.append("its preflight checks fail")
        return f"{command} refused: {result}" + (f" ({', '.join(reasons)})" if reasons else "")


def _reference(message: Any) -> Geodetic | None:
    """Global position of PX4's local origin; None: not known."""
    where = message.ref_lat, message.ref_lon, float(message.ref_alt)
    if not (message.xy_global and message.z_global and all(map(math.isfinite, where))):
        return None
    return Geodetic(*where)
