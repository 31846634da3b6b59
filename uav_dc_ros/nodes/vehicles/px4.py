"""PX4 over uXRCE-DDS: hears its topics, passes commands on, streams setpoints. It decides nothing.

The stream (see there) also ends while no position has come for `POSE_S` that PX4 trusts; then PX4's own
failsafe takes over (COM_OF_LOSS_T, COM_OBL_RC_ACT), as it does when the process is gone.

What is sent has the time 0: PX4 puts that of its arrival there, so nobody has to agree about clocks.
"""

import dataclasses
import importlib
import math
import re
import threading
import time
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.nodes.vehicles.other_setpoints import OtherSetpointPublishers
from uav_dc_ros.offboard import flight_stacks
from uav_dc_ros.offboard.frames import Enu, Geodetic, Ned
from uav_dc_ros.offboard.px4.telemetry import COMPANION, Px4Telemetry
from uav_dc_ros.offboard.setpoint_stream import STREAM_VEHICLE_S, SetpointStream
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, Telemetry

POSE_S = 0.5
LOOK_S = 1.0  # between two looks at which topics there are
NOT_CONTROLLED = [math.nan] * 3
RETURN, LAND, SET_MODE, ARM = 20, 21, 176, 400  # VEHICLE_CMD
CUSTOM_MODE = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED

HEARD = {  # in fmu/out
    "vehicle_status": "VehicleStatus",
    "vehicle_local_position": "VehicleLocalPosition",
    "vehicle_land_detected": "VehicleLandDetected",
    "battery_status": "BatteryStatus",
    "failsafe_flags": "FailsafeFlags",
    "vehicle_command_ack": "VehicleCommandAck",
    "vehicle_attitude": "VehicleAttitude",
    "home_position": "HomePosition",
}
NEEDED = ("vehicle_status", "vehicle_local_position")  # PX4 1.15 does not send all of the others
SENT = {  # in fmu/in
    "trajectory_setpoint": "TrajectorySetpoint",
    "offboard_control_mode": "OffboardControlMode",
    "vehicle_command": "VehicleCommand",
}
QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


def load_messages() -> Any:
    """The module of PX4's message classes.

    Raises:
        VehicleError: it is not there, or not of a PX4 that can be flown.
    """
    try:
        messages = importlib.import_module("px4_msgs.msg")
    except ImportError as error:
        raise VehicleError(
            f"a vehicle on PX4's topics needs the ROS package px4_msgs ({error}); expected it built from the "
            "branch of PX4's release, and its workspace sourced: https://github.com/PX4/px4_msgs"
        ) from None
    lacking = [kind for kind in (*HEARD.values(), *SENT.values()) if not hasattr(messages, kind)]
    if lacking:
        raise VehicleError(f"px4_msgs has no {', '.join(lacking)}; expected that of PX4 1.15 or later")
    return messages


def versioned(name: str, kind: Any) -> str:
    """Name of the topic of a message class: PX4 appends the version of the definition, if that is not 0."""
    version = getattr(kind, "MESSAGE_VERSION", 0)
    return f"{name}_v{version}" if version else name


class Px4Vehicle:
    """One vehicle on the topics `fmu/in/...` and `fmu/out/...` of a node's namespace.

    Args:
        node: that hears and sends; somebody else spins it.
        place: where the vehicle stands when its first position comes, in the grid's ENU frame.
        grid_origin: of the same transport before it was started again: takes the place of a datum.
        datum: of the grid, for a PX4 that knows where on the Earth it is; None: see `place`.
        restarted: was a bridge killed before it, even one that had no grid origin yet?

    Raises:
        VehicleError: px4_msgs is missing, or the grid origin is invalid.
    """

    def __init__(
        self,
        node: Node,
        *,
        place: Enu,
        grid_origin: str = "",
        datum: Geodetic | None = None,
        restarted: bool = False,
    ) -> None:
        self._messages = load_messages()
        self._node = node
        self._hearing = Px4Telemetry(place=place, grid_origin=grid_origin, datum=datum)
        self._lock = threading.Lock()  # of all below, and of `_hearing`
        self._streamed_vehicle_s = 0.0
        self._sent: Ned | None = None
        heartbeat = self._class("offboard_control_mode")()
        heartbeat.position = True
        self._messages_sent = {"trajectory_setpoint": None, "offboard_control_mode": heartbeat}
        self._silent = set(NEEDED)
        self._looked_s, self._seen = -math.inf, ""
        self._other_publishers = OtherSetpointPublishers(node, restarted=restarted or bool(grid_origin))
        self._subscriptions: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._stream: SetpointStream[Enu] = SetpointStream(self._send, "px4")

    def open(self) -> None:
        """Begin to listen."""
        for name in HEARD:
            self._subscriptions.append(
                self._node.create_subscription(
                    self._class(name), self._topic(name), partial(self._hear, name), QOS
                )
            )
        for name in SENT:
            self._publishers[name] = self._node.create_publisher(self._class(name), self._topic(name), QOS)
        self._stream.start()

    def close(self) -> None:
        """End the stream, and hear no more; more than once is as good as once."""
        self._stream.stop()
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())
        while self._publishers:
            self._node.destroy_publisher(self._publishers.popitem()[1])

    @property
    def kind(self) -> str:
        """Name of the autopilot; empty until it has spoken."""
        with self._lock:
            return flight_stacks.PX4.name if self._hearing.status is not None else ""

    @property
    def datum(self) -> Geodetic | None:
        """Where on the Earth the grid's corner lies; None: not known."""
        with self._lock:
            return self._hearing.datum

    @property
    def grid_origin(self) -> str:
        """Where the grid lies: its datum, or else PX4's origin in it; empty until it is known."""
        with self._lock:
            return self._hearing.grid_origin

    def telemetry(self) -> Telemetry:
        """What is known of the vehicle now, times as of `time.monotonic`."""
        with self._lock:
            known, silent = self._hearing.telemetry(), [name for name in NEEDED if name in self._silent]
        setpoints = self._publishers["trajectory_setpoint"].topic_name
        known = dataclasses.replace(known, other_controller=self._other_publishers.on(setpoints))
        if not silent:
            return known
        topics = ", ".join(self._topic(name) for name in silent)
        return dataclasses.replace(known, missing=f"nothing came on {topics} yet{self._others(silent)}")

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, from now on; or none. To be called at 2 Hz or more."""
        self._stream.set_setpoint(setpoint)

    def send_command(self, command: Command) -> None:
        """Send a command, once; `telemetry` reports what came of it. PX4 takes off by setpoints."""
        match command:
            case SetMode(Mode.RETURN):
                self._command(RETURN)
            case SetMode(Mode.LAND):  # here, heading as it does
                self._command(LAND, param4=math.nan, param5=math.nan, param6=math.nan, param7=math.nan)
            case SetMode(mode):
                main, sub = flight_stacks.PX4.mode_parameters(mode)
                self._command(SET_MODE, param1=CUSTOM_MODE, param2=main, param3=sub)
            case Arm():
                self._command(ARM, param1=1.0)

    # Topics.

    def _class(self, name: str) -> Any:
        return getattr(self._messages, HEARD.get(name) or SENT[name])

    def _topic(self, name: str) -> str:
        return versioned(f"fmu/{'out' if name in HEARD else 'in'}/{name}", self._class(name))

    def _hear(self, name: str, message: Any) -> None:
        with self._lock:
            self._silent.discard(name)
            self._hearing.hear(name, message, time.monotonic())
            hurry = self._hearing.vehicle_s - self._streamed_vehicle_s >= STREAM_VEHICLE_S
        if hurry:
            self._stream.hurry()

    def _others(self, silent: list[str]) -> str:
        """What a PX4 of another release publishes instead, in words."""
        if time.monotonic() - self._looked_s >= LOOK_S:
            self._looked_s = time.monotonic()
            bases = [self._node.resolve_topic_name(f"fmu/out/{name}") for name in silent]
            pattern = re.compile(f"({'|'.join(map(re.escape, bases))})(_v[0-9]+)?")
            ours = {self._node.resolve_topic_name(self._topic(name)) for name in silent}
            there = {name for name, _ in self._node.get_topic_names_and_types() if pattern.fullmatch(name)}
            others = sorted(name for name in there - ours if self._node.count_publishers(name))
            self._seen = (
                f", but {', '.join(others)} exists; expected px4_msgs of PX4's release" if others else ""
            )
        return self._seen

    # Sending.

    def _command(self, command: int, **parameters: float) -> None:
        status = self._hearing.status
        if status is None or "vehicle_command" not in self._publishers:
            return  # who knows whom it would reach
        message = self._class("vehicle_command")()
        for name, value in parameters.items():
            setattr(message, name, value)
        message.command = command
        message.target_system, message.target_component = status.system_id, status.component_id
        message.source_system, message.source_component = status.system_id, COMPANION
        message.from_external = True
        self._publishers["vehicle_command"].publish(message)

    def _send(self, setpoint: Enu) -> None:
        """Send a setpoint, then the heartbeat that has PX4 follow it: the stream's thread."""
        with self._lock:
            hearing = self._hearing
            self._streamed_vehicle_s = hearing.vehicle_s
            if hearing.frame is None or hearing.position_s is None:
                return
            if time.monotonic() - hearing.position_s > POSE_S:
                return
            ned = hearing.frame.to_autopilot(setpoint)
        if ned != self._sent:  # made anew only then: the less there is to do, the better the pace
            message, self._sent = self._class("trajectory_setpoint")(), ned
            message.position = list(ned)
            message.velocity = message.acceleration = message.jerk = NOT_CONTROLLED
            message.yaw = message.yawspeed = math.nan
            self._messages_sent["trajectory_setpoint"] = message
        for name, message in self._messages_sent.items():
            self._publishers[name].publish(message)
