"""What is known of a vehicle with PX4, from the messages of its uXRCE-DDS topics. No input or output.

Positions are in PX4's local NED here, and nowhere beyond.
"""

import math
from collections import Counter
from typing import Any

from uav_dc_ros.offboard.flight_stacks import COPTERS
from uav_dc_ros.offboard.frames import Enu, Geodetic, LocalFrame, Ned, tilt_rad, to_enu
from uav_dc_ros.offboard.stamp_order import StampOrder
from uav_dc_ros.offboard.vehicle import Mode, Telemetry

COMPANION = 191  # MAV_COMP_ID_ONBOARD_COMPUTER: as whom commands are sent, so that answers are told apart
CLOCK_S = 10.0  # between two messages; a longer time, or one back, is of another clock
LOCAL = "local:"  # before a grid origin of a vehicle that does not know where on the Earth it is

ARMED = 2  # ARMING_STATE
BATTERY_LOW = 1  # BATTERY_WARNING; what is above is worse
ACCEPTED, IN_PROGRESS = 0, 5  # VEHICLE_CMD_RESULT
RESULTS = {1: "temporarily rejected", 2: "denied", 3: "unsupported", 4: "failed", 6: "cancelled"}
COMMANDS = {20: "returning", 21: "landing", 176: "the change of mode", 400: "arming"}  # VEHICLE_CMD
MODES = {  # by NAVIGATION_STATE
    14: Mode.COMMANDED,
    4: Mode.HOLD,
    5: Mode.RETURN,
    12: Mode.LAND,  # DESCEND, which is to land without a position
    18: Mode.LAND,
    20: Mode.LAND,
}
MODE_NAMES = {
    0: "MANUAL",
    1: "ALTCTL",
    2: "POSCTL",
    3: "AUTO_MISSION",
    4: "AUTO_LOITER",
    5: "AUTO_RTL",
    6: "POSITION_SLOW",
    10: "ACRO",
    12: "DESCEND",
    13: "TERMINATION",
    14: "OFFBOARD",
    15: "STAB",
    17: "AUTO_TAKEOFF",
    18: "AUTO_LAND",
    19: "AUTO_FOLLOW_TARGET",
    20: "AUTO_PRECLAND",
    21: "ORBIT",
}
ORDERED = {"vehicle_status", "vehicle_local_position", "vehicle_land_detected", "vehicle_attitude"}
WHY = (  # of failsafe_flags: what keeps PX4 from OFFBOARD, or from arming
    "angular_velocity_invalid",
    "attitude_invalid",
    "local_position_invalid",
    "global_position_invalid",
    "home_position_invalid",
    "offboard_control_signal_lost",
    "battery_unhealthy",
)


class Px4Telemetry:
    """One vehicle, as its topics tell of it.

    Args:
        place: where it stands when its first position comes, in the grid's ENU frame.
        grid_origin: as `grid_origin` was before a restart: takes the place of a datum.
        datum: of the grid; None: see `place`.

    Raises:
        VehicleError: a grid origin that is none.

    Attributes:
        datum: of the grid, once it is known.
        frame: of PX4's local position, once it is known.
        status: the last VehicleStatus; None: none came yet.
        position_s: when the last position came that PX4 trusted, steady time, seconds.
        vehicle_s: the vehicle's own time, seconds.
        discarded: messages that were ignored, by reason.
    """

    def __init__(self, *, place: Enu, grid_origin: str = "", datum: Geodetic | None = None) -> None:
        self.place, self.datum = place, datum
        self.frame: LocalFrame | None = None
        if grid_origin.startswith(LOCAL):
            self.datum, self.frame = None, LocalFrame(origin=Enu.parse(grid_origin.removeprefix(LOCAL)))
        elif grid_origin:
            self.datum = Geodetic.parse(grid_origin)
        self.status: Any = None
        self.position_s: float | None = None
        self.vehicle_s = 0.0
        self._reference: Geodetic | None = None  # where PX4 counts its local position from
        self._position: Enu | None = None
        self._sure = False
        self._estimate_s: float | None = None  # when it last said whether it trusts its position
        self._status_s: float | None = None
        self._landed: bool | None = None
        self._batteries: dict[int, tuple[float, float, bool]] = {}  # by number: charge, volts, does it fail
        self._tilt_rad: float | None = None
        self._home: Ned | None = None
        self._orders = {name: StampOrder() for name in ORDERED}
        self.discarded: Counter[str] = Counter()
        self._flags: Any = None
        self._refusals: dict[str, str] = {}  # by what was refused, the latest at the end
        self._stamp_us = 0

    @property
    def grid_origin(self) -> str:
        """The grid's datum; where there is none, PX4's origin in the grid; empty until either is known."""
        if self.datum is not None:
            return str(self.datum)
        return LOCAL + self.frame.origin.to_text() if self.frame else ""

    @property
    def armed(self) -> bool:
        """Is it armed."""
        return self.status is not None and self.status.arming_state == ARMED

    def telemetry(self) -> Telemetry:
        """What is known now."""
        mode, name = Mode.OTHER, ""
        if (status := self.status) is not None:
            mode = MODES.get(status.nav_state, Mode.OTHER)
            name = MODE_NAMES.get(status.nav_state, f"nav_state {status.nav_state}")
            name += " (failsafe)" if status.failsafe else ""
        charge, volts, fails = min(self._batteries.values(), default=(None, None, False))
        return Telemetry(
            heartbeat_s=self._status_s,
            mode=mode,
            mode_name=name,
            armed=self.armed,
            on_ground=self._landed,
            position=self._position,
            position_s=self.position_s,
            estimate_ok=self._sure,
            estimate_s=self._estimate_s,
            battery=charge,
            battery_v=volts or None,
            battery_fails=fails,
            vehicle_s=self.vehicle_s,
            missing=self._missing(),
            refusal=self._refusal(),
            home=self.frame.from_autopilot(self._home) if self.frame and self._home else None,
            tilt_rad=self._tilt_rad,
            system="" if status is None else f"system {status.system_id}",
            discarded=dict(self.discarded),
        )

    # What it says.

    def hear(self, name: str, message: Any, now_s: float) -> None:
        """Take in a message of a topic, at a steady time, unless it is not this vehicle's or out of order."""
        why = None
        if (
            name == "vehicle_status"
            and self.status is not None
            and message.system_id != self.status.system_id
        ):
            why = "of another system"
        elif (order := self._orders.get(name)) is not None:
            why = order.refusal(message.timestamp / 1e6, now_s)
        if why is not None:
            self.discarded[why] += 1
            return
        getattr(self, f"on_{name}")(message, now_s)

    def on_vehicle_status(self, message: Any, now_s: float) -> None:
        """Take in its state, at a steady time; likewise the others."""
        self.status, self._status_s = message, now_s
        self._pass_time(message.timestamp)
        if self.armed:
            self._refusals.pop(COMMANDS[400], None)

    def on_vehicle_local_position(self, message: Any, now_s: float) -> None:
        """Take in where it is. A position that it does not trust is none."""
        self._pass_time(message.timestamp)
        ned = Ned(message.x, message.y, message.z)
        valid = message.xy_valid and message.z_valid and message.v_xy_valid and message.v_z_valid
        self._estimate_s = now_s
        self._sure = valid and not message.dead_reckoning and all(map(math.isfinite, ned))
        if self._sure:
            self._place(ned, _reference(message))
            if self.frame is not None:
                self._position, self.position_s = self.frame.from_autopilot(ned), now_s

    def on_vehicle_land_detected(self, message: Any, now_s: float) -> None:
        """Take in whether it stands."""
        self._landed = bool(message.landed)

    def on_battery_status(self, message: Any, now_s: float) -> None:
        """Take in the state of one of its batteries."""
        if message.connected and message.remaining >= 0:
            fails = message.warning >= BATTERY_LOW
            self._batteries[message.id] = float(message.remaining), float(message.voltage_v), fails
        else:
            self._batteries.pop(message.id, None)

    def on_vehicle_attitude(self, message: Any, now_s: float) -> None:
        """Take in how it is tilted."""
        self._tilt_rad = tilt_rad(*map(float, message.q))

    def on_home_position(self, message: Any, now_s: float) -> None:
        """Take in where it returns to."""
        ned = Ned(message.x, message.y, message.z)
        self._home = ned if message.valid_lpos and all(map(math.isfinite, ned)) else None

    def on_failsafe_flags(self, message: Any, now_s: float) -> None:
        """Take in what it finds wrong with itself."""
        self._flags = message

    def on_vehicle_command_ack(self, message: Any, now_s: float) -> None:
        """Take in the answer to a command; somebody else's come here, too."""
        what = COMMANDS.get(message.command)
        system = None if self.status is None else self.status.system_id
        ours = (message.target_system, message.target_component) == (system, COMPANION)
        if what is None or not ours or message.result == IN_PROGRESS:
            return
        self._refusals.pop(what, None)
        if message.result != ACCEPTED:
            self._refusals[what] = RESULTS.get(message.result, f"result {message.result}")

    # What follows from it.

    def _place(self, ned: Ned, reference: Geodetic | None) -> None:
        """Find where PX4's local frame lies in the grid's.

        The first position on the ground is `place`. As soon as PX4 knows where on the Earth it counts from,
        the datum follows, and from then on the frame from the datum: PX4 may move its origin in flight.
        """
        stands = self._landed if self._landed is not None else self.status is not None and not self.armed
        if self.datum is None and self.frame is None and stands:
            self.frame = LocalFrame(origin=self.place.minus(to_enu(ned)))
        if reference is None or reference == self._reference:
            return
        if self.datum is None and self.frame is not None:
            self.datum = reference.at(Enu(*(-o for o in self.frame.origin)))
        if self.datum is not None:
            self.frame, self._reference = LocalFrame(origin=reference.enu_from(self.datum)), reference

    def _pass_time(self, stamp_us: int) -> None:
        """Let its time go on. Its stamps leap where it agrees on a clock with the agent, or boots."""
        if not stamp_us:
            return  # without a stamp
        passed_s = (stamp_us - self._stamp_us) / 1e6
        if 0 < passed_s <= CLOCK_S:
            self.vehicle_s += passed_s
        if passed_s > 0 or passed_s < -CLOCK_S:  # what is older by less has been overtaken on its way
            self._stamp_us = stamp_us

    def _missing(self) -> str | None:
        if self.status is not None and self.status.system_type not in COPTERS:
            return f"PX4 has a vehicle of type {self.status.system_type}; expected a multicopter"
        if self._position is not None:
            return None
        if not self._sure:
            return "PX4 has no estimate of its position yet"
        if self.datum is not None:
            return (
                "PX4 does not know where on the Earth it is, and the grid has a datum; expected GPS, or none"
            )
        return "the grid has no datum, and the vehicle does not stand on the ground; expected a datum"

    def _refusal(self) -> str | None:
        if not self._refusals:
            return None
        what, result = list(self._refusals.items())[-1]
        why = [flag.replace("_", " ") for flag in WHY if getattr(self._flags, flag, False)]
        if not self.status.pre_flight_checks_pass:
            why.append("its preflight checks fail")
        return f"{what} refused: {result}" + (f" ({', '.join(why)})" if why else "")


def _reference(message: Any) -> Geodetic | None:
    """Where on the Earth a local position is counted from; None: PX4 does not know."""
    where = message.ref_lat, message.ref_lon, float(message.ref_alt)
    if not (message.xy_global and message.z_global and all(map(math.isfinite, where))):
        return None
    return Geodetic(latitude_deg=where[0], longitude_deg=where[1], altitude_m=where[2])
