"""A whole flight in one thread, without a link and without a clock: fake autopilot, MAVLink, bridge, policy.

All of it happens in the vehicle's time, at the same moments in every run, and a minute takes a second or
two. `channel` stands between autopilot and bridge: it may hold back, repeat or change what the autopilot
sends. Where the link is down nothing passes, in either direction.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from tests.support.fake_autopilot.autopilot import Autopilot, Control
from tests.support.fake_autopilot.common import FlightRecord, way_home
from tests.support.fake_autopilot.copter import TICK_S, Copter
from tests.support.fake_autopilot.flight import SCENARIO
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mavlink.fence_upload import FenceUpload
from uav_dc_ros.offboard.mavlink.session import Session
from uav_dc_ros.offboard.mavlink.telemetry import MavlinkTelemetry
from uav_dc_ros.offboard.mavlink.vehicle import load_codec
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import UPLOAD_MARGIN_M, Geofence

LOOKS = 2  # after so many ticks of the vehicle the bridge looks: half as often as its node does

# What the autopilot sent, and now: what arrives now.
Channel = Callable[[list[bytes], float], Iterable[bytes]]


def short(steps: int = 6) -> Scenario:
    """Five clusters at a fifth of their size, near the ground, with a few steps."""
    grid, mission = SCENARIO.grid, SCENARIO.mission
    small = msgspec.structs.replace(grid, cell_m=20.0, altitude_min_m=10.0, altitude_step_m=5.0)
    start = (mission.start_m[0] / 5, mission.start_m[1] / 5, 15.0)
    dock = (start[0] + 40.0, start[1])
    way = msgspec.structs.replace(mission, start_m=start, dock_m=dock, max_steps=steps)
    users = msgspec.structs.replace(
        SCENARIO.users,
        cluster_centres_m=tuple((x / 5, y / 5) for x, y in SCENARIO.users.cluster_centres_m),
        cluster_radius_m=SCENARIO.users.cluster_radius_m / 5,
    )
    return msgspec.structs.replace(SCENARIO, grid=small, mission=way, users=users)


class VirtualFlight(FlightRecord):
    """One flight, tick by tick; `do` commands the fake autopilot.

    Args:
        kind: of the autopilot.
        how: carefully it is flown.
        scenario: the world.
        channel: from the autopilot to the bridge; None: all arrives at once.
        datum, datum_deg: of the grid.
        system: the vehicle that is meant.
        upload_fence: whether the fence is uploaded before take-off.
        speed: how many times faster than the clock its time runs.
        looks: after so many of its ticks the bridge looks; 1: as often as its node.

    Attributes:
        copter, autopilot: the fake; `events` are those that it emits.
        bridge: decides.
        link_is_up: may be set.
    """

    def __init__(
        self,
        kind: str,
        how: SafetySettings | None = None,
        scenario: Scenario | None = None,
        channel: Channel | None = None,
        datum: Geodetic | None = None,
        datum_deg: tuple[float, float] | None = None,
        system: int | None = None,
        speed: float = 1.0,
        looks: int = LOOKS,
        upload_fence: bool = False,
        **bridge: Any,
    ) -> None:
        super().__init__()
        scenario = scenario or short()
        self.events: list[dict[str, Any]] = []
        self.copter = Copter(kind, 3.0)
        self.copter.emit = self._emit  # type: ignore[method-assign]
        self.autopilot = Autopilot(self.copter, system=1)
        self.channel = channel or (lambda sent, now_s: sent)
        start = scenario.mission.start_m
        self.place = Enu(start[0], start[1], 0.0)
        corners = Geofence.around(scenario).outline(UPLOAD_MARGIN_M)
        upload = FenceUpload(corners) if upload_fence else None
        self.telemetry = MavlinkTelemetry(datum, self.place, system, datum_deg=datum_deg, fence=upload)
        self.session = Session(load_codec(), self.telemetry, self._write)
        self.link_is_up, self.now_s, self.speed, self.looks = True, 1000.0, speed, looks
        self._control = Control(self.autopilot)
        self.bridge = MissionController(scenario, how or SafetySettings(arm=True), self._note, **bridge)
        self.policy: Callable[[MissionController], Action] | None = way_home
        self.session.keep_alive(self.now_s)
        self.session.on_connected(self.now_s)

    def _emit(self, event: str, **more: Any) -> None:
        self.events.append({"event": event, "t_s": self.copter.t_s, **more})

    def _note(self) -> None:
        self.record(self.bridge)

    def _write(self, data: bytes) -> bool:
        if self.link_is_up:
            self.autopilot.receive(data)
        return self.link_is_up

    def do(self, line: str) -> None:
        """A line of `Control`'s; what needs a process of its own is none for here."""
        self._control._do(*line.split())

    def restart(self, system: int | None) -> None:
        """Another bridge resumes the mission of this one, which was killed.

        Args:
            system: the vehicle that the journal names.
        """
        checkpoint, old = self.bridge.checkpoint, self.bridge
        self.telemetry = MavlinkTelemetry(self.telemetry.datum, self.place, system, again=True)
        self.session = Session(load_codec(), self.telemetry, self._write)
        self.bridge = MissionController(old.scenario, old.settings, self._note, checkpoint, old.fence)
        self.session.keep_alive(self.now_s)
        self.session.on_connected(self.now_s)

    def all(self, event: str) -> list[dict[str, Any]]:
        """All events of a name so far."""
        return [each for each in self.events if each["event"] == event]

    def tick(self) -> None:
        """Until the bridge has looked once more."""
        for _ in range(self.looks):
            self.now_s += TICK_S / self.speed
            self.copter.tick()
            self.autopilot.answer()
            self.autopilot.send_due()
        out = bytes(self.autopilot.out)
        self.autopilot.out.clear()
        for data in self.channel(list(_split(out)) if self.link_is_up else [], self.now_s):
            self.session.receive(data, self.now_s)
        known = self.telemetry.snapshot(self.now_s)
        for command in self.bridge.tick(self.now_s, known):
            self.session.queue_command(command)
        bridge = self.bridge
        if bridge.phase is Phase.READY and bridge.fault is None and self.policy is not None:
            bridge.move(bridge.step, self.policy(bridge))
        if bridge.setpoint is not None:
            assert bridge.fence.breach(bridge.setpoint) is None
        self.session.set_setpoint(bridge.setpoint, self.now_s)
        self.session.send(self.now_s)

    def until(self, done: Callable[[], Any], limit_s: float = 600.0) -> None:
        """Fly until something is so, for so long at most, vehicle time."""
        end_s = self.copter.t_s + limit_s
        while not done():
            assert self.copter.t_s < end_s, (self.log[-5:], self.events[-5:])
            self.tick()

    def run(self, seconds: float) -> None:
        """Fly for a while."""
        for _ in range(round(seconds / (self.looks * TICK_S))):
            self.tick()

    def until_over(self, limit_s: float = 900.0) -> str:
        """Fly to the end of the mission; its reason."""
        self.until(lambda: self.bridge.is_over, limit_s)
        return self.bridge.reason

    def place_of_grid(self) -> Enu:
        """Where it really is, in the grid's frame (without a datum)."""
        north, east, down = self.copter.ned
        return Enu(self.place.east_m + east, self.place.north_m + north, self.place.up_m - down)

    def dock_distance_m(self) -> float:
        """How far it really is from the dock."""
        return math.dist(self.place_of_grid()[:2], self.bridge.scenario.mission.dock_m)


def _split(data: bytes) -> Iterable[bytes]:
    """Messages of MAVLink 1 and 2, each by itself."""
    while data:
        size = data[1] + (12 if data[0] == 0xFD else 8)
        yield data[:size]
        data = data[size:]
