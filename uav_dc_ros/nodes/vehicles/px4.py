"""PX4 over uXRCE-DDS: receives telemetry, sends commands, streams setpoints. It decides nothing.

The stream also ends `POSE_TIMEOUT_S` after the last position that PX4 trusts; then PX4's own failsafe takes
over (COM_OF_LOSS_T, COM_OBL_RC_ACT), as it does when the process has died.

Messages are sent with time 0, which PX4 replaces by their arrival, so clocks need not be synchronised.
"""

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
from uav_dc_ros.nodes.vehicles.graph_checks import PeriodicCheck, other_publishers
from uav_dc_ros.offboard import flight_stacks
from uav_dc_ros.offboard.frames import Enu, Geodetic, Ned
from uav_dc_ros.offboard.px4.telemetry import COMPANION, Px4Telemetry
from uav_dc_ros.offboard.setpoint_stream import STREAM_VEHICLE_S, SetpointStream
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, Telemetry

POSE_TIMEOUT_S = 0.5
NOT_CONTROLLED = [math.nan] * 3
RETURN, LAND, SET_MODE, ARM = 20, 21, 176, 400  # VEHICLE_CMD
CUSTOM_MODE = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED

SUBSCRIBED = (  # in fmu/out
    *("vehicle_status", "vehicle_local_position", "vehicle_land_detected", "battery_status"),
    *("failsafe_flags", "vehicle_command_ack", "vehicle_attitude", "home_position"),
)
REQUIRED = ("vehicle_status", "vehicle_local_position")  # PX4 1.15 does not send all of the others
PUBLISHED = ("trajectory_setpoint", "offboard_control_mode", "vehicle_command")  # in fmu/in
QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


def load_messages() -> Any:
    """The module of PX4's message classes; raises VehicleError if it is not installed, or too old."""
    try:
        messages = importlib.import_module("px4_msgs.msg")
    except ImportError as error:
        raise VehicleError(
            f"a vehicle on PX4's topics needs the ROS package px4_msgs ({error}); expected it built from the "
            "branch of PX4's release, and its workspace sourced: https://github.com/PX4/px4_msgs"
        ) from None
    kinds = map(class_name, (*SUBSCRIBED, *PUBLISHED))
    lacking = [kind for kind in kinds if not hasattr(messages, kind)]
    if lacking:
        raise VehicleError(f"px4_msgs has no {', '.join(lacking)}; expected that of PX4 1.15 or later")
    return messages


def class_name(topic: str) -> str:
    """Name of the message class of a topic: `VehicleStatus` of `vehicle_status`."""
    return topic.title().replace("_", "")


def versioned(name: str, kind: Any) -> str:
    """Name of the topic of a message class: PX4 appends the version of the definition, if it is not 0."""
    version = getattr(kind, "MESSAGE_VERSION", 0)
    return f"{name}_v{version}" if version else name


class Px4Vehicle:
    """One vehicle on the topics `fmu/in/...` and `fmu/out/...` of a node's namespace, see `Vehicle`.

    Arguments: see `vehicles.make`. The caller spins the node. Raises VehicleError if px4_msgs is missing, or
    the grid origin is invalid.
    """

    def __init__(
        self,
        node: Node,
        *,
        start: Enu,
        grid_origin: str = "",
        datum: Geodetic | None = None,
        datum_deg: tuple[float, float] | None = None,
        restarted: bool = False,
    ) -> None:
        self._messages = load_messages()
        self._node, self._restarted = node, restarted or bool(grid_origin)
        self._telemetry = Px4Telemetry(start=start, grid_origin=grid_origin, datum=datum, datum_deg=datum_deg)
        self._lock = threading.Lock()  # of all below, and of `_telemetry`
        self._streamed_vehicle_s = 0.0
        self._sent: Ned | None = None
        heartbeat = self._class("offboard_control_mode")()
        heartbeat.position = True
        self._stream_messages = {"trajectory_setpoint": None, "offboard_control_mode": heartbeat}
        self._silent = set(REQUIRED)
        self._other_release = PeriodicCheck(self._find_other_release)
        self._subscriptions: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._stream: SetpointStream[Enu] = SetpointStream(self._publish, "px4")

    def open(self) -> None:
        """Create subscriptions and publishers, and start the stream."""
        for name in SUBSCRIBED:
            interface = self._class(name), self._topic(name), partial(self._on_message, name), QOS
            self._subscriptions.append(self._node.create_subscription(*interface))
        for name in PUBLISHED:
            self._publishers[name] = self._node.create_publisher(self._class(name), self._topic(name), QOS)
        topic = self._publishers["trajectory_setpoint"].topic_name
        self._other_publishers = other_publishers(self._node, topic, restarted=self._restarted)
        self._stream.start()

    def close(self) -> None:
        """End the stream, and destroy what `open` created; idempotent."""
        self._stream.stop()
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())
        while self._publishers:
            self._node.destroy_publisher(self._publishers.popitem()[1])

    def telemetry(self) -> Telemetry:
        """The vehicle's state now, times as of `time.monotonic`."""
        other_controller = self._other_publishers()
        with self._lock:
            telemetry, silent = self._telemetry.snapshot(other_controller), self._silent_names()
        if not silent:
            return telemetry
        topics = ", ".join(self._topic(name) for name in silent)
        missing = f"nothing received on {topics} yet{self._other_release() or ''}"
        return telemetry.replace(missing=missing)

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, from now on; or none. To be called at 2 Hz or more."""
        self._stream.set_setpoint(setpoint)

    def send_command(self, command: Command) -> None:
        """Send a command once; `telemetry` reports its effect. PX4 takes off by setpoints."""
        match command:
            case SetMode(Mode.RETURN):
                self._publish_command(RETURN)
            case SetMode(Mode.LAND):
                here = dict.fromkeys(("param4", "param5", "param6", "param7"), math.nan)  # and heading
                self._publish_command(LAND, **here)
            case SetMode(mode):
                main, sub = flight_stacks.PX4.mode_parameters(mode)
                self._publish_command(SET_MODE, param1=CUSTOM_MODE, param2=main, param3=sub)
            case Arm():
                self._publish_command(ARM, param1=1.0)

    def _class(self, name: str) -> Any:
        return getattr(self._messages, class_name(name))

    def _topic(self, name: str) -> str:
        return versioned(f"fmu/{'out' if name in SUBSCRIBED else 'in'}/{name}", self._class(name))

    def _on_message(self, name: str, message: Any) -> None:
        with self._lock:
            self._silent.discard(name)
            self._telemetry.update(name, message, time.monotonic())
            due = self._telemetry.vehicle_s - self._streamed_vehicle_s >= STREAM_VEHICLE_S
        if due:
            self._stream.hurry()

    def _silent_names(self) -> list[str]:
        return [name for name in REQUIRED if name in self._silent]

    def _find_other_release(self) -> str | None:
        """Topics that a PX4 of another release publishes in place of the silent ones, in words."""
        silent = self._silent_names()
        bases = [self._node.resolve_topic_name(f"fmu/out/{name}") for name in silent]
        pattern = re.compile(f"({'|'.join(map(re.escape, bases))})(_v[0-9]+)?")
        ours = {self._node.resolve_topic_name(self._topic(name)) for name in silent}
        present = {name for name, _ in self._node.get_topic_names_and_types() if pattern.fullmatch(name)}
        others = sorted(name for name in present - ours if self._node.count_publishers(name))
        return f", but {', '.join(others)} exists; expected px4_msgs of PX4's release" if others else None

    def _publish_command(self, command: int, **parameters: float) -> None:
        status = self._telemetry.status
        if status is None or "vehicle_command" not in self._publishers:
            return  # the target system is not known
        message = self._class("vehicle_command")()
        for name, value in parameters.items():
            setattr(message, name, value)
        message.command = command
        message.target_system, message.target_component = status.system_id, status.component_id
        message.source_system, message.source_component = status.system_id, COMPANION
        message.from_external = True
        self._publishers["vehicle_command"].publish(message)

    def _publish(self, setpoint: Enu) -> None:
        """Publish a setpoint, then the heartbeat that makes PX4 follow it; in the stream's thread."""
        with self._lock:
            telemetry = self._telemetry
            self._streamed_vehicle_s = telemetry.vehicle_s
            if telemetry.frame is None or telemetry.position_s is None:
                return
            if time.monotonic() - telemetry.position_s > POSE_TIMEOUT_S:
                return
            ned = telemetry.frame.to_autopilot(setpoint)
        if ned != self._sent:  # a message is reused, which keeps the rate
            message, self._sent = self._class("trajectory_setpoint")(), ned
            message.position = list(ned)
            message.velocity = message.acceleration = message.jerk = NOT_CONTROLLED
            message.yaw = message.yawspeed = math.nan
            self._stream_messages["trajectory_setpoint"] = message
        for name, message in self._stream_messages.items():
            self._publishers[name].publish(message)
