"""The bridge's ROS parameters: the way to the vehicle, and how carefully it is flown. Knows no ROS."""

from uav_dc_ros.nodes.framework.parameters import Parameter, one_of
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import MARGIN_M
from uav_dc_ros.topics import SYSTEM_MAX, VEHICLES

VEHICLE = Parameter(
    name="vehicle",
    default="mavlink",
    description=f"the way to the autopilot: one of {', '.join(VEHICLES)}",
    parse=one_of(*VEHICLES),
)
CONNECT = Parameter(
    name="connect",
    default="",
    description="where a vehicle on MAVLink is found, such as tcp:127.0.0.1:5760, udp:0.0.0.0:14550 or "
    "serial:/dev/ttyAMA0:921600",
)
DATUM = Parameter(
    name="datum",
    default="",
    description="where the grid's corner lies: here (the vehicle stands where the scenario starts when its "
    "first good position comes), last (as in the last flight), or latitude, longitude (degrees) and altitude "
    "(metres) with a comma between; needed with arm; empty: here",
)
SYSTEM = Parameter(
    name="system",
    default=0,
    least=0,
    most=SYSTEM_MAX,
    description="MAVLink system number of the vehicle; 0: the only autopilot on the link",
)
FENCE_MARGIN_M = Parameter(
    name="fence_margin_m",
    default=MARGIN_M,
    least=1.0,
    most=1000.0,
    unit="m",
    description="how far the fence lies around the grid, and above its highest altitude",
)


def _setting(name: str, description: str, unit: str = "", least: float = 0.0, most: float = 0.0) -> Parameter:
    """A parameter that is a field of `SafetySettings`, and has its default."""
    default = getattr(SafetySettings, name)
    if isinstance(default, bool):
        return Parameter(name=name, default=default, description=description)
    return Parameter(name=name, default=default, least=least, most=most, unit=unit, description=description)


SETTINGS = (
    _setting("arm", "true: the bridge sets the mode and arms; false: it waits until a pilot has done so"),
    _setting("tolerance_m", "distance to a cell's centre that counts as reached", "m", 0.1, 50.0),
    _setting("dwell_s", "time at the cell's centre that completes a step, vehicle time", "s", 0.0, 60.0),
    _setting("position_timeout_s", "maximum age of the position; an older one is a fault", "s", 0.1, 10.0),
    _setting(
        "heartbeat_timeout_s",
        "maximum age of the last heartbeat; after that the link is lost",
        "s",
        1.5,
        60.0,
    ),
    _setting("policy_timeout_steps", "timeout of the policy, in durations of a step", "", 0.1, 100.0),
    _setting("policy_timeout_s", "minimum timeout of the policy, by this computer's clock", "s", 0.0, 600.0),
    _setting("max_speed_mps", "maximum speed; a faster change of position is a jump", "m/s", 1.0, 100.0),
    _setting("max_position_jump_m", "maximum jump of a position that is accepted", "m", 0.1, 100.0),
    _setting("fault_timeout_s", "fault timer: a fault that lasts longer ends the mission", "s", 0.1, 600.0),
    _setting(
        "link_lost_timeout_s", "time without a heartbeat after which the bridge gives up", "s", 1.0, 3600.0
    ),
    _setting("min_battery", "minimum battery charge, 0 to 1; below it the mission ends", "", 0.0, 1.0),
    Parameter(
        name="failsafe_action",
        default=str(SafetySettings.failsafe_action),
        description="failsafe action of the bridge: return or land",
        parse=one_of("return", "land"),
    ),
    Parameter(
        name="flying_at_start",
        default=SafetySettings.flying_at_start,
        description="action when the bridge starts beside a vehicle in the commanded mode: resume or land",
        parse=one_of("resume", "land"),
    ),
    _setting("command_retry_s", "pause before a request is repeated, vehicle time", "s", 0.5, 60.0),
    _setting(
        "max_return_attempts", "number of requests to return before the bridge requests land", "", 1, 100
    ),
    _setting(
        "takeoff_timeout_s",
        "longest time for take-off and the way to the start, vehicle time",
        "s",
        5.0,
        3600.0,
    ),
    _setting(
        "max_offset_cells", "how far from its cell a step may end whose time is over", "cells", 0.0, 1.0
    ),
    _setting("progress_timeout_s", "time to come nearer to a cell after that, vehicle time", "s", 1.0, 600.0),
    _setting("target_timeout_s", "how long the autopilot may report another target", "s", 1.0, 600.0),
    _setting("landing_radius_m", "distance from the dock within which it has landed there", "m", 0.1, 1000.0),
    _setting(
        "return_progress_timeout_s", "time to come nearer to home on a return, vehicle time", "s", 5.0, 3600.0
    ),
    _setting(
        "landing_progress_timeout_s",
        "time to come lower or disarm while it lands, vehicle time",
        "s",
        5.0,
        3600.0,
    ),
    _setting("max_tilt_deg", "a vehicle that is tilted further does not fly any more", "deg", 10.0, 180.0),
    _setting("max_sink_m", "how far it may sink below its setpoint", "m", 1.0, 1000.0),
    _setting(
        "crash_timeout_s", "how long it may be beyond these two, or on the ground in flight", "s", 0.1, 60.0
    ),
)
