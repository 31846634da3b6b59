"""A flight beside a fake MAVROS: its process, and bridge and transport on a node's executor in this one."""

import contextlib
import json
import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy

from tests.conftest import Ros
from tests.support.worlds import changed
from uav_dc_ros.core.grid import Action
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.ros.executor import DirectExecutor
from uav_dc_ros.nodes.vehicles.mavros import MavrosVehicle
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings

START = Enu(20.0, 0.0, 0.0)  # on the ground below it
SCENARIO = changed(
    "three_clusters",
    grid={"n_x": 3, "n_y": 3, "n_z": 1, "cell_m": 20.0, "altitude_min_m": 10.0, "altitude_step_m": 5.0},
    users={"cluster_centres_m": [[20.0, 0.0]], "users_per_cluster": 4, "cluster_radius_m": 5.0},
    mission={"start_m": [20.0, 0.0, 10.0], "dock_m": [40.0, 20.0], "max_steps": 3},
)


class Fake:
    """The fake MAVROS; it is told what to do, and tells what happened."""

    def __init__(self, ros: Ros, *arguments: object) -> None:
        self.process = ros.start("tests.support.fake_autopilot.mavros", *arguments, stdin=-1)
        self.events: list[dict[str, Any]] = []
        self._new: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()
        self.wait_for("ready")

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            event = json.loads(line) if line.startswith("{") else {"event": "printed", "line": line}
            self.events.append(event)
            self._new.put(event)

    def wait_for(self, event: str, seconds: float = 90.0) -> dict[str, Any]:
        """The next event of a name that was not waited for yet."""
        end = time.monotonic() + seconds
        while True:
            try:
                told = self._new.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"no {event!r} within {seconds} s: {self.events[-5:]}") from None
            if told["event"] == event:
                return told

    def do(self, line: str) -> None:
        """A command, done when this returns."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()
        while self.wait_for("done")["line"] != line:
            pass

    def report(self) -> dict[str, Any]:
        """How it is now, and when it heard setpoints."""
        assert self.process.stdin is not None
        self.process.stdin.write("report\n")
        self.process.stdin.flush()
        return self.wait_for("report") | self.wait_for("times")

    def all(self, event: str) -> list[dict[str, Any]]:
        """All events of a name so far."""
        return [told for told in self.events if told["event"] == event]

    def close(self) -> None:
        """End it; it must have lived until now."""
        died = self.process.poll()
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self.process.wait(10.0)
        assert died is None, self.events[-20:]


@contextlib.contextmanager
def fake(ros: Ros, kind: str, *arguments: object) -> Iterator[Fake]:
    """A fake MAVROS for the time of a block."""
    mavros = Fake(ros, "--kind", kind, *arguments)
    try:
        yield mavros
    finally:
        mavros.close()


@contextlib.contextmanager
def node_in(ros: Ros, *arguments: str) -> Iterator[tuple[rclpy.node.Node, DirectExecutor]]:
    """A node in the test's domain, in this process, and its executor: the one that the bridge node has."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOG_DIR"):
            patch.setenv(name, ros.environment[name])
        rclpy.init(args=["--ros-args", *arguments] if arguments else None)
        node = rclpy.create_node("bridge")
        try:
            executor = DirectExecutor()
            executor.add_node(node)
            yield node, executor
        finally:
            node.destroy_node()
            rclpy.shutdown()


@contextlib.contextmanager
def mavros_of(node: rclpy.node.Node, **how: Any) -> Iterator[MavrosVehicle]:
    """The transport, open, for the time of a block."""
    vehicle = MavrosVehicle(node, start=START, **how)
    vehicle.open()
    with contextlib.closing(vehicle):
        yield vehicle


def way_home(bridge: MissionController) -> Action:
    """A policy: straight to the dock, then hover."""
    (x, y, _), (dock_x, dock_y) = bridge.cell, bridge.scenario.dock_cell
    if x != dock_x:
        return Action.RIGHT if x < dock_x else Action.LEFT
    return Action.HOVER if y == dock_y else Action.FORWARD


class Flight:
    """One flight, tick by tick, as the bridge's node does it.

    Attributes:
        log: each change of phase or reason, with the step.
        executed, cells: the step of each move that was flown, and the cell that it led to.
    """

    def __init__(
        self,
        executor: DirectExecutor,
        vehicle: MavrosVehicle,
        mavros: Fake,
        how: SafetySettings,
        **bridge: Any,
    ) -> None:
        self.executor, self.vehicle, self.mavros = executor, vehicle, mavros
        self.log: list[tuple[Phase, int, str]] = []
        self.executed: list[int] = []
        self.cells: list[tuple[int, int, int]] = []
        self.bridge = MissionController(SCENARIO, how, self._note, **bridge)

    def _note(self) -> None:
        bridge = self.bridge
        if bridge.phase is Phase.MOVING and (not self.log or self.log[-1][0] is not Phase.MOVING):
            self.executed.append(bridge.step)
            self.cells.append(bridge.progress.goal)
        self.log.append((bridge.phase, bridge.step, bridge.reason))

    def tick(self) -> None:
        """What the node's executor and timer do."""
        spin(self.executor, 0.01)
        bridge = self.bridge
        for command in bridge.tick(time.monotonic(), self.vehicle.telemetry()):
            self.vehicle.send_command(command)
        if bridge.phase is Phase.READY and bridge.fault is None:
            bridge.move(bridge.step, way_home(bridge))
        self.vehicle.set_setpoint(bridge.setpoint)

    def until(self, done: Callable[[], bool], seconds: float = 90.0) -> None:
        """Fly until something is so."""
        end = time.monotonic() + seconds
        while not done():
            assert time.monotonic() < end, (self.log[-6:], self.vehicle.telemetry(), self.mavros.events[-6:])
            self.tick()

    def pilot_sets(self, mode: str) -> None:
        """Have a pilot set a mode, and again until it is so, and is known here."""
        asked_s = 0.0

        def is_so() -> bool:
            nonlocal asked_s
            if time.monotonic() - asked_s > 0.5:
                asked_s = time.monotonic()
                self.mavros.do(f"mode {mode}")
            return self.vehicle.telemetry().mode_name == mode

        self.until(is_so)


def spin(executor: DirectExecutor, seconds: float) -> None:
    """Handle what comes within a time."""
    end = time.monotonic() + seconds
    while (left_s := end - time.monotonic()) > 0:
        executor.spin_once(left_s)
