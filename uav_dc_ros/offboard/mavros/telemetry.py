"""What is known of the vehicle, from what MAVROS publishes. No input or output, no ROS.

With mavros_msgs, its mode, and whether it is armed and stands, come from `mavros/state` and
`mavros/extended_state`. Without, they follow from MAVROS's diagnostics. Nobody is steered whose mode is not
known, with mavros_msgs or without.
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
from uav_dc_ros.offboard.mavros.vehicle_time import VehicleTime
from uav_dc_ros.offboard.stamp_order import StampOrder
from uav_dc_ros.offboard.vehicle import Mode, Telemetry

POSE, FIX = "mavros/local_position/pose", "mavros/global_position/global"
STATE, EXTENDED_STATE = "mavros/state", "mavros/extended_state"
HOME, TARGET = "mavros/home_position/home", "mavros/setpoint_raw/target_local"
SYS_STATUS, ESTIMATOR_STATUS = "mavros/sys_status", "mavros/estimator_status"
ESTIMATOR_FLAGS = (  # fields of EstimatorStatus: the bits of ESTIMATOR_STATUS_FLAGS, from the least on
    *("attitude", "velocity_horiz", "velocity_vert", "pos_horiz_rel", "pos_horiz_abs", "pos_vert_abs"),
    *("pos_vert_agl", "const_pos_mode", "pred_pos_horiz_rel", "pred_pos_horiz_abs", "gps_glitch"),
    "accel_error",
)
CUSTOM_MODE = re.compile(r"CMODE\((\d+)\)")  # how MAVROS writes a mode that it has no name for
AHRS = 1 << 21  # MAV_SYS_STATUS_AHRS
NO_POSITION = 7  # PositionTarget.IGNORE_PX, IGNORE_PY, IGNORE_PZ
NO_VOLTAGE = 65.535  # MAVLink's UINT16_MAX millivolts

STALE_S = 3.0  # age after which the last report on an estimate says nothing
FIX_S = 2.0  # age of a fix that still belongs to a vehicle on the ground
ALOFT_M = 1.0  # above where it stood: it does not stand there any more


class MavrosTelemetry:
    """One vehicle, as MAVROS tells of it. Times are steady, seconds; positions metres.

    Args:
        place: where the vehicle stands when its first position comes, in the grid's ENU frame.
        datum: of the grid: gives that place across, from a fix on the ground; `place` only gives the height.
        grid_origin: `origin` as text, of a transport before it was started again: needs neither.
        full: is mavros_msgs there?

    Attributes:
        origin: where MAVROS counts from (its EKF's origin), in the grid's frame; None: not known yet.
        yaw_rad: of the vehicle, counter-clockwise from the east.
        heard: when something last came on each topic.
        diagnostics: what MAVROS tells there.
        corner: of the grid on the Earth; of unknown altitude, unless there is a datum; None: not known yet.
        discarded: messages that were ignored, by reason.

    Raises:
        VehicleError: the grid origin is invalid.
    """

    def __init__(
        self, place: Enu, datum: Geodetic | None = None, grid_origin: str = "", full: bool = False
    ) -> None:
        self.place, self.datum, self.full = place, datum, full
        self.origin = Enu.parse(grid_origin) if grid_origin else None
        self.diagnostics = Diagnostics()
        self.yaw_rad = 0.0
        self.heard: dict[str, float] = {}
        self._state: Any = None  # the last one of a vehicle that was connected
        self._landed_state = 0
        self._sys_status: Any = None
        self._flags: int | None = None
        self._local: Enu | None = None
        self._refused = ""  # why the last pose was not taken
        self._fix: Geodetic | None = None
        self._batteries: dict[str, tuple[float | None, float | None]] = {}  # charge, volts
        self._time = VehicleTime()
        self._order = StampOrder()
        self._tilt_rad: float | None = None
        self._home: Enu | None = None  # in MAVROS's frame, as the next
        self._target: Enu | None = None
        self.corner = datum
        self.discarded: Counter[str] = Counter()

    @property
    def dialect(self) -> FlightStack | None:
        """What kind of autopilot it has."""
        return self.diagnostics.dialect

    @property
    def mode_name(self) -> str:
        """What the autopilot calls its mode."""
        if self.full:
            return self._state.mode if self._state is not None else ""
        return self.diagnostics.mode_name

    @property
    def mode(self) -> Mode:
        """What the vehicle does."""
        dialect, told = self.dialect, self.mode_name
        if dialect is None:
            return Mode.OTHER
        if (custom := CUSTOM_MODE.fullmatch(told)) is not None:
            return dialect.mode(int(custom[1]))
        numbers = (number for number, name in dialect.mode_names.items() if name == told)
        return dialect.mode(next(numbers, -1))

    @property
    def armed(self) -> bool | None:
        """Is it, or does it fly; None: not known."""
        if self.full:
            return None if self._state is None else bool(self._state.armed)
        return self.diagnostics.armed

    @property
    def landed_state(self) -> int | None:
        """MAV_LANDED_STATE, as it is told, or as it follows from the rest; None: not known."""
        if self.full:
            return self._landed_state or None
        if not self.armed:
            return None if self.armed is None else ON_GROUND
        if self.dialect is ARDUCOPTER:
            return IN_AIR
        position = self.position
        return IN_AIR if position is not None and position.up_m > self.place.up_m + ALOFT_M else None

    @property
    def position(self) -> Enu | None:
        """In the grid's frame."""
        return self._in_grid(self._local)

    def _in_grid(self, local: Enu | None) -> Enu | None:
        """A position in MAVROS's frame, in the grid's."""
        if self.origin is None or local is None:
            return None
        return self.origin.plus(local)

    def to_mavros(self, position: Enu) -> Enu:
        """A position of the grid, as MAVROS's local ENU; the origin must be known."""
        assert self.origin is not None, "nobody is steered before"
        return position.minus(self.origin)

    @property
    def takes_setpoints(self) -> bool:
        """Do setpoints help now, and is it known where they lie."""
        return (
            self.origin is not None
            and self.dialect is not None
            and self.dialect.accepts_setpoints(self.landed_state)
        )

    def telemetry(self, now_s: float, refusal: str | None = None, said: str = "") -> Telemetry:
        """What is known now, with what was refused last, and what the autopilot said lately."""
        landed_state = self.landed_state
        enabled, health = self._sensors
        told = [battery for battery in self._batteries.values() if battery[0] is not None]
        charge, volts = min(told or self._batteries.values(), key=lambda b: b[0] or 0.0, default=(None, None))
        return Telemetry(
            heartbeat_s=self.heard.get(STATE) if self.full else self.diagnostics.heartbeat_s,
            mode=self.mode,
            mode_name=self.mode_name,
            armed=bool(self.armed),
            on_ground=None if landed_state is None else landed_state == ON_GROUND,
            position=self.position,
            position_s=self.heard.get(POSE),
            estimate_ok=self._estimate_ok(now_s),
            estimate_s=self.heard.get(ESTIMATOR_STATUS, self.heard.get(SYS_STATUS)),
            battery=charge,
            battery_v=volts,
            battery_fails=bool(BATTERY & enabled & ~health),
            vehicle_s=self._time.at(now_s),
            missing=self._missing(now_s),
            refusal=refusal,
            status_text=said,
            home=self._in_grid(self._home),
            target=self._in_grid(self._target),
            target_s=self.heard.get(TARGET),
            tilt_rad=self._tilt_rad,
            system=self.diagnostics.source,
            discarded=dict(self.discarded),
        )

    def wanted(self) -> list[str]:
        """Topics that nobody flies without, apart from the diagnostics."""
        if not self.full:
            return [POSE]
        estimate = [ESTIMATOR_STATUS] if self.dialect is PX4 else []  # ArduPilot's is another message
        return [STATE, EXTENDED_STATE, SYS_STATUS, *estimate, POSE]

    def _missing(self, now_s: float) -> str | None:
        diagnostics = self.diagnostics
        if self._refused and now_s - self.heard.get(POSE, -math.inf) > STALE_S:
            return f"{POSE}: {self._refused}"
        lacking = [name for name in self.wanted() if name not in self.heard]
        if diagnostics.dialect is None and diagnostics.problem(now_s) is None:
            lacking.insert(0, "the status Heartbeat of MAVROS on /diagnostics")
        elif not self.full and diagnostics.health is None:
            lacking.insert(0, "the status System of MAVROS on /diagnostics")
        if lacking:
            return f"nothing has come of {', '.join(lacking)}"
        if (problem := diagnostics.problem(now_s)) is not None:
            return problem
        if self.armed is None:
            return (
                "the autopilot tells of a failsafe, and not whether it is armed; expected it in order first"
            )
        if not self.armed and not self._estimate_ok(now_s):
            return "the autopilot is not ready to arm, or has no position estimate yet"
        if self.origin is not None:
            return None
        where = "where the grid lies is not known"
        if self.landed_state != ON_GROUND:
            return f"{where}, and the vehicle does not stand on the ground; expected it to stand there first"
        return f"{where}: no fix on {FIX}" if self.datum else f"{where} yet"

    @property
    def _sensors(self) -> tuple[int, int]:
        """MAV_SYS_STATUS_SENSOR bits: what is enabled, and what of it is well; all ill before any came."""
        if self.full and self._sys_status is not None:
            return self._sys_status.sensors_enabled, self._sys_status.sensors_health
        enabled, health = self.diagnostics.enabled, self.diagnostics.health
        return (AHRS, 0) if enabled is None or health is None else (enabled, health)

    def _estimate_ok(self, now_s: float) -> bool:
        """Does the autopilot trust its estimate: without one it sends no local position at all."""
        enabled, health = self._sensors
        arms = not self.armed and self.dialect is not None and self.dialect.reports_readiness
        if (AHRS | (PREARM_CHECK if arms else 0)) & enabled & ~health:
            return False
        if self._flags is None:
            return True
        fresh = now_s - self.heard[ESTIMATOR_STATUS] <= STALE_S
        return fresh and self._flags & FLYABLE == FLYABLE and not self._flags & CONST_POS_MODE

    def _anchor(self, now_s: float) -> None:
        """Find out where MAVROS counts from: only on the ground, where the vehicle stands still."""
        if self.origin is not None or self._local is None or self.landed_state != ON_GROUND:
            return
        if not self._estimate_ok(now_s):
            return
        here = self.place
        if self.datum is not None:
            if self._fix is None or now_s - self.heard[FIX] > FIX_S:
                return
            east_m, north_m, _ = self._fix.enu_from(self.datum)
            here = Enu(east_m, north_m, self.place.up_m)
        self.origin = here.minus(self._local)

    def _find_corner(self, now_s: float) -> None:
        """Find out where the grid lies on the Earth, from a fix of a vehicle that stands."""
        fix, position = self._fix, self.position
        if self.corner is not None or fix is None or position is None or self.landed_state != ON_GROUND:
            return
        if now_s - self.heard[FIX] <= FIX_S:
            with contextlib.suppress(VehicleError):  # who has no datum needs no Earth
                self.corner = fix.at(Enu(-position.east_m, -position.north_m, 0.0))

    # What it says: standard messages.

    def on_pose(
        self, local: Enu, yaw_rad: float, stamp_s: float, now_s: float, tilt_rad: float | None = None
    ) -> None:
        """A pose in MAVROS's local frame; `now_s`: when it arrived."""
        if (why := self._order.refusal(stamp_s, now_s)) is not None:
            self.discarded[why] += 1
            return
        self._time.hear(stamp_s, now_s)
        self.heard[POSE] = now_s
        self._local, self.yaw_rad, self._tilt_rad, self._refused = local, yaw_rad, tilt_rad, ""
        self._anchor(now_s)
        self._find_corner(now_s)

    def on_bad_pose(self, why: str) -> None:
        """A pose that nobody flies by, and why."""
        self._refused = why

    def on_fix(self, has_fix: bool, latitude_deg: float, longitude_deg: float, now_s: float) -> None:
        """Where the autopilot's estimate is on the Earth. Its altitude (above the ellipsoid) is not used."""
        if has_fix and math.isfinite(latitude_deg + longitude_deg):
            self.heard[FIX] = now_s
            altitude_m = self.datum.altitude_m if self.datum is not None else 0.0
            self._fix = Geodetic(
                latitude_deg=latitude_deg, longitude_deg=longitude_deg, altitude_m=altitude_m
            )

    def on_battery(self, where: str, charge: float, volts: float) -> None:
        """A battery's charge, 0 to 1, and voltage; anything else: it does not tell."""
        if where:
            self._batteries.pop("", None)  # what stood for all of them before one was told by itself
        known = charge if 0.0 <= charge <= 1.0 else None
        self._batteries[where] = known, volts if 0.0 < volts < NO_VOLTAGE else None

    # What it says: messages of mavros_msgs.

    def on_state(self, state: Any, now_s: float) -> None:
        """State: one for each heartbeat, and one when the link is lost, which says nothing else."""
        if state.connected:
            self._state, self.heard[STATE] = state, now_s

    def on_extended_state(self, state: Any, now_s: float) -> None:
        """ExtendedState."""
        self.heard[EXTENDED_STATE], self._landed_state = now_s, state.landed_state

    def on_sys_status(self, status: Any, now_s: float) -> None:
        """SysStatus."""
        self.heard[SYS_STATUS], self._sys_status = now_s, status

    def on_estimator_status(self, status: Any, now_s: float) -> None:
        """EstimatorStatus."""
        self.heard[ESTIMATOR_STATUS] = now_s
        flags = (getattr(status, f"{name}_status_flag") for name in ESTIMATOR_FLAGS)
        self._flags = sum(1 << bit for bit, flag in enumerate(flags) if flag)

    def on_home(self, home: Any) -> None:
        """HomePosition: its `position` is in MAVROS's frame."""
        self._home = _finite(home.position)

    def on_target(self, target: Any, now_s: float) -> None:
        """PositionTarget that the autopilot follows."""
        self.heard[TARGET] = now_s
        self._target = None if target.type_mask & NO_POSITION else _finite(target.position)


def _finite(point: Any) -> Enu | None:
    """A geometry_msgs/Point; None: it is none."""
    position = Enu(point.x, point.y, point.z)
    return position if all(map(math.isfinite, position)) else None
