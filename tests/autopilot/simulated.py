"""A vehicle of a few lines, for the bridge's decisions alone. What talks MAVLink is another one."""

import math
from dataclasses import dataclass, field

from uav_dc_ros.autopilot.frames import Enu
from uav_dc_ros.autopilot.vehicle import Arm, Mode, SetMode, TakeOff, Telemetry, Wish

SPEED_MPS = {"across": 10.0, "up": 2.5, "down": 1.5}


@dataclass
class Vehicle:
    """Flies to setpoints, does what it is asked, and tells of itself; faults are attributes."""

    position: Enu
    mode: Mode = Mode.OTHER
    armed: bool = False
    battery: float = 1.0
    battery_v: float | None = None
    estimate_ok: bool = True
    frozen: bool = False  # its position does not come any more
    silent: bool = False  # nothing comes any more
    deaf: bool = False  # it follows no wish
    refused: tuple[Mode, ...] = ()
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of what it believes of its position
    said: str = ""
    now_s: float = 0.0
    climb_to_m: float | None = None
    asked: list[Wish] = field(default_factory=list)
    told: Telemetry = field(default_factory=Telemetry)

    @property
    def on_ground(self) -> bool:
        return self.position.up_m <= 0.05

    def ask(self, wish: Wish) -> None:
        self.asked.append(wish)
        if self.deaf or self.silent:
            return
        match wish:
            case SetMode(mode) if mode in self.refused:
                pass
            case SetMode(mode):
                self.mode = mode
            case Arm():
                self.armed = True
            case TakeOff(altitude_m):
                self.climb_to_m = altitude_m

    def pass_time(self, seconds: float, setpoint: Enu | None) -> None:
        self.now_s += seconds
        x_m, y_m, up_m = self.position
        if self.armed and self.mode is Mode.COMMANDED:
            target = setpoint
            if self.climb_to_m is not None and up_m < self.climb_to_m - 0.1:
                target = Enu(x_m, y_m, self.climb_to_m)
            elif self.on_ground:
                target = None
            if target is not None:
                self.position = towards(self.position, target, seconds)
        elif self.armed and self.mode in (Mode.LAND, Mode.RETURN):
            self.position = towards(self.position, Enu(x_m, y_m, 0.0), seconds)
            if self.on_ground:
                self.armed, self.climb_to_m = False, None
        self._tell()

    def _tell(self) -> None:
        before = self.told
        if self.silent:
            return
        believed = Enu(*(p + o for p, o in zip(self.position, self.offset, strict=True)))
        self.told = Telemetry(
            heartbeat_s=self.now_s,
            mode=self.mode,
            mode_name=self.mode.value.upper(),
            armed=self.armed,
            on_ground=self.on_ground,
            position=before.position if self.frozen else believed,
            position_s=before.position_s if self.frozen else self.now_s,
            estimate_ok=self.estimate_ok,
            battery=self.battery,
            battery_v=self.battery_v,
            vehicle_s=self.now_s,
            said=self.said,
        )


def towards(position: Enu, target: Enu, seconds: float) -> Enu:
    """Nearer to a target by what a vehicle flies in a time."""
    dx, dy, dz = (t - p for t, p in zip(target, position, strict=True))
    across = math.hypot(dx, dy)
    share = min(1.0, SPEED_MPS["across"] * seconds / across) if across else 0.0
    limit = SPEED_MPS["up" if dz > 0 else "down"] * seconds
    return Enu(
        position.east_m + dx * share,
        position.north_m + dy * share,
        position.up_m + max(-limit, min(limit, dz)),
    )
