"""The interface between bridge and transport: telemetry one way, commands and setpoints the other."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from uav_dc_ros.offboard.frames import Enu, Geodetic


class Mode(StrEnum):
    """Flight modes that the bridge distinguishes."""

    COMMANDED = "commanded"  # follows setpoints: ArduPilot's GUIDED, PX4's OFFBOARD
    HOLD = "hold"  # keeps its position: BRAKE or LOITER, AUTO.LOITER
    RETURN = "return"  # RTL, AUTO.RTL
    LAND = "land"  # lands where it is: LAND, AUTO.LAND
    OTHER = "other"  # any other mode: another pilot or system flies


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits that the autopilot enforces by its own parameters. None: not enforced, or not reported.

    Attributes:
        fence_radius_m: of its circular fence, horizontal distance from home, metres.
        fence_ceiling_m, fence_floor_m: of its altitude fence, metres above home.
        polygon_fence: whether it enforces a fence of another shape, which the bridge does not read.
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
    """Last reported state of the vehicle. Times: the bridge's steady clock, seconds. None: not reported.

    Attributes:
        heartbeat_s: arrival of the last heartbeat; None: none received.
        mode, mode_name: flight mode, and the autopilot's name of it.
        armed: whether the motors turn, or may turn at any moment.
        on_ground: whether the vehicle stands on the ground.
        position, position_s: in the grid's ENU frame, and its arrival.
        estimate_ok: whether the autopilot trusts its position estimate enough to fly by it.
        estimate_s: arrival of the last report on the estimate; None: `estimate_ok` is current.
        battery: remaining charge, 0 to 1.
        battery_v: battery voltage, volts.
        battery_fails: whether the autopilot reports the battery as low or broken.
        vehicle_s: the vehicle's own time, seconds; in simulation it may run faster than the steady clock.
        missing: what the bridge still needs before it can fly, in words; None: nothing.
        refusal: last refused command and the reason; None: none, or it was executed since.
        status_text: the autopilot's own warnings of the last seconds; empty: none.
        home: where a return leads to, in the grid's ENU frame.
        target, target_s: the autopilot's position target in the grid's ENU frame, and its arrival.
        tilt_rad: angle between the vehicle's vertical axis and the vertical, 0 to pi.
        limits: of the autopilot's own parameters.
        other_controller: evidence of another system that commands this vehicle; None: none.
        system: the vehicle's identity on its link, such as `system 1`; empty: not known.
        system_id: its number on the link, for a transport that is opened again.
        is_selected: whether the vehicle is identified; False while several are on the link and none is named.
        discarded: number of ignored messages by reason (late, repeated, impossible, ...).
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
    status_text: str = ""
    home: Enu | None = None
    target: Enu | None = None
    target_s: float | None = None
    tilt_rad: float | None = None
    limits: Limits | None = None
    other_controller: str | None = None
    system: str = ""
    system_id: int | None = None
    is_selected: bool = True
    discarded: Mapping[str, int] = field(default_factory=dict)

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

    @property
    def kind(self) -> str:
        """Name of the autopilot; empty until it is known."""

    @property
    def grid_origin(self) -> str:
        """Position of the grid, for a transport that is opened again in the air; empty until it is known."""

    @property
    def datum(self) -> Geodetic | None:
        """Position of the grid's corner on the Earth; None: not known."""

    def telemetry(self) -> Telemetry:
        """Current state of the vehicle; times as of `time.monotonic`.

        Raises:
            VehicleError: this machine cannot reach the vehicle at all.
        """

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, or none. To be called at 2 Hz or more."""

    def send_command(self, command: Command) -> None:
        """Send a command once; `telemetry` reports its execution."""

    def close(self) -> None:
        """End the setpoint stream and the link. Further calls have no effect."""
