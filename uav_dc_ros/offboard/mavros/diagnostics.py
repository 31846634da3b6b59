"""State of the vehicle in MAVROS's `/diagnostics`, published once a second. No input or output, no ROS.

The task `Heartbeat` counts heartbeats, and names autopilot, vehicle, mode and MAV_STATE. The task `System`
has the health of sensors and estimates. (MAVROS's plugin sys_status, HeartbeatStatus and SystemStatusDiag.)
Each status has the node's name, and the link as its hardware.
"""

from collections.abc import Mapping

from uav_dc_ros.offboard.flight_stacks import ARDUCOPTER, PX4, FlightStack

HEARTBEAT, SYSTEM = "Heartbeat", "System"  # tasks
COUNT, AUTOPILOT, VEHICLE = "Heartbeats since startup", "Autopilot type", "Vehicle type"
MODE, STATE = "Mode", "System status"

# MAVROS's texts of MAV_AUTOPILOT, MAV_TYPE and MAV_STATE.
AUTOPILOTS = {"ArduPilot": ARDUCOPTER, "PX4 Autopilot": PX4}
COPTERS = {
    *("Quadrotor", "Coaxial helicopter", "Normal helicopter with tail rotor", "Hexarotor", "Octorotor"),
    *("Tricopter", "Dodecarotor", "Decarotor"),
}
GROUNDED = {"Uninit", "Boot", "Calibrating", "Standby"}
ACTIVE = "Active"

OTHERS_S = 5.0  # time for which another MAVROS is remembered
MIN_HEARTBEATS = 3  # before the vehicle counts as the only one


class Diagnostics:
    """State of the first MAVROS that reports heartbeats. Times are of the steady clock, seconds."""

    def __init__(self) -> None:
        self.flight_stack: FlightStack | None = None
        self.mode_name = ""  # the autopilot's name of its mode
        # As far as MAV_STATE shows: PX4 is Active when armed, ArduPilot when flying. A failsafe state leaves
        # it unchanged; None: not known.
        self.armed: bool | None = None
        self.heartbeat_s: float | None = None  # when a heartbeat was reported last
        self.enabled: int | None = None  # bits of enabled sensors in SYS_STATUS; None before one came
        self.health: int | None = None  # of healthy ones
        self._source: tuple[str, str] | None = None  # node and link of the MAVROS in use
        self._sources: dict[tuple[str, str], float] = {}  # all that report heartbeats, and when they did
        self._count, self._in_a_row = 0, 0
        self._unsupported: str | None = None

    @property
    def source(self) -> str:
        """Node and link of the MAVROS in use; empty: none yet."""
        return "{} ({})".format(*self._source) if self._source else ""

    def on_status(self, name: str, link: str, values: Mapping[str, str], now_s: float) -> None:
        """Process a status of any node: its name, hardware and values."""
        node, _, task = name.rpartition(": ")
        source = node, link
        if task == HEARTBEAT and {COUNT, AUTOPILOT, VEHICLE, MODE, STATE} <= values.keys():
            self._sources[source] = now_s
            self._source = self._source or source
            if source == self._source:
                self._on_heartbeat(values, now_s)
        elif task == SYSTEM and source == self._source and parse_int(values.get("Sensor present", "")):
            self.enabled = parse_int(values.get("Sensor enabled", ""))
            self.health = parse_int(values.get("Sensor health", ""))

    def _on_heartbeat(self, values: Mapping[str, str], now_s: float) -> None:
        count = parse_int(values[COUNT])
        if count in (0, self._count):
            return  # no new heartbeat
        # A lower count: MAVROS restarted, or two nodes have the same name and link.
        self._in_a_row = self._in_a_row + 1 if count > self._count else 0
        self._count, self.heartbeat_s = count, now_s
        self.flight_stack, self.mode_name = AUTOPILOTS.get(values[AUTOPILOT]), values[MODE]
        if values[STATE] in GROUNDED:
            self.armed = False
        elif values[STATE] == ACTIVE:
            self.armed = True
        self._unsupported = None
        if self.flight_stack is None:
            expected = " or ".join(map(repr, AUTOPILOTS))
            self._unsupported = f"the autopilot is {values[AUTOPILOT]!r}; expected {expected}"
        elif values[VEHICLE] not in COPTERS:
            self._unsupported = f"the vehicle is {values[VEHICLE]!r}; expected a multicopter"

    def problem(self, now_s: float) -> str | None:
        """Why the vehicle cannot be flown; None: it can."""
        present = [
            f"{node} ({link})" for (node, link), at_s in self._sources.items() if now_s - at_s <= OTHERS_S
        ]
        if len(present) > 1:
            return f"/diagnostics has {' and '.join(sorted(present))}; expected one MAVROS"
        if self._source is not None and self.heartbeat_s is None:
            return "MAVROS has received no heartbeat of an autopilot yet"
        if self._source is not None and self._unsupported is None and self._in_a_row < MIN_HEARTBEATS:
            return "waiting for other vehicles on /diagnostics"
        return self._unsupported


def parse_int(text: str) -> int:
    """A whole number, decimal or 0x...; 0 for anything else."""
    try:
        return int(text, 0)
    except ValueError:
        return 0
