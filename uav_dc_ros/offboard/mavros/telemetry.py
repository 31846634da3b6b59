"""State of the vehicle, from what MAVROS publishes. No input or output, no ROS.

With mavros_msgs, mode, arming and landed state come from `mavros/state` and `mavros/extended_state`; without,
from MAVROS's diagnostics. The vehicle is not flown while its mode is unknown.
"""

import contextlib
import math
import re
from collections import Counter
from typing import Any

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.offboard.flight_stacks import (
    ARDUCOPTER,
    BATTERY,
    CONST_POS_MODE,
    FLYABLE,
    IN_AIR,
    ON_GROUND,
    PREARM_CHECK,
    PX4,
    FlightStack,
)
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mavros.diagnostics import Diagnostics
from uav_dc_ros.offboard.message_order import LEAP_S, MAX_SPEED, StampOrder
from uav_dc_ros.offboard.rejections import Rejections
from uav_dc_ros.offboard.vehicle import Mode, Telemetry

POSE, FIX = "mavros/local_position/pose", "mavros/global_position/global"
STATE, EXTENDED_STATE = "mavros/state", "mavros/extended_state"
HOME, TARGET = "mavros/home_position/home", "mavros/setpoint_raw/target_local"
SYS_STATUS, ESTIMATOR_STATUS = "mavros/sys_status", "mavros/estimator_status"
STATUS_TEXT = "mavros/statustext/recv"
MESSAGES = {  # of mavros_msgs, by topic
    STATE: "State", EXTENDED_STATE: "ExtendedState", SYS_STATUS: "SysStatus", HOME: "HomePosition",
    ESTIMATOR_STATUS: "EstimatorStatus", TARGET: "PositionTarget", STATUS_TEXT: "StatusText",
}  # fmt: skip
ESTIMATOR_FLAGS = (  # fields of EstimatorStatus: the bits of ESTIMATOR_STATUS_FLAGS, lowest first
    *("attitude", "velocity_horiz", "velocity_vert", "pos_horiz_rel", "pos_horiz_abs", "pos_vert_abs"),
    *("pos_vert_agl", "const_pos_mode", "pred_pos_horiz_rel", "pred_pos_horiz_abs", "gps_glitch"),
    "accel_error",
)
CUSTOM_MODE = re.compile(r"CMODE\((\d+)\)")  # MAVROS's text of a mode without a name
AHRS = 1 << 21  # MAV_SYS_STATUS_AHRS
NO_POSITION = 7  # PositionTarget.IGNORE_PX, IGNORE_PY, IGNORE_PZ
NO_VOLTAGE = 65.535  # MAVLink's UINT16_MAX millivolts

STALE_S = 3.0  # maximum age of a report on an estimate
MAX_FIX_AGE_S = 2.0  # of a fix that locates a vehicle on the ground
ALOFT_M = 1.0  # height above the start at which the vehicle has left the ground
STAMP_TIMEOUT_S = 0.5  # without a stamp, after which the vehicle's time follows the steady clock


class VehicleTime:
    """The vehicle's time, from the stamps of its poses: monotonic, and possibly faster than the steady clock.

    Stamps of MAVROS are the autopilot's time since boot, plus an offset that MAVROS keeps estimating. They
    may leap when the offset changes, and some sources leave them at zero.
    """

    def __init__(self) -> None:
        self._time_s, self._returned_s = 0.0, 0.0
        self._stamp_s, self._received_s = math.nan, math.nan

    def update(self, stamp_s: float, now_s: float) -> None:
        """Process a stamp received at a steady time, seconds."""
        if not math.isnan(self._received_s):
            passed_s, advance_s = now_s - self._received_s, stamp_s - self._stamp_s
            plausible = 0.0 < advance_s <= LEAP_S + MAX_SPEED * passed_s
            self._time_s += advance_s if plausible else passed_s
        self._stamp_s, self._received_s = stamp_s, now_s

    def at(self, now_s: float) -> float:
        """The vehicle's time at a steady time, seconds."""
        received_s = self._received_s
        silent_s = 0.0 if math.isnan(received_s) else max(0.0, now_s - received_s - STAMP_TIMEOUT_S)
        self._returned_s = max(self._returned_s, self._time_s + silent_s)
        return self._returned_s


class MavrosTelemetry:
    """State of one vehicle. Times are of the steady clock, seconds. Arguments: see `vehicles.make`."""

    def __init__(
        self,
        start: Enu,
        datum: Geodetic | None = None,
        grid_origin: str = "",
        has_msgs: bool = False,
        datum_deg: tuple[float, float] | None = None,
    ) -> None:
        if datum_deg is not None:
            datum = Geodetic(*datum_deg, 0.0)  # the ground under the vehicle
        self.start, self.datum, self.has_msgs = start, datum, has_msgs  # mavros_msgs is installed
        # Of MAVROS's local frame (its EKF's origin), in the grid's frame; None: not known yet.
        self.origin = Enu.parse(grid_origin) if grid_origin else None
        self.diagnostics, self.rejections = Diagnostics(), Rejections()
        self.yaw_rad = 0.0  # counter-clockwise from the east
        self.received_s: dict[str, float] = {}  # when a message came last, by topic
        # Of the grid on the Earth, its altitude only known from a datum; None: not known yet.
        self.corner = datum
        self.discarded: Counter[str] = Counter()
        self._messages: dict[str, Any] = {}  # of mavros_msgs: the last one by topic
        self._local: Enu | None = None
        self.pose_error = ""  # why the last pose was rejected
        self._fix: Geodetic | None = None
        self._batteries: dict[str, tuple[float | None, float | None]] = {}  # charge, volts
        self._time = VehicleTime()
        self._order = StampOrder()
        self._tilt_rad: float | None = None

    @property
    def flight_stack(self) -> FlightStack | None:
        """The vehicle's autopilot; None: not known yet."""
        return self.diagnostics.flight_stack

    @property
    def mode_name(self) -> str:
        """The autopilot's name of its mode."""
        if self.has_msgs:
            return self._messages[STATE].mode if STATE in self._messages else ""
        return self.diagnostics.mode_name

    @property
    def mode(self) -> Mode:
        """The vehicle's mode."""
        stack, mode_name = self.flight_stack, self.mode_name
        if stack is None:
            return Mode.OTHER
        if (custom := CUSTOM_MODE.fullmatch(mode_name)) is not None:
            return stack.mode(int(custom[1]))
        numbers = (number for number, name in stack.mode_names.items() if name == mode_name)
        return stack.mode(next(numbers, -1))

    @property
    def armed(self) -> bool | None:
        """Whether the vehicle is armed, or (ArduPilot without mavros_msgs) flies; None: not known."""
        if self.has_msgs:
            return bool(self._messages[STATE].armed) if STATE in self._messages else None
        return self.diagnostics.armed

    @property
    def landed_state(self) -> int | None:
        """MAV_LANDED_STATE, reported or inferred; None: not known."""
        if self.has_msgs:
            state = self._messages.get(EXTENDED_STATE)
            return (state.landed_state or None) if state is not None else None
        if not self.armed:
            return None if self.armed is None else ON_GROUND
        if self.flight_stack is ARDUCOPTER:
            return IN_AIR
        position = self.position
        return IN_AIR if position is not None and position.up_m > self.start.up_m + ALOFT_M else None

    @property
    def position(self) -> Enu | None:
        """Of the vehicle, in the grid's frame."""
        return self._in_grid(self._local)

    def _in_grid(self, local: Enu | None) -> Enu | None:
        return None if self.origin is None or local is None else self.origin.plus(local)

    def to_mavros(self, position: Enu) -> Enu:
        """A position of the grid in MAVROS's local ENU; the origin must be known."""
        assert self.origin is not None
        return position.minus(self.origin)

    @property
    def accepts_setpoints(self) -> bool:
        """Whether the origin is known, and the autopilot follows setpoints now."""
        stack = self.flight_stack
        return self.origin is not None and stack is not None and stack.accepts_setpoints(self.landed_state)

    def snapshot(self, now_s: float, other_controller: str | None = None) -> Telemetry:
        """The vehicle's state at a steady time."""
        landed_state, (enabled, health) = self.landed_state, self._sensors
        home, target = self._messages.get(HOME), self._messages.get(TARGET)
        if target is not None and target.type_mask & NO_POSITION:
            target = None
        batteries = self._batteries.values()
        reported = [battery for battery in batteries if battery[0] is not None] or batteries
        charge, volts = min(reported, key=lambda battery: battery[0] or 0.0, default=(None, None))
        if self.armed:
            self.rejections.accept("arming")
        return Telemetry(
            heartbeat_s=self.received_s.get(STATE) if self.has_msgs else self.diagnostics.heartbeat_s,
            mode=self.mode,
            mode_name=self.mode_name,
            armed=bool(self.armed),
            on_ground=None if landed_state is None else landed_state == ON_GROUND,
            position=self.position,
            position_s=self.received_s.get(POSE),
            estimate_ok=self._estimate_ok(now_s),
            estimate_s=self.received_s.get(ESTIMATOR_STATUS, self.received_s.get(SYS_STATUS)),
            battery=charge,
            battery_v=volts,
            battery_fails=bool(BATTERY & enabled & ~health),
            vehicle_s=self._time.at(now_s),
            missing=self._missing(now_s),
            refusal=self.rejections.latest(),
            status_text=self.rejections.recent_texts(now_s),
            home=self._in_grid(_finite(home.position) if home is not None else None),
            target=self._in_grid(_finite(target.position) if target is not None else None),
            target_s=self.received_s.get(TARGET),
            tilt_rad=self._tilt_rad,
            other_controller=other_controller,
            system=self.diagnostics.source,
            discarded=dict(self.discarded),
            autopilot=self.flight_stack.name if self.flight_stack else "",
            datum=self.corner,
            grid_origin=self.origin.to_text() if self.origin else "",
        )

    def required_topics(self) -> list[str]:
        """Topics that the mission requires, apart from the diagnostics."""
        if not self.has_msgs:
            return [POSE]
        estimate = [ESTIMATOR_STATUS] if self.flight_stack is PX4 else []  # ArduPilot sends another message
        return [STATE, EXTENDED_STATE, SYS_STATUS, *estimate, POSE]

    def _missing(self, now_s: float) -> str | None:
        diagnostics = self.diagnostics
        if self.pose_error and now_s - self.received_s.get(POSE, -math.inf) > STALE_S:
            return f"{POSE}: {self.pose_error}"
        lacking = [name for name in self.required_topics() if name not in self.received_s]
        if diagnostics.flight_stack is None and diagnostics.problem(now_s) is None:
            lacking.insert(0, "the status Heartbeat of MAVROS on /diagnostics")
        elif not self.has_msgs and diagnostics.health is None:
            lacking.insert(0, "the status System of MAVROS on /diagnostics")
        if lacking:
            return f"nothing received of {', '.join(lacking)}"
        if (problem := diagnostics.problem(now_s)) is not None:
            return problem
        if self.armed is None:
            return "the autopilot reports a failsafe, not whether it is armed; expected it to end that first"
        if not self.armed and not self._estimate_ok(now_s):
            return "the autopilot is not ready to arm, or has no position estimate yet"
        if self.origin is not None:
            return None
        where = "the position of the grid is not known"
        if self.landed_state != ON_GROUND:
            return f"{where}, and the vehicle does not stand on the ground; expected it to stand there first"
        return f"{where}: no fix on {FIX}" if self.datum else f"{where} yet"

    @property
    def _sensors(self) -> tuple[int, int]:
        """Enabled and healthy MAV_SYS_STATUS_SENSOR bits; the estimate is unhealthy before any came."""
        if (status := self._messages.get(SYS_STATUS)) is not None:
            return status.sensors_enabled, status.sensors_health
        enabled, health = self.diagnostics.enabled, self.diagnostics.health
        return (AHRS, 0) if enabled is None or health is None else (enabled, health)

    def _estimate_ok(self, now_s: float) -> bool:
        enabled, health = self._sensors
        arms = not self.armed and self.flight_stack is not None and self.flight_stack.reports_readiness
        if (AHRS | (PREARM_CHECK if arms else 0)) & enabled & ~health:
            return False
        if (status := self._messages.get(ESTIMATOR_STATUS)) is None:
            return True  # without an estimate there is no local position either
        reported = (getattr(status, f"{name}_status_flag") for name in ESTIMATOR_FLAGS)
        flags = sum(1 << bit for bit, flag in enumerate(reported) if flag)
        fresh = now_s - self.received_s[ESTIMATOR_STATUS] <= STALE_S
        return fresh and flags & FLYABLE == FLYABLE and not flags & CONST_POS_MODE

    def _locate(self, now_s: float) -> None:
        """Find MAVROS's origin in the grid, and the grid on the Earth; only while the vehicle stands."""
        if self._local is None or self.landed_state != ON_GROUND:
            return
        fix = self._fix if self._fix is not None and now_s - self.received_s[FIX] <= MAX_FIX_AGE_S else None
        if self.origin is None and self._estimate_ok(now_s):
            if self.datum is None:
                self.origin = self.start.minus(self._local)
            elif fix is not None:
                here = fix.enu_from(self.datum)._replace(up_m=self.start.up_m)
                self.origin = here.minus(self._local)
        position = self.position
        if self.corner is None and fix is not None and position is not None:
            with contextlib.suppress(VehicleError):  # only a grid with a datum needs pymap3d
                self.corner = fix.at(Enu(-position.east_m, -position.north_m, 0.0))

    # Standard messages.

    def on_pose(
        self, local: Enu, yaw_rad: float, stamp_s: float, now_s: float, tilt_rad: float | None = None
    ) -> None:
        """Process a pose in MAVROS's local frame."""
        if (why := self._order.check(stamp_s, now_s)) is not None:
            self.discarded[why] += 1
            return
        self._time.update(stamp_s, now_s)
        self.received_s[POSE] = now_s
        self._local, self.yaw_rad, self._tilt_rad, self.pose_error = local, yaw_rad, tilt_rad, ""
        self._locate(now_s)

    def on_fix(self, has_fix: bool, latitude_deg: float, longitude_deg: float, now_s: float) -> None:
        """Process a NavSatFix; its altitude (above the ellipsoid) is not used."""
        if has_fix and math.isfinite(latitude_deg + longitude_deg):
            self.received_s[FIX] = now_s
            altitude_m = self.datum.altitude_m if self.datum is not None else 0.0
            self._fix = Geodetic(latitude_deg, longitude_deg, altitude_m)

    def on_battery(self, location: str, charge: float, volts: float) -> None:
        """Process a BatteryState: charge, 0 to 1, and voltage; any other value is not known."""
        if location:
            self._batteries.pop("", None)  # the sum of all, before each was reported by itself
        known = charge if 0.0 <= charge <= 1.0 else None
        self._batteries[location] = known, volts if 0.0 < volts < NO_VOLTAGE else None

    def update(self, topic: str, message: Any, now_s: float) -> None:
        """Process a message of mavros_msgs; a State without a connection has no other content."""
        if topic == STATUS_TEXT:
            self.rejections.on_status_text(message.severity, message.text, now_s)
        elif topic != STATE or message.connected:
            self._messages[topic], self.received_s[topic] = message, now_s


def _finite(point: Any) -> Enu | None:
    """A geometry_msgs/Point with finite coordinates."""
    position = Enu(point.x, point.y, point.z)
    return position if all(map(math.isfinite, position)) else None
