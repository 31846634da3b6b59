"""The interface between bridge and transport: telemetry one way, commands and setpoints the other."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol, Self

from uav_dc_ros.offboard.frames import Enu, Geodetic

ALTITUDE_UNKNOWN = (  # what is missing with a datum_deg, until the vehicle on the ground gives its altitude
    "the altitude of the grid (datum_deg of the scenario) is not known; expected the vehicle on the ground, "
    "with a global position, or --datum=LAT,LON,ALT"
)


class Mode(StrEnum):
    """Flight modes that the bridge distinguishes."""

    COMMANDED = "commanded"  # follows setpoints: ArduPilot's GUIDED, PX4's OFFBOARD
    HOLD = "hold"  # keeps its position: BRAKE or LOITER, AUTO.LOITER
    RETURN = "return"  # RTL, AUTO.RTL
    LAND = "land"  # lands where it is: LAND, AUTO.LAND
    OTHER = "other"  # any other mode: another pilot or system flies


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits that the autopilot enforces by its own parameters. None: not enforced, or not reported."""

    fence_radius_m: float | None = None  # horizontal distance from home
    fence_ceiling_m: float | None = None  # above home
    fence_floor_m: float | None = None  # above home
    polygon_fence: bool = False  # a fence of another shape, which the bridge does not read
    return_altitude_m: float | None = None  # minimum altitude of a return, above home
    speed_mps: float | None = None  # horizontal, towards a position target
    climb_mps: float | None = None  # positive
    descent_mps: float | None = None  # positive


@dataclass(frozen=True, kw_only=True)
class Telemetry:
    """Last reported state of the vehicle. None: not reported.

    `x_s` is the arrival of `x`, steady clock of the bridge, seconds. Positions are in the grid's ENU frame.
    """

    heartbeat_s: float | None = None  # None: no heartbeat was received
    mode: Mode = Mode.OTHER
    mode_name: str = ""  # the autopilot's name of the mode
    armed: bool = False  # the motors turn, or may turn at any moment
    on_ground: bool | None = None
    position: Enu | None = None
    position_s: float | None = None
    estimate_ok: bool = False  # the autopilot trusts its position estimate enough to fly by it
    estimate_s: float | None = None  # None: `estimate_ok` is current
    battery: float | None = None  # remaining charge, 0 to 1
    battery_v: float | None = None
    battery_fails: bool = False  # the autopilot reports the battery as low or broken
    vehicle_s: float = 0.0  # the vehicle's own time; in simulation it may be faster than the steady clock
    missing: str | None = None  # what the bridge needs before it can fly; None: nothing
    fence_refusal: str | None = None  # why a fence that was to be uploaded is not the autopilot's
    refusal: str | None = None  # last refused command and the reason; None: none, or it was executed since
    status_text: str = ""  # warnings of the autopilot in the last seconds
    home: Enu | None = None  # where a return leads to
    target: Enu | None = None  # position target that the autopilot reports
    target_s: float | None = None
    tilt_rad: float | None = None  # angle between the vehicle's vertical axis and the vertical, 0 to pi
    limits: Limits | None = None
    other_controller: str | None = None  # evidence of another system that commands this vehicle
    system: str = ""  # the vehicle's identity on its link, such as `system 1`
    system_id: int | None = None  # its number there, for a transport that is opened again
    is_selected: bool = True  # False: several vehicles are on the link, and none is named
    discarded: Mapping[str, int] = field(default_factory=dict)  # ignored messages by reason
    autopilot: str = ""  # its name
    datum: Geodetic | None = None  # position of the grid's corner on the Earth
    grid_origin: str = ""  # position of the grid, for a transport that is opened again in the air

    def replace(self, **changes: Any) -> Self:
        """`dataclasses.replace`, seven times as fast: the bridge calls it at each tick."""
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__, **changes)
        return new

    @property
    def mode_text(self) -> str:
        """The autopilot's name of the mode, or else the bridge's."""
        return self.mode_name or self.mode.value

    @property
    def in_the_air(self) -> bool:
        """Whether the vehicle is armed and reports that it flies."""
        return self.armed and self.on_ground is False


@dataclass(frozen=True)
class SetMode:
    """Command: change the flight mode."""

    mode: Mode


@dataclass(frozen=True)
class Arm:
    """Command: arm. Sent only with `SafetySettings.arm`."""


@dataclass(frozen=True)
class TakeOff:
    """Command: climb from the ground to an altitude in the grid's frame, metres."""

    altitude_m: float


Command = SetMode | Arm | TakeOff


class Vehicle(Protocol):
    """Transport to one vehicle, from `open` to `close`. It makes no decisions.

    The setpoint stream ends `STREAM_TIMEOUT_S` after the last call of `set_setpoint`: then the autopilot's
    own failsafes act.
    """

    def open(self) -> None:
        """Start to receive."""

    def telemetry(self) -> Telemetry:
        """Current state, times as of `time.monotonic`; raises VehicleError if no connection is possible."""

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, or none. To be called at 2 Hz or more."""

    def send_command(self, command: Command) -> None:
        """Send a command once; `telemetry` reports its execution."""

    def close(self) -> None:
        """End the setpoint stream and the link. Further calls have no effect."""
