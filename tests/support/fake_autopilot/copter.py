"""The fake autopilot's vehicle: physics, modes, parameters and failsafes, without a radio.

Lengths are true metres, NED, from where it was switched on, which is its home. Time is its own, seconds.
"""

import json
import math
from typing import Any

TICK_S = 0.02
ACROSS_MPS2 = 1.9
AIR_MPS = 12.0  # the fastest that it flies through the air; more wind than that blows it away
SLOW_M, SLOW_MPS = 10.0, 0.5  # LAND_ALT_LOW, LAND_SPEED
SPOOL_S = 2.0  # from the command to take off until it leaves the ground
RETURN_M = 15.0
FULL_V, SAG_V, EMPTY_V = 12.6, 0.3, 10.2  # at rest, less in the air, at rest without charge
COUNTED_PER_S = 29.3 / 3600 / 3.3  # amperes of ArduCopter's simulator, ampere-hours of BATT_CAPACITY
LOW_V, LOW_S = 10.5, 10.0  # BATT_LOW_VOLT, BATT_LOW_TIMER
VELOCITY_S = 3.0  # GUID_TIMEOUT
IDLE_DISARM_S, LANDED_DISARM_S = 10.0, 1.0
FALL_MPS, FALL_TILT_RAD = 8.0, 1.2
GRAVITY_MPS2 = 9.81

ARDUPILOT_MODES = {"STABILIZE": 0, "ALT_HOLD": 2, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9, "BRAKE": 17}
PX4_MODES = {
    name: main << 16 | sub << 24
    for name, main, sub in [
        *[("MANUAL", 1, 0), ("POSCTL", 3, 0), ("AUTO.LOITER", 4, 3), ("AUTO.RTL", 4, 5)],
        *[("AUTO.LAND", 4, 6), ("OFFBOARD", 6, 0)],
    ]
}
FOLLOWS, RETURNS, LANDS = ("GUIDED", "OFFBOARD"), ("RTL", "AUTO.RTL"), ("LAND", "AUTO.LAND")

# Parameters that are imitated, in the units of the autopilot. Integers of PX4 are integers here, too.
ARDUPILOT_PARAMETERS: dict[str, float] = {
    "FENCE_ENABLE": 0,
    "FENCE_AUTOENABLE": 0,
    "FENCE_TYPE": 7,
    "FENCE_RADIUS": 300.0,
    "FENCE_ALT_MAX": 100.0,
    "FENCE_ALT_MIN": -10.0,
    "FENCE_MARGIN": 2.0,
    "FENCE_TOTAL": 0,
    "RTL_ALT": 100 * RETURN_M,
    "WPNAV_SPEED": 1020.0,
    "WPNAV_SPEED_UP": 250.0,
    "WPNAV_SPEED_DN": 150.0,
    "FS_GCS_ENABLE": 0,
    "FS_GCS_TIMEOUT": 5.0,
}
PX4_PARAMETERS: dict[str, float] = {
    "COM_OF_LOSS_T": 1.0,
    "GF_ACTION": 2,
    "GF_MAX_HOR_DIST": 0.0,
    "GF_MAX_VER_DIST": 0.0,
    "RTL_RETURN_ALT": RETURN_M,
    "MPC_XY_VEL_MAX": 10.2,
    "MPC_Z_VEL_MAX_UP": 2.5,
    "MPC_Z_VEL_MAX_DN": 1.5,
}
CIRCLE, CEILING = 2, 1  # bits of FENCE_TYPE


def emit(event: str, t_s: float, **more: Any) -> None:
    print(json.dumps({"event": event, "t_s": round(t_s, 3), **more}), flush=True)


class Copter:
    """Where it is, and what it does. NED metres from where it was switched on.

    Args:
        kind: ardupilot or px4.
        ready_s: its own time at which its estimate is good.
        prefix: of its events' names.
    """

    def __init__(self, kind: str, ready_s: float, prefix: str = "") -> None:
        self.px4, self.prefix = kind == "px4", prefix
        self.modes = PX4_MODES if self.px4 else ARDUPILOT_MODES
        self.parameters = dict(PX4_PARAMETERS if self.px4 else ARDUPILOT_PARAMETERS)
        self.ready_s = ready_s
        self.wind = [0.0, 0.0]  # north, east, m/s
        self.switch_on()

    def switch_on(self) -> None:
        """Start anew; parameters stay, as does the wind."""
        self.mode = "POSCTL" if self.px4 else "STABILIZE"
        self.t_s = 0.0
        self.ned, self.velocity = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self.armed, self.landed, self.taking_off_to_m = False, True, None
        self.target: list[float] | None = None  # NED
        self.target_velocity: list[float] | None = None
        self.target_s = -math.inf
        self.streamed_since_s, self.streamed_s = math.inf, -math.inf
        self.ground_since_s = 0.0
        self.take_off_s, self.counted = 0.0, 0.0
        self.battery, self.lost, self.refuses, self.balks = 1.0, False, False, False
        self.volts_set: float | None = None  # instead of what a battery with its charge has
        self.low_since_s, self.battery_failed = math.inf, False
        self.falls, self.fallen_armed_s = False, 0.0
        self.gcs_s = -math.inf  # last heartbeat of the ground station that FS_GCS_ENABLE watches
        self.texts: list[str] = []  # to be sent

    def emit(self, event: str, **more: Any) -> None:
        emit(self.prefix + event, self.t_s, **more)

    @property
    def ready(self) -> bool:
        return self.t_s >= self.ready_s and not self.lost

    @property
    def landed_state(self) -> int:
        if self.landed and not (self.falls and self.armed):  # nobody finds that a wreck has landed
            return 1
        if self.taking_off_to_m is not None:
            return 3
        return 4 if self.mode in LANDS else 2

    @property
    def charge(self) -> float:
        return self.battery if self.px4 else max(0.0, self.battery - self.counted)

    @property
    def volts(self) -> float:
        if self.volts_set is not None:
            return self.volts_set
        return EMPTY_V + (FULL_V - EMPTY_V) * self.battery - (0.0 if self.landed else SAG_V)

    @property
    def tilt_rad(self) -> float:
        """As much as its acceleration takes, and more when it falls."""
        if self.falls:
            return FALL_TILT_RAD
        across = max(0.0, math.hypot(*self.velocity[:2]) - 1.0)
        return math.atan2(min(ACROSS_MPS2, across), GRAVITY_MPS2)

    @property
    def speeds_mps(self) -> tuple[float, float, float]:
        """Across, up, down."""
        p = self.parameters
        if self.px4:
            return p["MPC_XY_VEL_MAX"], p["MPC_Z_VEL_MAX_UP"], p["MPC_Z_VEL_MAX_DN"]
        if "WP_SPD" in p:  # from 4.7
            return p["WP_SPD"], p["WP_SPD_UP"], p["WP_SPD_DN"]
        return p["WPNAV_SPEED"] / 100, p["WPNAV_SPEED_UP"] / 100, p["WPNAV_SPEED_DN"] / 100

    @property
    def fence_m(self) -> tuple[float, float]:
        """Radius and ceiling of its fence."""
        p = self.parameters
        if self.px4:
            lengths = p["GF_MAX_HOR_DIST"], p["GF_MAX_VER_DIST"]
            return tuple(m if m > 0 and p["GF_ACTION"] >= 2 else math.inf for m in lengths)  # type: ignore[return-value]
        on = int(p["FENCE_TYPE"]) if p["FENCE_ENABLE"] or p["FENCE_AUTOENABLE"] else 0
        radius, ceiling = p["FENCE_RADIUS"], p["FENCE_ALT_MAX"]
        return radius if on & CIRCLE else math.inf, ceiling if on & CEILING else math.inf

    def is_outside(self, ned: list[float]) -> bool:
        """Does a point lie outside the fence."""
        radius_m, ceiling_m = self.fence_m
        return math.hypot(ned[0], ned[1]) > radius_m or -ned[2] > ceiling_m

    def set_mode(self, mode: str, why: str) -> None:
        if mode != self.mode:
            self.mode, self.taking_off_to_m = mode, None
            self.target, self.target_velocity, self.target_s = None, None, self.t_s
            self.emit("mode", mode=mode, why=why)

    def arm(self, armed: bool, why: str) -> None:
        if armed != self.armed:
            self.armed, self.ground_since_s = armed, self.t_s
            self.emit("armed" if armed else "disarmed", why=why, ned=self.ned)

    def put(self, ned: list[float]) -> None:
        """Have it fly at a place, in the commanded mode, as if a mission had brought it there."""
        self.armed, self.landed, self.ned = True, False, ned
        self.set_mode("OFFBOARD" if self.px4 else "GUIDED", "put there")
        self.target, self.streamed_s = list(ned), self.t_s

    def aim(self, ned: list[float]) -> None:
        """Follow a position target from now on; ArduCopter ignores one outside its fence, without a word."""
        if not self.px4 and self.is_outside(ned):
            return
        self.target, self.target_velocity, self.target_s = ned, None, self.t_s

    def tick(self) -> None:
        self.t_s += TICK_S
        self.counted += 0.0 if self.landed else COUNTED_PER_S * TICK_S
        self._fail_safe()
        goal = self.ned if self.landed else self._goal()
        if self.armed and self.landed and not self.falls:
            goal = self._lift_off()
        if self.falls and not self.landed:
            self._fall()
        else:
            self._fly(goal)
        if self.armed and self.landed:
            down = self.mode in LANDS or self.mode in RETURNS
            patience_s = LANDED_DISARM_S if down else IDLE_DISARM_S
            if self.falls:
                patience_s = self.fallen_armed_s
            if self.t_s - self.ground_since_s > patience_s:
                self.arm(False, "crashed" if self.falls else "on the ground")

    def _fail_safe(self) -> None:
        """What the autopilot does of itself."""
        if (
            self.px4
            and self.mode == "OFFBOARD"
            and self.t_s - self.streamed_s > self.parameters["COM_OF_LOSS_T"]
        ):
            self.set_mode("AUTO.RTL", "failsafe: no offboard setpoints")
        flies = self.armed and not self.landed
        home = "AUTO.RTL" if self.px4 else "RTL"
        if flies and self.is_outside(self.ned) and self.mode not in (*RETURNS, *LANDS):
            self.set_mode(home, "failsafe: fence")
            self.texts.append("Geofence violation" if self.px4 else "Fence Breached")
        gcs = int(self.parameters.get("FS_GCS_ENABLE", 0))
        silent_s = self.t_s - self.gcs_s
        if gcs and self.armed and self.parameters["FS_GCS_TIMEOUT"] < silent_s < math.inf:
            mode = "LAND" if gcs == 5 else "RTL"
            if self.mode not in (*RETURNS, *LANDS):
                self.set_mode(mode, "failsafe: no heartbeat of the ground station")
                self.texts.append("GCS Failsafe")
        if self.volts >= LOW_V:
            self.low_since_s = math.inf
        self.low_since_s = min(self.low_since_s, self.t_s)
        if self.volts < LOW_V and self.t_s - self.low_since_s > LOW_S and not self.battery_failed:
            self.battery_failed = True
            low = f"Battery 1 is low {self.volts:.2f}V used {self.counted * 3300:.0f} mAh"
            self.texts.append("Low battery, return advised" if self.px4 else low)

    def _lift_off(self) -> list[float]:
        """What lifts it from the ground: a command to take off; a setpoint above, of PX4."""
        if self.px4:
            rises = self.target is not None and self.target[2] < self.ned[2] - 0.5
            self.landed = not (self.mode == "OFFBOARD" and rises)
        else:
            turning = self.taking_off_to_m is not None and self.t_s - self.take_off_s >= SPOOL_S
            self.landed = not (self.mode == "GUIDED" and turning)
        return self._goal() if not self.landed else self.ned

    def _goal(self) -> list[float]:
        north, east, down = self.ned
        if self.mode in LANDS:
            return [north, east, 1.0]
        if self.mode in RETURNS:
            if math.hypot(north, east) > 0.5:
                high = down <= -RETURN_M + 0.5
                return [0.0, 0.0, down] if high else [north, east, -RETURN_M]
            return [0.0, 0.0, 1.0]
        if self.taking_off_to_m is not None:
            if down <= -self.taking_off_to_m + 0.2:
                self.taking_off_to_m = None
                self.target, self.target_velocity = [north, east, down], None
                self.emit("taken off", ned=self.ned)
            else:
                return [north, east, -self.taking_off_to_m]
        if self.mode in FOLLOWS and self.target_velocity is not None:
            if self.t_s - self.target_s > VELOCITY_S:
                self.target, self.target_velocity = [north, east, down], None
                self.emit("velocity timed out")
            else:
                return [p + 10.0 * v for p, v in zip(self.ned, self.target_velocity, strict=True)]
        if self.mode in FOLLOWS and self.target is not None:
            return self.target
        if self.target is None:
            self.target = [north, east, down]
        return self.target

    def _fly(self, goal: list[float]) -> None:
        """Towards a goal, as fast as it accelerates across, climbs, sinks, and flies against the wind."""
        if not self.armed or self.landed:
            self.velocity = [0.0, 0.0, 0.0]
            return
        across_mps, up, down = self.speeds_mps
        dn, de, dd = (g - p for g, p in zip(goal, self.ned, strict=True))
        far = math.hypot(dn, de)
        speed = min(across_mps, math.sqrt(2 * 0.9 * ACROSS_MPS2 * far), 1.0 * far)
        if self.target_velocity is not None and self.mode in FOLLOWS:
            speed = min(across_mps, math.hypot(*self.target_velocity[:2]))
        wanted = [speed * dn / far, speed * de / far] if far > 1e-9 else [0.0, 0.0]
        wanted = self._against_wind(wanted)
        change = [w - v for w, v in zip(wanted, self.velocity, strict=False)]
        size = math.hypot(*change)
        share = min(1.0, ACROSS_MPS2 * TICK_S / size) if size else 0.0
        self.velocity[0] += change[0] * share
        self.velocity[1] += change[1] * share
        if self.ned[2] > -SLOW_M and goal[2] > 0.0:
            down = min(down, SLOW_MPS)
        if self.target_velocity is not None and self.mode in FOLLOWS:
            up, down = min(up, abs(self.target_velocity[2])), min(down, abs(self.target_velocity[2]))
        self.velocity[2] = max(-up, min(down, 2.0 * dd))
        self._move()

    def _against_wind(self, ground: list[float]) -> list[float]:
        """The velocity over ground that it reaches of one that it wants."""
        air = [g - w for g, w in zip(ground, self.wind, strict=True)]
        share = min(1.0, AIR_MPS / max(math.hypot(*air), 1e-9))
        return [a * share + w for a, w in zip(air, self.wind, strict=True)]

    def _fall(self) -> None:
        self.velocity[2] = FALL_MPS
        self._move()

    def _move(self) -> None:
        self.ned = [p + v * TICK_S for p, v in zip(self.ned, self.velocity, strict=True)]
        if self.ned[2] >= 0.0 and self.velocity[2] >= 0.0:
            self.ned[2], self.velocity, self.landed = 0.0, [0.0, 0.0, 0.0], True
            self.ground_since_s, self.taking_off_to_m = self.t_s, None
            self.emit("touched down", ned=self.ned)
