"""A flight beside a fake MAVROS: its process, and bridge and transport on a node's executor in this one."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy

from tests.conftest import Ros
from tests.support.fake_autopilot.common import FakeProcess, FlightRecord, way_home
from tests.support.worlds import changed
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.ros.executor import DirectExecutor
from uav_dc_ros.nodes.vehicles.mavros import MavrosVehicle
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings

START = Enu(20.0, 0.0, 0.0)  # on the ground below it
SCENARIO = changed(
    "three_clusters_hover",
    grid={"n_x": 3, "n_y": 3, "n_z": 1, "cell_m": 20.0, "altitude_min_m": 10.0, "altitude_step_m": 5.0},
    users={"cluster_centres_m": [[20.0, 0.0]], "users_per_cluster": 4, "cluster_radius_m": 5.0},
    mission={"start_m": [20.0, 0.0, 10.0], "dock_m": [40.0, 20.0], "max_steps": 3},
)


class Fake(FakeProcess):
    """The process of the fake MAVROS."""

    def __init__(self, ros: Ros, *arguments: object) -> None:
        super().__init__(ros.start("tests.support.fake_autopilot.mavros", *arguments, stdin=-1))
        self.wait_for("ready")

    def do(self, line: str) -> None:
        """A command, done when this returns."""
        self.write(line)
        while self.wait_for("done")["line"] != line:
            pass

    def report(self) -> dict[str, Any]:
        """Its state, and when it received setpoints."""
        self.write("report")
        return self.wait_for("report") | self.wait_for("times")


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


class Flight(FlightRecord):
    """One flight, tick by tick, as the bridge's node does it."""

    def __init__(
        self,
        executor: DirectExecutor,
        vehicle: MavrosVehicle,
        mavros: Fake,
        how: SafetySettings,
        **bridge: Any,
    ) -> None:
        super().__init__()
        self.executor, self.vehicle, self.mavros = executor, vehicle, mavros
        self.bridge = MissionController(SCENARIO, how, lambda: self.record(self.bridge), **bridge)

    def tick(self) -> None:
        """What the node's executor and timer do."""
        spin(self.executor, 0.01)
        bridge = self.bridge
        for command in bridge.tick(time.monotonic(), self.vehicle.telemetry()):
            self.vehicle.send_command(command)
        if bridge.phase is Phase.READY and bridge.fault is None:
            bridge.move(bridge.step, way_home(bridge))
        self.vehicle.set_setpoint(bridge.setpoint)

    def until(self, done: Callable[[], bool], seconds: float = 200.0) -> None:
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
