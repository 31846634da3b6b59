"""What passes between the bridge and a transport: telemetry one way, commands the other."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from uav_dc_ros.offboard.frames import Enu, Geodetic


class Mode(StrEnum):
    """What an autopilot may be asked to do; each calls it by a name of its own."""

    COMMANDED = "commanded"  # follow setpoints: GUIDED of ArduPilot, OFFBOARD of PX4
    HOLD = "hold"  # stay where it is: BRAKE or LOITER, AUTO.LOITER
    RETURN = "return"  # RTL, AUTO.RTL
    LAND = "land"  # here: LAND, AUTO.LAND
    OTHER = "other"  # any other: somebody else flies


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits that the autopilot enforces by its own parameters. None: not enforced, or not reported.

    Attributes:
        fence_radius_m: of its circular fence, horizontal distance from home, metres.
        fence_ceiling_m, fence_floor_m: of its altitude fence, metres above home.
        polygon_fence: does it enforce a fence of another shape, which this system does not read?
        speed_mps: horizontal speed towards a position target, m/s.
        climb_mps, descent_mps: vertical speeds towards a position target, m/s, both positive.
    """

    fence_radius_m: float | None = None
    fence_ceiling_m: float | None = None
    fence_floor_m: float | None = None
    polygon_fence: bool = False
    speed_mps: float | None = None
    climb_mps: float | None = None
    descent_mps: float | None = None


@dataclass(frozen=True, kw_only=True)
class Telemetry:
    """What is known of the vehicle; times are of the bridge's steady clock, seconds.

    Attributes:
        heartbeat_s: when its last heartbeat came; None: never.
        mode, mode_name: what it does, and what the autopilot calls that.
        armed: do its motors turn, or may they at any moment?
        on_ground: does it stand on the ground? None: it does not tell.
        position: in the grid's ENU frame; None: not known yet.
        position_s: when that came.
        estimate_ok: does the autopilot trust its position enough to fly by it?
        estimate_s: when the last report on that came; None: not known, then `estimate_ok` is of now.
        battery: charge that is left, 0 to 1; None: it does not tell.
        battery_v: its voltage, volts; None: it does not tell.
        battery_fails: does the autopilot itself find the battery too low, or broken?
        vehicle_s: the vehicle's own time, seconds: a simulated one may be faster than any clock here.
        missing: what has not come yet, though nobody flies without; None: all of it has.
        refusal: what the vehicle last refused, and why; None: nothing, or it did it after all.
        said: what it warned of in the last seconds, in its own words; empty: nothing.
        home: where it returns to, in the grid's ENU frame; None: not reported.
        target: position target that the autopilot reports, in the grid's ENU frame; None: not reported.
        target_s: when that came; None: not known, then nothing is concluded from it.
        tilt_rad: angle between the vehicle's vertical axis and the vertical, 0 to pi; None: not reported.
        limits: of the autopilot's own parameters; None: not reported.
        other_controller: another system that commands this vehicle, with the evidence; None: none was seen.
        system: the vehicle's identity on its link, such as `system 1`; empty: not known.
        system_id: its number there, for a transport that is opened again; None: not known.
        is_meant: is it surely the vehicle that is meant? No, while there are several, and none is named.
        discarded: messages that were counted and ignored, by reason (late, repeated, impossible, ...).
    """

    heartbeat_s: float | None = None
    mode: Mode = Mode.OTHER
    mode_name: str = ""
    armed: bool = False
    on_ground: bool | None = None
    position: Enu | None = None
    position_s: float | None = None
    estimate_ok: bool = False
    estimate_s: float | None = None
    battery: float | None = None
    battery_v: float | None = None
    battery_fails: bool = False
    vehicle_s: float = 0.0
    missing: str | None = None
    refusal: str | None = None
    said: str = ""
    home: Enu | None = None
    target: Enu | None = None
    target_s: float | None = None
    tilt_rad: float | None = None
    limits: Limits | None = None
    other_controller: str | None = None
    system: str = ""
    system_id: int | None = None
    is_meant: bool = True
    discarded: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class SetMode:
    """A command: change to a mode."""

    mode: Mode


@dataclass(frozen=True)
class Arm:
    """A command: arm. Only ever sent when the user asked for it."""


@dataclass(frozen=True)
class TakeOff:
    """A command: climb from the ground to an altitude in the grid's frame, metres."""

    altitude_m: float


Command = SetMode | Arm | TakeOff


class Vehicle(Protocol):
    """A way to one vehicle. It receives, sends commands and streams setpoints. It decides nothing.

    It works from `open` to `close`. Its stream is a sign of life of those who decide: it ends a second
    after the last call of `set_setpoint`, and then the autopilot's own failsafes take over.
    """

    def open(self) -> None:
        """Begin to listen."""

    @property
    def kind(self) -> str:
        """Name of the autopilot; empty until it is known."""

    @property
    def grid_origin(self) -> str:
        """Where the grid lies, for a transport that is opened again in the air; empty until it is known."""

    @property
    def datum(self) -> Geodetic | None:
        """Where on the Earth the grid's corner lies; None: not known."""

    def telemetry(self) -> Telemetry:
        """What is known of the vehicle now, times as of `time.monotonic`.

        Raises:
            VehicleError: this machine cannot reach it at all.
        """

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, from now on; or none. To be called at 2 Hz or more."""

    def send_command(self, command: Command) -> None:
        """Pass a command on, once; whether it was fulfilled, `telemetry` tells."""

    def close(self) -> None:
        """End the stream, and the link; more than once is as good as once."""
