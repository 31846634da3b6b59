"""The fake autopilot as a process, and a whole flight against it: bridge, transport, a trivial policy."""

import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tests.support.fake_autopilot.common import FakeProcess, FlightRecord, way_home
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu, Ned, to_enu
from uav_dc_ros.offboard.mavlink.vehicle import MavlinkVehicle
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Telemetry

ROOT = Path(__file__).parents[3]
SCENARIO = scenarios.load("five_clusters_hover")
KINDS = ("ardupilot", "px4")
WIRES = ("tcp", "udp")


def free_udp_port() -> int:
    """A port that was free a moment ago."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Fake(FakeProcess):
    """The process; `address` is where the bridge finds it."""

    def __init__(
        self,
        kind: str,
        wire: str = "tcp",
        *,
        speed: float = 1.0,
        ready_s: float = 5.0,
        station: int | None = None,
    ) -> None:
        number = free_udp_port() if wire == "udp" else 0
        command = [
            sys.executable,
            *("-X", "faulthandler"),
            *("-m", "tests.support.fake_autopilot.autopilot"),
            "--kind",
            kind,
            f"--{wire}",
            str(number),
        ]
        at = () if station is None else ("--station", str(station))
        process = subprocess.Popen(
            [*command, "--speed", str(speed), "--ready-s", str(ready_s), *at],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        super().__init__(process)
        port = self.wait_for("listens")["port"]
        self.address = f"{'tcp' if wire == 'tcp' else 'udpin'}:127.0.0.1:{port}"

    def do(self, *words: object) -> None:
        """A line of `Control`'s."""
        self.write(" ".join(map(str, words)))

    @property
    def n_arms(self) -> int:
        """Commands to arm that it has received."""
        return sum(event["command"] == 400 for event in self.all("command"))

    def report(self) -> dict[str, Any]:
        """How it is now."""
        self.do("report")
        return self.wait_for("report")


@contextlib.contextmanager
def fake(kind: str, wire: str = "tcp", **options: Any) -> Iterator[Fake]:
    """A fake autopilot for the time of a block."""
    autopilot = Fake(kind, wire, **options)
    try:
        yield autopilot
    finally:
        autopilot.close()


class Flight(FlightRecord):
    """One flight, tick by tick, as the bridge's node does it.

    Attributes:
        known: the telemetry of the last tick.
        unflown: steps that counted, though the position that was reported was that of another cell.
    """

    def __init__(
        self,
        autopilot: Fake,
        how: SafetySettings,
        scenario: Scenario = SCENARIO,
        fence: Sequence[Enu] = (),
        **bridge: Any,
    ) -> None:
        super().__init__()
        self.fake = autopilot
        self.known = Telemetry()
        self.unflown: list[int] = []
        self._step = 0
        self.bridge = MissionController(scenario, how, self._note, **bridge)
        start = scenario.mission.start_m
        self.place = Enu(start[0], start[1], 0.0)
        self.vehicle = MavlinkVehicle(autopilot.address, start=self.place, fence=fence)
        self.policy: Callable[[MissionController], Action] | None = way_home

    def _note(self) -> None:
        bridge = self.bridge
        if bridge.step != self._step:
            self._step = bridge.step
            self._check_step()
        self.record(bridge)

    def _check_step(self) -> None:
        grid, centre = self.bridge.scenario.grid, self.bridge.progress.centre(self.bridge.cell)
        sizes_m = (grid.cell_m, grid.cell_m, grid.altitude_step_m)
        here = self.known.position
        if here is None or any(
            abs(h - c) > size / 2 for h, c, size in zip(here, centre, sizes_m, strict=True)
        ):
            self.unflown.append(self.bridge.step)

    def tick(self) -> None:
        """What the node's timer does."""
        bridge = self.bridge
        self.known = self.vehicle.telemetry()
        for command in bridge.tick(time.monotonic(), self.known):
            self.vehicle.send_command(command)
        if bridge.phase is Phase.READY and bridge.fault is None and self.policy is not None:
            bridge.move(bridge.step, self.policy(bridge))
        self.vehicle.set_setpoint(bridge.setpoint)

    def until(
        self, done: Callable[[], bool], seconds: float = 200.0, beat: Callable[[], None] = lambda: None
    ) -> None:
        """Fly until something is so."""
        end = time.monotonic() + seconds
        while not done():
            assert time.monotonic() < end, (self.log[-6:], self.fake.events[-6:])
            self.tick()
            beat()
            time.sleep(0.002)

    def outside(self) -> list[dict[str, Any]]:
        """Setpoints that the autopilot received in another form or frame, or outside the fence."""
        return [event for event in self.fake.all("setpoint") if not self._is_right(event)]

    def _is_right(self, event: dict[str, Any]) -> bool:
        up = to_enu(Ned(*event["ned"]))
        grid = Enu(*(u + p for u, p in zip(up, self.place, strict=True)))
        form = (event["frame"], event["mask"])
        return form == (1, 0xDF8) and self.bridge.fence.breach(grid) is None
