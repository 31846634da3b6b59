"""ROS parameters of the nodes, one row each, with default, description, unit and range. Needs no ROS."""

import contextlib
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

import msgspec

from uav_dc_ros.bags import COMPRESSIONS
from uav_dc_ros.core import pace
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.messages import Run
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import MARGIN_M
from uav_dc_ros.run_config import SEARCH_MAX, SEARCH_TIME_S
from uav_dc_ros.topics import SIMULATED, SYSTEM_MAX, VEHICLES

EXTERNAL = "external"  # value of the world's `vehicle` beside a bridge
INTEGER_MAX = 2**63 - 1  # of a ROS integer


@dataclass(frozen=True)
class Parameter:
    """A ROS parameter, of the type of its default. It can be set while its node is unconfigured."""

    name: str
    default: bool | int | float | str | list[str]
    description: str
    unit: str = ""  # empty for names, counts and switches
    min: float | None = None  # of a number
    max: float | None = None
    _: KW_ONLY
    choices: tuple[str, ...] = ()  # allowed texts; empty: any
    read_only: bool = False  # the value is fixed when the node starts
    parse: Callable[[Any], Any] | None = None  # returns what the node uses; raises ParameterError

    @property
    def help(self) -> str:
        """Description, unit and choices, as ROS and `--help` show them."""
        choices = f"; {self.expected}" if self.choices else ""
        return f"{self.description}{f' [{self.unit}]' if self.unit else ''}{choices}"

    @property
    def expected(self) -> str:
        """Type and range of the value, in words."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        if self.min is None:
            return {bool: "true or false", list: "a list of texts"}.get(type(self.default), "text")
        kind = "a whole number" if isinstance(self.default, int) else "a number"
        return f"{kind} from {self.min} to {self.max}{f' {self.unit}' if self.unit else ''}"

    def typed(self, value: Any) -> Any:
        """Convert a value to the parameter's type where that loses nothing: `dwell_s:=1`, `pace:=90`."""
        if isinstance(self.default, list):
            return list(value) if isinstance(value, list | tuple) else value
        if isinstance(self.default, str) and isinstance(value, bool | int | float):
            return str(value)
        if type(self.default) is float and type(value) is int:
            with contextlib.suppress(OverflowError):
                return float(value)
        return value

    def value(self, given: Any) -> Any:
        """Check a value and return what the node uses; raises ParameterError for an invalid one."""
        value = self.typed(given)
        is_valid = type(value) is type(self.default) and (not self.choices or value in self.choices)
        if not is_valid or (self.min is not None and not self.min <= value <= (self.max or 0)):
            raise ParameterError(f"{self.name}: {value!r}; expected {self.expected}")
        if self.parse is None:
            return value
        try:
            return self.parse(value)
        except ParameterError as error:
            raise ParameterError(f"{self.name}: {error}") from None


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")] if text.strip() else []
    if "" in names:
        raise ParameterError(f"{text!r}; expected names of topics with a comma between")
    return names


def _run(text: str) -> str:
    try:
        return msgspec.convert(text, Run)
    except msgspec.ValidationError:
        raise ParameterError(f"{text!r}; expected 16 hexadecimal digits in lower case, as a text") from None


# Of every node.
COMMON = (
    Parameter(
        "autostart",
        True,
        "configure and activate at once; false: wait for a lifecycle manager",
        read_only=True,
    ),
    Parameter(
        "peers",
        ["world", "channel_monitor", "policy"],
        "nodes of this mission, by name; it starts when all of them are there",
        read_only=True,
    ),
    Parameter(
        "run",
        "",
        "identity of this run of missions, 16 hexadecimal digits: the node ignores messages of every other "
        "run; empty: the vehicle draws one, the others adopt the vehicle's",
        read_only=True,
        parse=_run,
    ),
)

# Of the nodes of a mission.
SCENARIO = Parameter(
    "scenario", "five_clusters", "name of a shipped scenario, path of a TOML file, or random:SEED"
)
SCENARIO_OF_POLICY = Parameter("scenario", "", "scenario of the mission; empty: the policy's own")
POLICY = Parameter(
    "policy", "five_clusters_dueling", "name of a shipped policy or of a planner, or a policy's folder"
)
RECORDED_POLICY = Parameter("policy", "", "policy or planner that flies, by name or folder; empty: not known")
OBJECTIVE_WEIGHT = Parameter(
    "objective_weight",
    DEFAULT_WEIGHT,
    "weight w of the users in the objective, for a planner; 0: the time counts only",
    "",
    0.0,
    1.0,
)
SEARCH = Parameter(
    "search", 0, "missions that a policy flies in a model before each move; 0: no search", "", 0, SEARCH_MAX
)
SEARCH_TIME_LIMIT_S = Parameter(
    "search_time_limit_s",
    0.0,
    "time of a search, after which the policy's own move is taken; 0: no limit",
    "s",
    0.0,
    SEARCH_TIME_S[1],
)
SEED = Parameter("seed", 0, "seed of the first mission's users", "", 0, INTEGER_MAX)
MISSIONS = Parameter("missions", 1, "number of missions, with consecutive seeds", "", 1, INTEGER_MAX)
PACE = Parameter(
    "pace", pace.LOCKSTEP, "'lockstep', or how many times faster than real time", parse=pace.parse
)
JOURNAL = Parameter(
    "journal", "", "file with the node's state for a restart, one file for one flight; empty: none"
)
VEHICLE_OF_WORLD = Parameter(
    "vehicle",
    SIMULATED,
    "vehicle that flies; external: a bridge flies it, and this node only moves the users",
    choices=(SIMULATED, EXTERNAL),
)
RECORDED_VEHICLE = Parameter(
    "vehicle", SIMULATED, "vehicle that flies, or its interface", choices=(SIMULATED, *VEHICLES)
)
RATE_HZ = Parameter("rate", 5.0, "maximum rate of path and markers", "Hz", 0.1, 60.0)
NUMERIC_RATE_HZ = Parameter(
    "numeric_rate",
    20.0,
    "maximum rate of each topic of numbers, from sum_rate to tf; faster steps are left out; 0: none",
    "Hz",
    0.0,
    1000.0,
)
TF = Parameter(
    "tf", True, "publish map to base_link where tf2_msgs is installed; false: another node publishes it"
)
PORT = Parameter("port", 8765, "TCP port of the Foxglove WebSocket server; 0: any that is free", "", 0, 65535)
ADDRESS = Parameter(
    "address", "127.0.0.1", "network address that the server listens on; 0.0.0.0: all of this machine's"
)
WEB_PORT = Parameter("port", 8766, "TCP port of the page; 0: any that is free", "", 0, 65535)
TOKEN = Parameter(
    "token",
    "",
    "secret that the page's address must hold; empty: none on 127.0.0.1, and a random one on other addresses",
)

WAIT_FOR_START = Parameter(
    "wait_for_start", False, "true: the first mission begins with a call of the service start"
)

# Of the nodes that write a bag.
RECORDED_TOPICS = Parameter(
    "topics",
    "",
    "topics to record, by name, with a comma between; empty: all in the node's namespace",
    parse=_names,
)
SPLIT_BYTES = Parameter(
    "split_bytes", 0, "size at which a bag's next file begins; 0: never", "bytes", 0, INTEGER_MAX
)
SPLIT_S = Parameter("split_s", 0.0, "time after which a bag's next file begins; 0: never", "s", 0.0, 1e9)
COMPRESSION = Parameter("compression", "zstd", "compression of a bag's chunks", choices=COMPRESSIONS)
MIN_FREE_BYTES = Parameter(
    "min_free_bytes", 2**28, "free disk space below which recording stops", "bytes", 0, INTEGER_MAX
)
KEEP_LAST_S = Parameter(
    "keep_last_s",
    0.0,
    "keep the messages of this time in memory; write them, and what follows within the same time, on a "
    "fault, on an abort and on a call of the service snapshot; 0: write everything",
    "s",
    0.0,
    3600.0,
)
BAG_WRITER = (
    Parameter("bag", "", "folder of the new bag"),
    Parameter(
        "resume",
        False,
        "true: continue the bag of a recorder that was killed; false: refuse an existing folder",
    ),
    *(RECORDED_TOPICS, SPLIT_BYTES, SPLIT_S, COMPRESSION, MIN_FREE_BYTES, KEEP_LAST_S),
)


def _safety(name: str, description: str, unit: str, min: float, max: float) -> Parameter:
    """A field of `SafetySettings`, with its default."""
    return Parameter(name, getattr(SafetySettings, name), description, unit, min, max)


# Of the bridge: the interface of the vehicle, and how carefully the bridge flies it.
BRIDGE = (
    Parameter("vehicle", "mavlink", "interface of the autopilot", choices=VEHICLES),
    Parameter(
        "connect",
        "",
        "address of a vehicle on MAVLink, such as tcp:127.0.0.1:5760, udp:0.0.0.0:14550 or "
        "serial:/dev/ttyAMA0:921600",
    ),
    Parameter("system", 0, "MAVLink system number; 0: the only autopilot on the link", "", 0, SYSTEM_MAX),
    Parameter(
        "datum",
        "",
        "position of the grid's corner: here (the vehicle stands at the scenario's start when its first good "
        "position arrives), last (as in the last flight), or latitude, longitude (degrees) and altitude "
        "(metres) with a comma between; empty: datum_deg of the scenario, where it has one; here otherwise, "
        "and not with arm",
    ),
    *(SCENARIO, SEED, JOURNAL, WAIT_FOR_START),
    Parameter(
        "fence_margin_m",
        MARGIN_M,
        "distance of the fence around and above the grid, and around obstacles",
        "m",
        1.0,
        1000.0,
    ),
    Parameter(
        "arm",
        SafetySettings.arm,
        "true: the bridge sets the mode and arms; false: it waits until a pilot has done so",
    ),
    Parameter(
        "upload_fence",
        False,
        "true: upload the fence to an autopilot on MAVLink that has none, before take-off",
    ),
    _safety("tolerance_m", "distance to a cell's centre that counts as reached", "m", 0.1, 50.0),
    _safety("dwell_s", "time at the cell's centre that completes a step, vehicle time", "s", 0.0, 60.0),
    _safety("position_timeout_s", "maximum age of the position; an older one is a fault", "s", 0.1, 10.0),
    _safety("heartbeat_timeout_s", "age of the last heartbeat at which the link is lost", "s", 1.5, 60.0),
    _safety("policy_timeout_steps", "timeout of the policy, in durations of a step", "", 0.1, 100.0),
    _safety("policy_timeout_s", "minimum timeout of the policy, by this computer's clock", "s", 0.0, 600.0),
    _safety("max_speed_mps", "maximum speed; a faster change of position is a jump", "m/s", 1.0, 100.0),
    _safety("max_position_jump_m", "maximum jump of a position that is accepted", "m", 0.1, 100.0),
    _safety("fault_timeout_s", "fault timer: a fault that lasts longer ends the mission", "s", 0.1, 600.0),
    _safety("link_lost_timeout_s", "time without a heartbeat until the bridge gives up", "s", 1.0, 3600.0),
    _safety("min_battery", "minimum battery charge, 0 to 1; below it the mission ends", "", 0.0, 1.0),
    Parameter(
        "failsafe_action",
        str(SafetySettings.failsafe_action),
        "failsafe action of the bridge",
        choices=("return", "land"),
    ),
    _safety(
        "return_altitude_m",
        "altitude above home at which the autopilot returns, needed among obstacles; 0: not known",
        "m",
        0.0,
        10_000.0,
    ),
    Parameter(
        "land_if_return_blocked",
        SafetySettings.land_if_return_blocked,
        "true: with failsafe_action=return the vehicle lands where an obstacle is on the straight way home, "
        "and none is below; false: such a mission is refused",
    ),
    Parameter(
        "flying_at_start",
        SafetySettings.flying_at_start,
        "action when the bridge starts beside a vehicle in the commanded mode",
        choices=("resume", "land"),
    ),
    _safety("command_retry_s", "pause before a request is repeated, vehicle time", "s", 0.5, 60.0),
    _safety("max_return_attempts", "requests to return before the bridge requests land", "", 1, 100),
    _safety("takeoff_timeout_s", "timeout of take-off and way to the start, vehicle time", "s", 5.0, 3600.0),
    _safety("max_offset_cells", "distance from its cell at which a late step may end", "cells", 0.0, 1.0),
    _safety("progress_timeout_s", "time to come nearer to a cell after that, vehicle time", "s", 1.0, 600.0),
    _safety("target_timeout_s", "how long the autopilot may report another target", "s", 1.0, 600.0),
    _safety("landing_radius_m", "distance from the dock within which it has landed there", "m", 0.1, 1000.0),
    _safety(
        "return_progress_timeout_s", "time to come nearer to home on a return, vehicle time", "s", 5.0, 3600.0
    ),
    _safety(
        "landing_progress_timeout_s",
        "time to come lower or disarm in a landing, vehicle time",
        "s",
        5.0,
        3600.0,
    ),
    _safety("max_tilt_deg", "tilt beyond which the vehicle is not flying", "deg", 10.0, 180.0),
    _safety("max_sink_m", "maximum sink below the setpoint", "m", 1.0, 1000.0),
    _safety("crash_timeout_s", "time beyond these two, or on the ground in flight", "s", 0.1, 60.0),
)
