"""Differences between ArduCopter and PX4.

Modes are MAVLink's `custom_mode`: plain numbers in ArduCopter; main mode and sub mode in one number in PX4.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from uav_dc_ros.offboard import limits
from uav_dc_ros.offboard.vehicle import Limits, Mode

ON_GROUND, IN_AIR, TAKING_OFF, LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE
COPTERS = frozenset({2, 3, 4, 13, 14, 15, 29, 35})  # MAV_TYPE of vehicles that hover
PREARM_CHECK, BATTERY = 1 << 28, 1 << 25  # MAV_SYS_STATUS_PREARM_CHECK, MAV_SYS_STATUS_SENSOR_BATTERY

# ESTIMATOR_STATUS_FLAGS of PX4; ArduPilot's EKF_STATUS_FLAGS have the same bits.
ATTITUDE, VELOCITY_HORIZ, VELOCITY_VERT = 1 << 0, 1 << 1, 1 << 2
POS_HORIZ_REL, POS_HORIZ_ABS, POS_VERT = 1 << 3, 1 << 4, 1 << 5
CONST_POS_MODE = 1 << 7  # the position is a constant, not an estimate
PRED_POS_HORIZ_REL, PRED_POS_HORIZ_ABS = 1 << 8, 1 << 9
FLYABLE = ATTITUDE | VELOCITY_HORIZ | VELOCITY_VERT | POS_HORIZ_ABS | POS_VERT
ARMABLE = FLYABLE | POS_HORIZ_REL | PRED_POS_HORIZ_REL | PRED_POS_HORIZ_ABS  # 0x33f


@dataclass(frozen=True, kw_only=True)
class FlightStack:
    """One kind of autopilot."""

    name: str
    modes: Mapping[int, Mode]  # by `custom_mode`; all others are `Mode.OTHER`
    mode_names: Mapping[int, str]
    custom_modes: Mapping[Mode, int]  # to request a mode
    estimate_message: str  # name of the message with the state of the position estimate
    ready_flags: int  # flags of that message that are required for arming
    reports_readiness: bool  # by SYS_STATUS, for the mode that it is to arm in; PX4: for the current mode
    takes_off_by_setpoint: bool  # and requires a stream; otherwise by a command, which setpoints interrupt
    parameters: limits.Names  # that hold its limits
    limits: Callable[[Mapping[str, float]], Limits]  # by the values of these parameters
    parameters_are_bytes: bool  # PARAM_VALUE holds the bytes of an integer
    earth_radius_m: float  # of its spherical Earth, see `frames.sphere_scale`

    def mode(self, custom_mode: int) -> Mode:
        """The bridge's mode."""
        return self.modes.get(custom_mode, Mode.OTHER)

    def mode_name(self, custom_mode: int) -> str:
        """The autopilot's name of a mode."""
        return self.mode_names.get(custom_mode, f"{custom_mode:#x}")

    def mode_parameters(self, mode: Mode) -> tuple[float, float]:
        """Parameters 2 and 3 of MAV_CMD_DO_SET_MODE."""
        custom_mode = self.custom_modes[mode]
        if custom_mode < 1 << 16:
            return float(custom_mode), 0.0
        return float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24)

    def accepts_setpoints(self, landed_state: int | None) -> bool:
        """Whether setpoints may be sent in a MAV_LANDED_STATE."""
        return self.takes_off_by_setpoint or landed_state == IN_AIR

    def estimate_ok(self, flags: int, health: int, armed: bool) -> bool:
        """Whether the autopilot trusts its position enough to fly by it, or, disarmed, to arm.

        Flags: of `estimate_message`. Health: `onboard_control_sensors_health` of SYS_STATUS.
        """
        if flags & CONST_POS_MODE:
            return False
        if armed:
            return flags & FLYABLE == FLYABLE
        ready = not self.reports_readiness or bool(health & PREARM_CHECK)
        return flags & self.ready_flags == self.ready_flags and ready


def px4_mode(main: int, sub: int = 0) -> int:
    """`custom_mode` of PX4's main and sub mode."""
    return main << 16 | sub << 24


ARDUCOPTER_MODES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE",
    9: "LAND", 11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW",
    19: "AVOID_ADSB", 20: "GUIDED_NOGPS", 21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW", 24: "ZIGZAG",
    25: "SYSTEMID", 26: "AUTOROTATE", 27: "AUTO_RTL", 28: "TURTLE",
}  # fmt: skip

ARDUCOPTER = FlightStack(
    name="ArduCopter",
    modes={4: Mode.COMMANDED, 5: Mode.HOLD, 17: Mode.HOLD, 6: Mode.RETURN, 21: Mode.RETURN, 9: Mode.LAND},
    mode_names=ARDUCOPTER_MODES,
    custom_modes={Mode.COMMANDED: 4, Mode.HOLD: 17, Mode.RETURN: 6, Mode.LAND: 9},
    estimate_message="EKF_STATUS_REPORT",
    ready_flags=ARMABLE,
    reports_readiness=True,
    takes_off_by_setpoint=False,
    parameters=limits.ARDUCOPTER,
    limits=limits.of_arducopter,
    parameters_are_bytes=False,
    earth_radius_m=6_378_100.0,
)

OFFBOARD, LOITER, RTL = px4_mode(6), px4_mode(4, 3), px4_mode(4, 5)
LAND, PRECLAND = px4_mode(4, 6), px4_mode(4, 9)
PX4_MODES = {
    px4_mode(1): "MANUAL", px4_mode(2): "ALTCTL", px4_mode(3): "POSCTL", px4_mode(5): "ACRO",
    OFFBOARD: "OFFBOARD", px4_mode(7): "STABILIZED", px4_mode(4, 1): "AUTO.READY",
    px4_mode(4, 2): "AUTO.TAKEOFF", LOITER: "AUTO.LOITER", px4_mode(4, 4): "AUTO.MISSION", RTL: "AUTO.RTL",
    LAND: "AUTO.LAND", px4_mode(4, 8): "AUTO.FOLLOW_TARGET", PRECLAND: "AUTO.PRECLAND",
}  # fmt: skip

PX4 = FlightStack(
    name="PX4",
    modes={
        OFFBOARD: Mode.COMMANDED,
        LOITER: Mode.HOLD,
        RTL: Mode.RETURN,
        LAND: Mode.LAND,
        PRECLAND: Mode.LAND,
    },
    mode_names=PX4_MODES,
    custom_modes={Mode.COMMANDED: OFFBOARD, Mode.HOLD: LOITER, Mode.RETURN: RTL, Mode.LAND: LAND},
    estimate_message="ESTIMATOR_STATUS",
    ready_flags=FLYABLE,
    reports_readiness=False,
    takes_off_by_setpoint=True,
    parameters=limits.PX4,
    limits=limits.of_px4,
    parameters_are_bytes=True,
    earth_radius_m=6_371_000.0,
)

FLIGHT_STACKS = {3: ARDUCOPTER, 12: PX4}  # by MAV_AUTOPILOT
