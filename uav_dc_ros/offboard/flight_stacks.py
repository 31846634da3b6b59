"""What ArduCopter and PX4 do differently, as far as this system asks for it.

Modes are MAVLink's `custom_mode`: ArduCopter's are plain numbers; PX4 packs a main and a sub mode into one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from uav_dc_ros.offboard import limits
from uav_dc_ros.offboard.vehicle import Limits, Mode

ON_GROUND, IN_AIR, TAKING_OFF, LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE
COPTERS = frozenset({2, 3, 4, 13, 14, 15, 29, 35})  # MAV_TYPE of what hovers
PREARM_CHECK, BATTERY = 1 << 28, 1 << 25  # MAV_SYS_STATUS_PREARM_CHECK, MAV_SYS_STATUS_SENSOR_BATTERY

# ESTIMATOR_STATUS_FLAGS of PX4, which ArduPilot's EKF_STATUS_FLAGS follow.
ATTITUDE, VELOCITY_ACROSS, VELOCITY_UP, ACROSS_RELATIVE, ACROSS, UP = (1 << bit for bit in range(6))
MADE_UP = 1 << 7  # "constant position mode": it only pretends to know where it is
PREDICTED_RELATIVE, PREDICTED = 1 << 8, 1 << 9  # would know, once it flies
FLYABLE = ATTITUDE | VELOCITY_ACROSS | VELOCITY_UP | ACROSS | UP
ARMABLE = FLYABLE | ACROSS_RELATIVE | PREDICTED_RELATIVE | PREDICTED  # 0x33f


@dataclass(frozen=True, kw_only=True)
class FlightStack:
    """One kind of autopilot.

    Attributes:
        name: what people call it.
        modes: what its modes are here; those that are left out are another's business.
        names: what it calls them.
        asked: the mode to ask for.
        estimate_message: name of the message that carries the state of its position estimate.
        ready_flags: of that message, before it arms.
        tells_readiness: does SYS_STATUS say whether it would arm? PX4's does for the mode that it is in,
            which is not the one that it is to arm in.
        climbs_by_setpoint: takes off by setpoints, and wants to see some before it follows any. Otherwise it
            is given a command to take off, and setpoints would interrupt that.
        parameters: names of those that hold its limits.
        limits: what their values mean.
        parameters_are_bytes: does it send a parameter's bytes, where that is an integer?
        earth_radius_m: of the sphere that it takes the Earth for, see `frames.sphere_scale`.
    """

    name: str
    modes: Mapping[int, Mode]
    names: Mapping[int, str]
    asked: Mapping[Mode, int]
    estimate_message: str
    ready_flags: int
    tells_readiness: bool
    climbs_by_setpoint: bool
    parameters: limits.Names
    limits: Callable[[Mapping[str, float]], Limits]
    parameters_are_bytes: bool
    earth_radius_m: float

    def mode(self, custom_mode: int) -> Mode:
        """What a mode is here."""
        return self.modes.get(custom_mode, Mode.OTHER)

    def mode_name(self, custom_mode: int) -> str:
        """What the autopilot calls a mode."""
        return self.names.get(custom_mode, f"{custom_mode:#x}")

    def mode_parameters(self, mode: Mode) -> tuple[float, float]:
        """Parameters 2 and 3 of MAV_CMD_DO_SET_MODE."""
        custom_mode = self.asked[mode]
        if custom_mode < 1 << 16:
            return float(custom_mode), 0.0
        return float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24)

    def takes_setpoints(self, landed_state: int | None) -> bool:
        """Do setpoints help now, on the ground or in the air."""
        return self.climbs_by_setpoint or landed_state == IN_AIR

    def estimate_ok(self, flags: int, health: int, armed: bool) -> bool:
        """Does it trust its position enough to fly by it, or on the ground: to arm.

        Args:
            flags: of `estimate_message`.
            health: of SYS_STATUS.
            armed: is it.
        """
        if flags & MADE_UP:
            return False
        if armed:
            return flags & FLYABLE == FLYABLE
        ready = not self.tells_readiness or bool(health & PREARM_CHECK)
        return flags & self.ready_flags == self.ready_flags and ready


def px4_mode(main: int, sub: int = 0) -> int:
    """`custom_mode` of PX4's main and sub mode."""
    return main << 16 | sub << 24


ARDUCOPTER = FlightStack(
    name="ArduCopter",
    modes={4: Mode.COMMANDED, 5: Mode.HOLD, 17: Mode.HOLD, 6: Mode.RETURN, 21: Mode.RETURN, 9: Mode.LAND},
    names={
        0: "STABILIZE",
        1: "ACRO",
        2: "ALT_HOLD",
        3: "AUTO",
        4: "GUIDED",
        5: "LOITER",
        6: "RTL",
        7: "CIRCLE",
        9: "LAND",
        11: "DRIFT",
        13: "SPORT",
        14: "FLIP",
        15: "AUTOTUNE",
        16: "POSHOLD",
        17: "BRAKE",
        18: "THROW",
        19: "AVOID_ADSB",
        20: "GUIDED_NOGPS",
        21: "SMART_RTL",
        22: "FLOWHOLD",
        23: "FOLLOW",
        24: "ZIGZAG",
        25: "SYSTEMID",
        26: "AUTOROTATE",
        27: "AUTO_RTL",
        28: "TURTLE",
    },
    asked={Mode.COMMANDED: 4, Mode.HOLD: 17, Mode.RETURN: 6, Mode.LAND: 9},
    estimate_message="EKF_STATUS_REPORT",
    ready_flags=ARMABLE,
    tells_readiness=True,
    climbs_by_setpoint=False,
    parameters=limits.ARDUCOPTER,
    limits=limits.of_arducopter,
    parameters_are_bytes=False,
    earth_radius_m=6_378_100.0,
)

PX4 = FlightStack(
    name="PX4",
    modes={
        px4_mode(6): Mode.COMMANDED,
        px4_mode(4, 3): Mode.HOLD,
        px4_mode(4, 5): Mode.RETURN,
        px4_mode(4, 6): Mode.LAND,
        px4_mode(4, 9): Mode.LAND,
    },
    names={
        px4_mode(1): "MANUAL",
        px4_mode(2): "ALTCTL",
        px4_mode(3): "POSCTL",
        px4_mode(5): "ACRO",
        px4_mode(6): "OFFBOARD",
        px4_mode(7): "STABILIZED",
        px4_mode(4, 1): "AUTO.READY",
        px4_mode(4, 2): "AUTO.TAKEOFF",
        px4_mode(4, 3): "AUTO.LOITER",
        px4_mode(4, 4): "AUTO.MISSION",
        px4_mode(4, 5): "AUTO.RTL",
        px4_mode(4, 6): "AUTO.LAND",
        px4_mode(4, 8): "AUTO.FOLLOW_TARGET",
        px4_mode(4, 9): "AUTO.PRECLAND",
    },
    asked={
        Mode.COMMANDED: px4_mode(6),
        Mode.HOLD: px4_mode(4, 3),
        Mode.RETURN: px4_mode(4, 5),
        Mode.LAND: px4_mode(4, 6),
    },
    estimate_message="ESTIMATOR_STATUS",
    ready_flags=FLYABLE,
    tells_readiness=False,
    climbs_by_setpoint=True,
    parameters=limits.PX4,
    limits=limits.of_px4,
    parameters_are_bytes=True,
    earth_radius_m=6_371_000.0,
)

DIALECTS = {3: ARDUCOPTER, 12: PX4}  # by MAV_AUTOPILOT
