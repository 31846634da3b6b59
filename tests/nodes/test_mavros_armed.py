"""Whole missions with --arm through MAVROS's services, which need mavros_msgs: by stand-ins, see below.

mavros_msgs cannot be installed where this is tested. So there is no DDS here: a stand-in for the node hands
plain objects with the fields of mavros_msgs to the transport's callbacks, and takes its requests to the
fake autopilot that tests/autopilot has, in simulated time. The stream's thread has its tests in
test_mavros_parts.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from pymavlink.dialects.v20 import ardupilotmega as mav
from rclpy.task import Future

from tests.nodes.test_mavros_parts import HEALTHY, PACKAGE, Message, estimator
from tests.support.fake_autopilot.autopilot import TICK_S, Autopilot, Copter
from tests.support.fake_autopilot.common import way_home
from tests.support.fake_autopilot.mavros_flight import SCENARIO, START
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.ros import convert
from uav_dc_ros.nodes.vehicles import mavros
from uav_dc_ros.nodes.vehicles.mavros import MavrosVehicle
from uav_dc_ros.offboard.frames import Enu, Ned, to_enu, to_ned
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings

STANDS = Enu(-7.0, 11.0, 3.0)
READY_S = 5.0
COMMANDS = {
    "mavros/cmd/arming": lambda asked: {
        "command": mav.MAV_CMD_COMPONENT_ARM_DISARM,
        "param1": float(asked.value),
    },
    "mavros/cmd/takeoff": lambda asked: {"command": mav.MAV_CMD_NAV_TAKEOFF, "param7": asked.altitude},
}


class Clock:
    """Simulated time, as the module `time` tells it."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def time_ns(self) -> int:
        return round(self.now_s * 1e9)


class Direct:
    """A stream without a thread: sends what it is steered to."""

    def __init__(self, send: Callable[[Any], None], name: str) -> None:
        self.send = send

    def start(self) -> None:
        pass

    def stop(self) -> None:
        pass

    def set_setpoint(self, target: Any) -> None:
        if target is not None:
            self.send(target)


class Node:
    """The node, MAVROS and the autopilot behind it, in one."""

    def __init__(self, kind: str, clock: Clock) -> None:
        self.copter, self.clock, self.beats = Copter(kind, READY_S), clock, 0
        self.autopilot = Autopilot(self.copter, system=1)
        self.callbacks: dict[str, Callable[[Any, Any], None]] = {}
        self.services: list[tuple[str, Any]] = []
        self.setpoints: list[Enu] = []
        self.info = {"received_timestamp": 0}

    # As a node.

    def create_publisher(self, kind: Any, name: str, *_: Any, **__: Any) -> Any:
        return SimpleNamespace(topic_name=name, get_subscription_count=lambda: 1, publish=self.on_setpoint)

    def create_subscription(self, kind: Any, name: str, callback: Any, *_: Any, **__: Any) -> Any:
        self.callbacks[name] = callback
        return SimpleNamespace(topic_name=name)

    def create_client(self, kind: Any, name: str) -> Any:
        return SimpleNamespace(service_is_ready=lambda: True, call_async=lambda asked: self.call(name, asked))

    def destroy_client(self, _: Any) -> None: ...

    destroy_publisher = destroy_subscription = destroy_client

    def count_publishers(self, _: str) -> int:
        return 1

    def get_clock(self) -> Any:
        return SimpleNamespace(
            now=lambda: SimpleNamespace(to_msg=lambda: convert.stamp(self.clock.time_ns()))
        )

    # As MAVROS.

    def on_setpoint(self, message: PoseStamped) -> None:
        point = message.pose.position
        enu = Enu(*(p - s for p, s in zip((point.x, point.y, point.z), STANDS, strict=True)))
        self.setpoints.append(enu)
        ned = dict(zip("xyz", to_ned(enu), strict=True)) | dict.fromkeys(("vx", "vy", "vz"), 0.0)
        self.autopilot._setpoint(Message(coordinate_frame=1, type_mask=0x9F8, **ned))

    def call(self, service: str, asked: Any) -> Future:
        self.services.append((service, asked))
        answer = Message(success=True, result=0, mode_sent=True)
        command: dict[str, Any] | None = None
        if service == "mavros/set_mode":
            number = self.copter.modes[asked.custom_mode]
            main, sub = (number >> 16 & 0xFF, number >> 24) if self.copter.px4 else (number, 0)
            command = {"command": mav.MAV_CMD_DO_SET_MODE, "param1": 1.0, "param2": main, "param3": sub}
        elif service in COMMANDS:
            command = COMMANDS[service](asked)
        if command is not None:
            answer.result, why = self.autopilot._command(Message(**command))
            answer.success = answer.result == 0
            if why:
                self.callbacks["mavros/statustext/recv"](Message(severity=2, text=why), self.info)
        future = Future()
        future.set_result(answer)
        return future

    def tell(self) -> None:
        """What MAVROS publishes now."""
        c = self.copter
        kind = "PX4 Autopilot" if c.px4 else "ArduPilot"
        self.beats += 1
        values = {"Heartbeats since startup": str(self.beats), "Autopilot type": kind, "Mode": c.mode}
        values |= {"Vehicle type": "Quadrotor", "System status": "Active" if c.armed else "Standby"}
        status = DiagnosticStatus(name="mavros: Heartbeat", hardware_id="uas:///uas1")
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        health = HEALTHY if c.ready else 0
        told = {
            "/diagnostics": DiagnosticArray(status=[status]),
            "mavros/state": Message(connected=True, armed=c.armed, mode=c.mode, system_status=4),
            "mavros/extended_state": Message(landed_state=c.landed_state),
            "mavros/sys_status": Message(sensors_enabled=HEALTHY, sensors_health=health),
        }
        if c.px4:
            told["mavros/estimator_status"] = estimator(pos_horiz_abs=c.ready)
        if c.t_s >= 2.0:
            pose = PoseStamped()
            pose.header.frame_id, pose.header.stamp = "map", convert.stamp(self.clock.time_ns())
            point = pose.pose.position
            point.x, point.y, point.z = (e + s for e, s in zip(to_enu(Ned(*c.ned)), STANDS, strict=True))
            told["mavros/local_position/pose"] = pose
        for topic, message in told.items():
            self.callbacks[topic](message, self.info)


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_a_whole_mission_that_arms(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    node = Node(kind, clock)
    monkeypatch.setattr(mavros, "time", clock)
    monkeypatch.setattr(mavros, "SetpointStream", Direct)
    monkeypatch.setattr(mavros, "load_messages", lambda needed_for: PACKAGE)
    vehicle = MavrosVehicle(node, start=START, arms=True)  # type: ignore[arg-type]
    vehicle.open()
    log: list[tuple[Phase, str]] = []
    bridge = MissionController(
        SCENARIO, SafetySettings(arm=True), lambda: log.append((bridge.phase, bridge.reason))
    )
    cells, refusals = [], set()
    while not bridge.is_over:
        assert clock.now_s < 1400.0, log[-5:]
        for _ in range(2):
            node.copter.tick()
        clock.now_s += 2 * TICK_S
        node.tell()
        known = vehicle.telemetry()
        refusals.add(known.refusal)
        for command in bridge.tick(clock.now_s, known):
            vehicle.send_command(command)
        if bridge.phase is Phase.READY and bridge.fault is None:
            assert bridge.move(bridge.step, way_home(bridge)) is None
            cells.append(bridge.progress.goal)
        vehicle.set_setpoint(bridge.setpoint)
    assert bridge.phase is Phase.LANDED, log[-5:]
    assert cells == [(2, 0, 0), (2, 1, 0), (2, 1, 0)]
    c = node.copter
    assert (c.landed, c.armed, node.autopilot.interrupted) == (True, False, 0)
    grid = np.add((c.ned[1], c.ned[0]), START[:2])
    assert np.allclose(grid, SCENARIO.mission.dock_m, atol=2.0)
    asked = [(name, vars(command)) for name, command in node.services if "interval" not in name]
    mode, land = ("OFFBOARD", "AUTO.LAND") if c.px4 else ("GUIDED", "LAND")
    takeoff = [] if c.px4 else [("mavros/cmd/takeoff", {"altitude": pytest.approx(10.0, abs=0.1)})]
    others = [entry for i, entry in enumerate(asked) if i == 0 or entry != asked[i - 1]]
    assert others == [
        ("mavros/set_mode", {"custom_mode": mode}),
        ("mavros/cmd/arming", {"value": True}),
        *takeoff,
        ("mavros/set_mode", {"custom_mode": land}),
    ]
    intervals = {command.message_id for name, command in node.services if "interval" in name}
    assert intervals <= {32, 245, 230}
    assert 32 in intervals, "no pose came for two seconds"
    if c.px4:
        assert refusals <= {None, "the change of mode refused: Offboard control signal lost: no setpoints"}
        assert min(setpoint.up_m for setpoint in node.setpoints) >= -0.1
    vehicle.close()
