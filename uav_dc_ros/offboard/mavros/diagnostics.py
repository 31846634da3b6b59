"""What MAVROS tells of its vehicle in the standard `/diagnostics`, once a second. No input or output, no ROS.

Its task `Heartbeat` counts heartbeats, and names the kinds of autopilot and vehicle, the mode, and MAV_STATE;
its task `System` has the health of sensors and estimates. (MAVROS's plugin sys_status, HeartbeatStatus and
SystemStatusDiag.) Each status bears the node's name and, as its hardware, the link.
"""

from collections.abc import Mapping

from uav_dc_ros.offboard.flight_stacks import ARDUCOPTER, PX4, FlightStack

HEARTBEAT, SYSTEM = "Heartbeat", "System"  # tasks
BEATS, KIND, VEHICLE, MODE, STATE = (
    *("Heartbeats since startup", "Autopilot type", "Vehicle type", "Mode"),
    "System status",
)

# As MAVROS writes MAV_AUTOPILOT, MAV_TYPE and MAV_STATE.
AUTOPILOTS = {"ArduPilot": ARDUCOPTER, "PX4 Autopilot": PX4}
COPTERS = {
    *("Quadrotor", "Coaxial helicopter", "Normal helicopter with tail rotor", "Hexarotor", "Octorotor"),
    *("Tricopter", "Dodecarotor", "Decarotor"),
}
GROUNDED = {"Uninit", "Boot", "Calibrating", "Standby"}
ACTIVE = "Active"

OTHERS_S = 5.0  # how long another MAVROS is remembered
LISTENS = 3  # heartbeats before the vehicle is believed to be the only one


class Diagnostics:
    """The first MAVROS that tells of heartbeats. Times are steady, seconds.

    Attributes:
        dialect: what kind of autopilot it has.
        mode_name: what the autopilot calls its mode.
        armed: is it, as far as MAV_STATE says: PX4 is Active when it is armed, ArduPilot when it flies. In a
            failsafe MAV_STATE does not say, and things stay as they were; None: nothing was ever said.
        heartbeat_s: when the last heartbeat was told of.
        enabled, health: of SYS_STATUS; None before one came.
    """

    def __init__(self) -> None:
        self.dialect: FlightStack | None = None
        self.mode_name = ""
        self.armed: bool | None = None
        self.heartbeat_s: float | None = None
        self.enabled: int | None = None
        self.health: int | None = None
        self._source: tuple[str, str] | None = None  # whom it listens to: node and link
        self._sources: dict[tuple[str, str], float] = {}  # who told of heartbeats, and when
        self._beats, self._listened = 0, 0
        self._stranger: str | None = None

    @property
    def source(self) -> str:
        """Whom it listens to: MAVROS's node and link; empty: nobody yet."""
        return "{} ({})".format(*self._source) if self._source else ""

    def on_status(self, name: str, link: str, values: Mapping[str, str], now_s: float) -> None:
        """A status of anybody's diagnostics: its name, its hardware, and its values."""
        node, _, task = name.rpartition(": ")
        source = node, link
        if task == HEARTBEAT and {BEATS, KIND, VEHICLE, MODE, STATE} <= values.keys():
            self._sources[source] = now_s
            self._source = self._source or source
            if source == self._source:
                self._on_heartbeat(values, now_s)
        elif task == SYSTEM and source == self._source and number(values.get("Sensor present", "")):
            self.enabled = number(values.get("Sensor enabled", ""))
            self.health = number(values.get("Sensor health", ""))

    def _on_heartbeat(self, values: Mapping[str, str], now_s: float) -> None:
        beats = number(values[BEATS])
        if beats in (0, self._beats):
            return  # none since
        # Counting again: MAVROS has started anew, or there are two that cannot be told apart.
        self._listened = self._listened + 1 if beats > self._beats else 0
        self._beats, self.heartbeat_s = beats, now_s
        self.dialect, self.mode_name = AUTOPILOTS.get(values[KIND]), values[MODE]
        if values[STATE] in GROUNDED:
            self.armed = False
        elif values[STATE] == ACTIVE:
            self.armed = True
        self._stranger = None
        if self.dialect is None:
            self._stranger = (
                f"the autopilot is {values[KIND]!r}; expected {' or '.join(map(repr, AUTOPILOTS))}"
            )
        elif values[VEHICLE] not in COPTERS:
            self._stranger = f"the vehicle is {values[VEHICLE]!r}; expected a multicopter"

    def problem(self, now_s: float) -> str | None:
        """Why this is nobody to fly; None: it may be."""
        heard = [
            f"{node} ({link})" for (node, link), at_s in self._sources.items() if now_s - at_s <= OTHERS_S
        ]
        if len(heard) > 1:
            return f"/diagnostics tells of {' and '.join(sorted(heard))}; expected one MAVROS"
        if self._source is not None and self.heartbeat_s is None:
            return "MAVROS has not heard an autopilot yet"
        if self._source is not None and self._stranger is None and self._listened < LISTENS:
            return "listens for other vehicles on /diagnostics"
        return self._stranger


def number(text: str) -> int:
    """A whole number, decimal or 0x...; 0 for anything else."""
    try:
        return int(text, 0)
    except ValueError:
        return 0
