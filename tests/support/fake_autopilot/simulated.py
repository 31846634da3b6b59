"""A vehicle of a few lines, for the bridge's decisions alone. What talks MAVLink is another one."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.support.fake_autopilot.common import FlightRecord, way_home
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Arm, Command, Limits, Mode, SetMode, TakeOff, Telemetry

SPEED_MPS = {"across": 10.0, "up": 2.5, "down": 1.5}
RETURN_M = 15.0  # least altitude of a return
STALE_S = 3.0  # age after which a transport takes the last report on the estimate for nothing

SCENARIO = scenarios.load("five_clusters_hover")
TICK_S = 0.1
START = Enu(*SCENARIO.mission.start_m)
ARMING = SafetySettings(arm=True)


@dataclass
class Vehicle:
    """Flies to setpoints, executes commands, and reports its state; faults are attributes."""

    position: Enu
    mode: Mode = Mode.OTHER
    mode_name: str = ""  # of a mode that is OTHER
    armed: bool = False
    battery: float = 1.0
    battery_v: float | None = None
    estimate_ok: bool = True
    frozen: bool = False  # its position does not come any more
    silent: bool = False  # nothing comes any more
    ignores_commands: bool = False  # it follows no command
    refused: tuple[Mode, ...] = ()
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of what it believes of its position
    status_text: str = ""
    now_s: float = 0.0
    climb_to_m: float | None = None
    wind_mps: tuple[float, float] = (0.0, 0.0)  # east, north
    speeds_mps: dict[str, float] = field(default_factory=lambda: dict(SPEED_MPS))
    fence_m: float | None = None  # circle around home; targets outside are ignored
    stuck: bool = False  # it flies nowhere
    falls: bool = False  # its motors are off, whatever is commanded
    tilt_rad: float | None = None
    home: Enu | None = None
    target: Enu | None = None
    reports_home: bool = True
    reports_target: bool = True
    limits: Limits | None = None
    other_controller: str | None = None
    unplaced: bool = False  # its position on the grid is not known
    missing: str | None = None  # what else has not come
    commands: list[Command] = field(default_factory=list)
    telemetry: Telemetry = field(default_factory=Telemetry)

    @property
    def on_ground(self) -> bool:
        return self.position.up_m <= 0.05

    def send_command(self, command: Command) -> None:
        self.commands.append(command)
        if self.ignores_commands or self.silent:
            return
        match command:
            case SetMode(mode) if mode in self.refused:
                pass
            case SetMode(mode):
                self.mode = mode
            case Arm():
                self.armed, self.home = True, self.position
            case TakeOff(altitude_m):
                self.climb_to_m = altitude_m

    def pass_time(self, seconds: float, setpoint: Enu | None) -> None:
        self.now_s += seconds
        goal = self._goal(setpoint) if self.armed and not self.stuck else None
        if self.falls:
            self.position = self.position._replace(up_m=max(0.0, self.position.up_m - 8.0 * seconds))
        elif goal is not None:
            self.position = towards(self.position, goal, seconds, self.speeds_mps)
        if self.armed and not self.on_ground and any(self.wind_mps):
            east_mps, north_mps = self.wind_mps
            x_m, y_m, up_m = self.position
            self.position = Enu(x_m + east_mps * seconds, y_m + north_mps * seconds, up_m)
        if self.armed and self.on_ground and self.mode in (Mode.LAND, Mode.RETURN):
            self.armed, self.climb_to_m = False, None
        self._report()

    def _goal(self, setpoint: Enu | None) -> Enu | None:
        x_m, y_m, up_m = self.position
        if self.mode is Mode.COMMANDED:
            if self.climb_to_m is not None and up_m < self.climb_to_m - 0.1:
                return Enu(x_m, y_m, self.climb_to_m)
            if self.on_ground:
                return None
            if setpoint is not None and not self._is_fenced_off(setpoint):
                self.target = setpoint
            return self.target
        if self.mode is Mode.RETURN and self.home is not None:
            if math.dist(self.position[:2], self.home[:2]) > 0.5:
                return Enu(self.home.east_m, self.home.north_m, max(up_m, RETURN_M))
            return self.home
        return Enu(x_m, y_m, 0.0) if self.mode in (Mode.LAND, Mode.RETURN) else None

    def _is_fenced_off(self, target: Enu) -> bool:
        if self.fence_m is None or self.home is None:
            return False
        return math.dist(target[:2], self.home[:2]) > self.fence_m

    def _report(self) -> None:
        before = self.telemetry
        if self.silent:
            stale = before.estimate_s is None or self.now_s - before.estimate_s > STALE_S
            self.telemetry = dataclasses.replace(before, estimate_ok=before.estimate_ok and not stale)
            return
        believed = Enu(*(p + o for p, o in zip(self.position, self.offset, strict=True)))
        known = not self.unplaced
        self.telemetry = Telemetry(
            heartbeat_s=self.now_s,
            mode=self.mode,
            mode_name=(self.mode_name if self.mode is Mode.OTHER else "") or self.mode.value.upper(),
            armed=self.armed,
            on_ground=self.on_ground,
            position=(before.position if self.frozen else believed) if known else None,
            position_s=(before.position_s if self.frozen else self.now_s) if known else None,
            estimate_ok=self.estimate_ok,
            estimate_s=self.now_s,
            battery=self.battery,
            battery_v=self.battery_v,
            vehicle_s=self.now_s,
            missing="the grid has no datum" if self.unplaced else self.missing,
            status_text=self.status_text,
            home=self.home if self.reports_home else None,
            target=self.target if self.reports_target else None,
            target_s=self.now_s,
            tilt_rad=self.tilt_rad,
            limits=self.limits,
            other_controller=self.other_controller,
        )


def towards(position: Enu, target: Enu, seconds: float, speeds_mps: dict[str, float]) -> Enu:
    """Nearer to a target by what a vehicle flies in a time."""
    dx, dy, dz = (t - p for t, p in zip(target, position, strict=True))
    across = math.hypot(dx, dy)
    share = min(1.0, speeds_mps["across"] * seconds / across) if across else 0.0
    limit = speeds_mps["up" if dz > 0 else "down"] * seconds
    return Enu(
        position.east_m + dx * share,
        position.north_m + dy * share,
        position.up_m + max(-limit, min(limit, dz)),
    )


class Flight(FlightRecord):
    """Bridge, vehicle and policy, tick by tick.

    Attributes:
        ended_m: how far the vehicle was from the cell of each step that counted.
    """

    def __init__(
        self,
        how: SafetySettings = ARMING,
        vehicle: Vehicle | None = None,
        scenario: Scenario = SCENARIO,
        **bridge: object,
    ) -> None:
        super().__init__()
        start_m = scenario.mission.start_m
        self.vehicle = vehicle or Vehicle(position=Enu(start_m[0], start_m[1], 0.0))
        self.ended_m: list[float] = []
        self.bridge = MissionController(scenario, how, self._note, **bridge)  # type: ignore[arg-type]
        self.policy: Callable[[MissionController], Action] | None = way_home
        self._step = self.bridge.step

    def _note(self) -> None:
        bridge = self.bridge
        self.record(bridge)
        if bridge.step != self._step:
            assert bridge.step == self._step + 1, "one step after the other"
            self._step = bridge.step
            self.ended_m.append(math.dist(self.vehicle.position, bridge.progress.centre(bridge.cell)))

    def tick(self, tick_s: float = TICK_S, known: Telemetry | None = None) -> None:
        bridge, vehicle = self.bridge, self.vehicle
        for command in bridge.tick(vehicle.now_s, known or vehicle.telemetry):
            vehicle.send_command(command)
        if bridge.setpoint is not None:
            assert bridge.fence.breach(bridge.setpoint) is None
        if bridge.phase is Phase.READY and self.policy is not None:
            bridge.move(bridge.step, self.policy(bridge))
        vehicle.pass_time(tick_s, bridge.setpoint)

    def until(self, phase: Phase, limit_s: float = 3000.0) -> None:
        end_s = self.vehicle.now_s + limit_s
        while self.bridge.phase is not phase:
            assert self.vehicle.now_s < end_s, self.log[-5:]
            assert not self.bridge.is_over, self.log[-5:]
            self.tick()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.tick()


def fly_to_step(step: int, how: SafetySettings = ARMING, scenario: Scenario = SCENARIO) -> Flight:
    """A flight that moves at a step."""
    flight = Flight(how, scenario=scenario)
    while flight.bridge.step < step or flight.bridge.phase is not Phase.MOVING:
        flight.tick()
    return flight
