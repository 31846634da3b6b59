"""A vehicle behind MAVROS: receives telemetry, sends commands, streams setpoints. It decides nothing.

Standard messages are enough to fly: poses, setpoints, MAVROS's diagnostics, battery and fix. Commands need
the services of mavros_msgs, which is used where it is installed. Without it a pilot arms, sets modes, takes
off with ArduPilot, and lands. `Telemetry.refusal` and the node's log name a command that cannot be sent.

When this process dies, MAVROS lives on, and no failsafe for a lost ground station acts. PX4 detects missing
setpoints (COM_OF_LOSS_T); ArduPilot stays at the last one until this process restarts, or a pilot acts.
"""

import importlib
import math
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import BatteryState, NavSatFix, NavSatStatus  # type: ignore[import-untyped, unused-ignore]

from uav_dc_ros.cdr import FRAME
from uav_dc_ros.errors import MessageError, VehicleError
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.nodes.ros.convert import position_m, stamp_ns
from uav_dc_ros.nodes.vehicles.graph_checks import PeriodicCheck, other_publishers
from uav_dc_ros.offboard.flight_stacks import FlightStack
from uav_dc_ros.offboard.frames import Enu, Geodetic, tilt_rad
from uav_dc_ros.offboard.mavros import telemetry as topics
from uav_dc_ros.offboard.mavros.telemetry import FIX, MESSAGES, POSE, STALE_S, TARGET, MavrosTelemetry
from uav_dc_ros.offboard.rejections import Rejections
from uav_dc_ros.offboard.setpoint_stream import SetpointStream
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, TakeOff, Telemetry

SETPOINT = "mavros/setpoint_position/local"
DIAGNOSTICS = "/diagnostics"  # absolute, as diagnostic_updater publishes it
BATTERY = "mavros/battery"
PACKAGE = "mavros_msgs"
SET_MODE, ARM, TAKE_OFF = "mavros/set_mode", "mavros/cmd/arming", "mavros/cmd/takeoff"
SET_INTERVAL = "mavros/set_message_interval"
SERVICES = {SET_MODE: "SetMode", ARM: "CommandBool", TAKE_OFF: "CommandTOL", SET_INTERVAL: "MessageInterval"}
# MAVLink number, Hz.
RATES_HZ = {POSE: (32, 30.0), topics.EXTENDED_STATE: (245, 5.0), topics.ESTIMATOR_STATUS: (230, 5.0)}
RETRY_S = 3.0  # for messages that are missing

# A best-effort subscription matches both kinds of publishers (MAVROS's sensor data are best effort), and a
# reliable publisher both kinds of subscriptions. Nothing latched: an old state is no sign of life.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
SEVERAL = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
STREAMED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Target(NamedTuple):
    """A setpoint in MAVROS's frame: local ENU metres, and yaw counter-clockwise from the east."""

    position: Enu
    yaw_rad: float


class MavrosMsgs(NamedTuple):
    """The modules of mavros_msgs."""

    msg: Any
    srv: Any


def load_messages(*, needed_for: str = "") -> MavrosMsgs | None:
    """Import mavros_msgs; None if it is not installed, and `needed_for` nothing.

    Raises VehicleError if it is needed and not installed, or not that of MAVROS for ROS 2.
    """
    try:
        package = MavrosMsgs(*(importlib.import_module(f"{PACKAGE}.{kind}") for kind in ("msg", "srv")))
    except ImportError:
        if needed_for:
            raise VehicleError(
                f"{needed_for} through MAVROS needs the package {PACKAGE}; expected it installed: "
                "sudo apt install ros-jazzy-mavros-msgs"
            ) from None
        return None
    lacking = [name for name in MESSAGES.values() if not hasattr(package.msg, name)]
    lacking += [name for name in SERVICES.values() if not hasattr(package.srv, name)]
    if lacking:
        raise VehicleError(
            f"{PACKAGE} has no {', '.join(lacking)}; expected that of MAVROS of this ROS distribution"
        )
    return package


class MavrosCommands:
    """Sends each command once, and records rejections, in the executor's thread; `clock`: steady, seconds."""

    def __init__(
        self, node: Node, package: MavrosMsgs | None, rejections: Rejections, clock: Callable[[], float]
    ) -> None:
        self._node, self._package, self._rejections, self._clock = node, package, rejections, clock
        self._warned: set[str] = set()
        self._requested_s: dict[str, float] = {}
        self._clients: dict[str, Any] = {}
        if package is not None:
            for name, kind in SERVICES.items():
                self._clients[name] = node.create_client(getattr(package.srv, kind), name)

    def close(self) -> None:
        """Destroy the clients."""
        for client in self._clients.values():
            self._node.destroy_client(client)
        self._clients = {}

    def send_command(self, command: Command, stack: FlightStack, up_m: float) -> None:
        """Send a command to a vehicle at a height in the grid.

        A take-off's altitude is sent relative to it: MAVROS passes the number on, and for ArduPilot it is
        above home, where the vehicle stands.
        """
        match command:
            case SetMode(mode):
                name = stack.mode_names[stack.custom_modes[Mode(mode)]]
                pilot = f"a pilot has to set {name}"
                if self._is_installed(f"the change of mode to {name}", pilot):
                    self._call(SET_MODE, "the change of mode", custom_mode=name)
            case Arm():
                if self._is_installed("arming", "a pilot has to arm"):
                    self._call(ARM, "arming", value=True)
            case TakeOff(altitude_m) if not stack.takes_off_by_setpoint:
                pilot = "a pilot has to take off, and set the mode in the air"
                if self._is_installed("taking off", pilot):
                    self._call(TAKE_OFF, "taking off", altitude=altitude_m - up_m)

    def request_messages(self, lacking: Iterable[str]) -> None:
        """Request the messages behind silent topics: some autopilots send none unrequested."""
        if self._package is None:
            return
        now_s = self._clock()
        for topic in set(lacking) & RATES_HZ.keys():
            if now_s - self._requested_s.get(topic, -RETRY_S) >= RETRY_S:
                self._requested_s[topic] = now_s
                number, rate_hz = RATES_HZ[topic]
                self._call(SET_INTERVAL, "", message_id=number, message_rate=rate_hz)

    def _call(self, service: str, command: str, **fields: Any) -> None:
        """Call a service; the result of a command is recorded, if the command has a name."""
        client = self._clients.get(service)
        if client is None or not client.service_is_ready():
            if command:
                self._rejections.reject(command, f"no node offers {service}", self._clock())
            return

        def on_response(future: Any) -> None:
            response = future.result()
            accepted = getattr(response, "mode_sent" if service == SET_MODE else "success", False)
            if command and accepted:
                self._rejections.accept(command)
            elif command:
                result = getattr(response, "result", None)  # MAV_RESULT
                why = "MAVROS does not know it" if result is None else f"result {result}"
                self._rejections.reject(command, why, self._clock())

        request = getattr(self._package.srv, SERVICES[service]).Request(**fields)  # type: ignore[union-attr]
        client.call_async(request).add_done_callback(on_response)

    def _is_installed(self, command: str, instead: str) -> bool:
        """Whether commands can be sent; otherwise the command is rejected, and its first rejection logged."""
        if self._package is not None:
            return True
        why = f"{PACKAGE} is not installed: {instead}"
        self._rejections.reject(command, why, self._clock())
        if command not in self._warned:
            self._warned.add(command)
            self._node.get_logger().warning(f"{command}: {why}")
        return False


class MavrosVehicle:
    """One vehicle behind MAVROS, see `Vehicle`; its methods are called by the node's executor.

    Arguments: see `vehicles.make`. The names of the topics are relative, and can be remapped. Raises
    VehicleError for an invalid grid origin, or if the mission arms and mavros_msgs is not installed.
    """

    def __init__(
        self,
        node: Node,
        *,
        start: Enu,
        grid_origin: str = "",
        datum: Geodetic | None = None,
        datum_deg: tuple[float, float] | None = None,
        arms: bool = False,
        restarted: bool = False,
    ) -> None:
        self._node, self._restarted = node, restarted or bool(grid_origin)
        self._package = load_messages(needed_for="arming" if arms else "")
        self._telemetry = MavrosTelemetry(
            start, datum, grid_origin, has_msgs=self._package is not None, datum_deg=datum_deg
        )
        self._yaw_rad: float | None = None
        self._stream: SetpointStream[Target] = SetpointStream(self._publish, "mavros")
        self._publisher: Any = None
        self._subscriptions: dict[str, Any] = {}
        self._commands: MavrosCommands | None = None
        self._closed = False

    def open(self) -> None:
        """Create the publisher, clients and subscriptions, and start the stream."""
        node, telemetry = self._node, self._telemetry
        self._publisher = qos.create_publisher(node, PoseStamped, SETPOINT, STREAMED)
        topic = self._publisher.topic_name
        self._other_publishers = other_publishers(node, topic, restarted=self._restarted)
        self._graph_problem = PeriodicCheck(self._check_graph)
        self._commands = MavrosCommands(node, self._package, telemetry.rejections, time.monotonic)
        self._subscribe(PoseStamped, POSE, self._on_pose, NEWEST)
        self._subscribe(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics)
        self._subscribe(BatteryState, BATTERY, self._on_battery)
        self._subscribe(NavSatFix, FIX, self._on_fix, NEWEST)
        if self._package is not None:
            for topic, name in MESSAGES.items():
                kind, handler = getattr(self._package.msg, name), partial(telemetry.update, topic)
                self._subscribe(kind, topic, handler, NEWEST if topic == TARGET else SEVERAL)
        self._stream.start()

    def close(self) -> None:
        """End the stream, and destroy what `open` created; idempotent."""
        if self._closed or self._commands is None:
            return
        self._closed = True
        self._stream.stop()
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._commands.close()
        self._node.destroy_publisher(self._publisher)

    def telemetry(self) -> Telemetry:
        """The vehicle's state now, times as of `time.monotonic`."""
        assert self._commands is not None
        now_s, received_s = time.monotonic(), self._telemetry.received_s
        required = self._telemetry.required_topics()
        silent = [topic for topic in required if now_s - received_s.get(topic, -math.inf) > STALE_S]
        self._commands.request_messages(silent)
        telemetry = self._telemetry.snapshot(now_s, self._other_publishers())
        if telemetry.missing is None and (problem := self._graph_problem()) is not None:
            return telemetry.replace(missing=problem)
        return telemetry

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, from now on; or none. To be called at 2 Hz or more.

        MAVROS sends a yaw with each position: the vehicle's own, when it begins to follow.
        """
        telemetry = self._telemetry
        if setpoint is None or not telemetry.accepts_setpoints:
            self._stream.set_setpoint(None)
            return
        if self._yaw_rad is None or telemetry.mode is not Mode.COMMANDED:
            self._yaw_rad = telemetry.yaw_rad
        self._stream.set_setpoint(Target(telemetry.to_mavros(setpoint), self._yaw_rad))

    def send_command(self, command: Command) -> None:
        """Send a command once; `telemetry` reports its effect."""
        stack, position = self._telemetry.flight_stack, self._telemetry.position
        if stack is not None and self._commands is not None:
            self._commands.send_command(command, stack, position.up_m if position is not None else 0.0)

    def _subscribe(
        self, kind: Any, topic: str, handler: Callable[[Any, float], None], profile: QoSProfile = SEVERAL
    ) -> None:
        """Subscribe; the handler takes a message, and the steady time at which it arrived."""

        def callback(message: Any, info: Any) -> None:
            received_ns = info["received_timestamp"]  # it may have waited for a busy executor since
            waited_s = (time.time_ns() - received_ns) * 1e-9 if received_ns else 0.0
            handler(message, time.monotonic() - max(0.0, waited_s))

        self._subscriptions[topic] = qos.create_subscription(
            self._node, kind, topic, callback, profile, raw=False
        )

    def _on_pose(self, message: PoseStamped, now_s: float) -> None:
        try:
            local = Enu(*position_m(message).tolist())
        except MessageError as error:
            self._telemetry.pose_error = str(error)
            return
        q = message.pose.orientation
        yaw_rad = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))  # from the east
        yaw_rad = yaw_rad if math.isfinite(yaw_rad) else 0.0  # of an invalid orientation
        stamp_s, tilt = stamp_ns(message.header.stamp) * 1e-9, tilt_rad(q.w, q.x, q.y, q.z)
        self._telemetry.on_pose(local, yaw_rad, stamp_s, now_s, tilt)

    def _on_diagnostics(self, message: DiagnosticArray, now_s: float) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self._telemetry.diagnostics.on_status(status.name, status.hardware_id, values, now_s)

    def _on_battery(self, message: BatteryState, now_s: float) -> None:
        self._telemetry.on_battery(message.location, message.percentage, message.voltage)

    def _on_fix(self, message: NavSatFix, now_s: float) -> None:
        has_fix = message.status.status >= NavSatStatus.STATUS_FIX
        self._telemetry.on_fix(has_fix, message.latitude, message.longitude, now_s)

    def _check_graph(self) -> str | None:
        if self._publisher.get_subscription_count() == 0:
            return f"no node subscribes to {self._publisher.topic_name}; expected MAVROS to"
        poses = self._subscriptions[POSE].topic_name
        if (count := self._node.count_publishers(poses)) > 1:
            return f"{count} nodes publish {poses}; expected one vehicle only"
        return None

    def _publish(self, target: Target) -> None:
        """Publish a setpoint; in the stream's thread."""
        message = PoseStamped()
        message.header.frame_id = FRAME
        message.header.stamp = self._node.get_clock().now().to_msg()
        point, orientation = message.pose.position, message.pose.orientation
        point.x, point.y, point.z = target.position
        orientation.z, orientation.w = math.sin(target.yaw_rad / 2), math.cos(target.yaw_rad / 2)
        self._publisher.publish(message)
