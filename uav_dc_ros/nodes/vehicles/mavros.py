"""A vehicle behind MAVROS: hears what that publishes, passes commands on, streams setpoints. Decides nothing.

Standard messages are enough to fly: poses, setpoints, MAVROS's diagnostics, battery and fix. Commands need
    the
services of mavros_msgs, which is used where it is installed. Without it nobody is armed, no mode is changed,
and ArduPilot is not told to take off: a pilot does all that, lands it, too, and takes over at any time; the
bridge sees it. What it cannot ask for is in the telemetry's `refusal`, and in the node's log.

When this process is gone, MAVROS lives on, and no failsafe for a lost ground station notices. PX4 misses the
setpoints (COM_OF_LOSS_T); ArduPilot stays at the last one until this process, started again, or a pilot acts.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import (  # type: ignore[import-untyped, unused-ignore]
    BatteryState,
    NavSatFix,
    NavSatStatus,
)

from uav_dc_ros.cdr import FRAME
from uav_dc_ros.errors import MessageError
from uav_dc_ros.nodes.ros.convert import position_m, stamp_ns
from uav_dc_ros.nodes.vehicles import mavros_messages
from uav_dc_ros.nodes.vehicles.mavros_commands import Commands
from uav_dc_ros.nodes.vehicles.other_setpoints import OtherSetpointPublishers
from uav_dc_ros.offboard.frames import Enu, Geodetic, tilt_rad
from uav_dc_ros.offboard.mavros.telemetry import (
    ESTIMATOR_STATUS,
    EXTENDED_STATE,
    FIX,
    HOME,
    POSE,
    STALE_S,
    STATE,
    SYS_STATUS,
    TARGET,
    MavrosTelemetry,
)
from uav_dc_ros.offboard.setpoint_stream import SetpointStream
from uav_dc_ros.offboard.vehicle import Command, Mode, Telemetry

SETPOINT = "mavros/setpoint_position/local"
DIAGNOSTICS = "/diagnostics"  # absolute, as diagnostic_updater publishes it
LOOK_S = 1.0  # between two looks at who else is there
BATTERY, STATUSTEXT = "mavros/battery", "mavros/statustext/recv"

# Best effort hears publishers of either kind (MAVROS's sensor data are best effort), and reliable is heard by
# subscriptions of either kind. Nothing latched is asked for: an old state is no sign of life.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
SEVERAL = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
STREAMED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Target(NamedTuple):
    """A setpoint, as MAVROS takes it: local ENU metres, and yaw counter-clockwise from the east."""

    position: Enu
    yaw_rad: float


class MavrosVehicle:
    """One vehicle behind MAVROS, on the executor of a node, which also calls its methods.

    Args:
        node: whose topics these are; their names are relative, and can be remapped.
        place: where the vehicle stands when its first position comes, in the grid's ENU frame.
        grid_origin: of the same transport before it was started again.
        datum: of the grid, for where the vehicle stands across; `place` then only gives its height.
        arms: is it to be asked to arm?
        restarted: was a bridge killed before it, even one that had no grid origin yet?

    Raises:
        VehicleError: the grid origin is invalid; it is to arm, and mavros_msgs is not installed.
    """

    def __init__(
        self,
        node: Node,
        *,
        place: Enu,
        grid_origin: str = "",
        datum: Geodetic | None = None,
        arms: bool = False,
        restarted: bool = False,
    ) -> None:
        self._node = node
        self._package = mavros_messages.load(needed_for="arming" if arms else "")
        self._hearing = MavrosTelemetry(place, datum, grid_origin, full=self._package is not None)
        self._other_publishers = OtherSetpointPublishers(node, restarted=restarted or bool(grid_origin))
        self._yaw_rad: float | None = None
        self._stream: SetpointStream[Target] = SetpointStream(self._publish, "mavros")
        self._publisher: Any = None
        self._subscriptions: dict[str, Any] = {}
        self._commands: Commands | None = None
        self._closed = False
        self._looked_s = -math.inf  # when the graph was looked at last, and what is wrong with it
        self._wrong: str | None = None

    def open(self) -> None:
        """Begin to listen."""
        node, hearing = self._node, self._hearing
        self._publisher = node.create_publisher(
            PoseStamped,
            SETPOINT,
            STREAMED,
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
        )
        self._commands = Commands(node, self._package, time.monotonic)
        self._hear(PoseStamped, POSE, self._on_pose, NEWEST)
        self._hear(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, SEVERAL)
        self._hear(BatteryState, BATTERY, self._on_battery, SEVERAL)
        self._hear(NavSatFix, FIX, self._on_fix, NEWEST)
        if (package := self._package) is not None:
            self._hear(package.state, STATE, _timed(hearing.on_state), SEVERAL)
            self._hear(package.extended_state, EXTENDED_STATE, _timed(hearing.on_extended_state), SEVERAL)
            self._hear(package.sys_status, SYS_STATUS, _timed(hearing.on_sys_status), SEVERAL)
            self._hear(
                package.estimator_status, ESTIMATOR_STATUS, _timed(hearing.on_estimator_status), SEVERAL
            )
            self._hear(package.home, HOME, lambda home, _: hearing.on_home(home), SEVERAL)
            self._hear(package.target, TARGET, _timed(hearing.on_target), NEWEST)
            commands = self._commands
            self._hear(package.statustext, STATUSTEXT, lambda text, _: commands.on_statustext(text), SEVERAL)
        self._stream.start()

    def close(self) -> None:
        """End the stream, and hear nothing any more; more than once is as good as once."""
        if self._closed or self._commands is None:
            return
        self._closed = True
        self._stream.stop()
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._commands.close()
        self._node.destroy_publisher(self._publisher)

    @property
    def kind(self) -> str:
        """Name of the autopilot; empty until it is known."""
        return self._hearing.dialect.name if self._hearing.dialect else ""

    @property
    def datum(self) -> Geodetic | None:
        """Where on the Earth the grid's corner lies, of altitude 0 unless it was given; None: not known."""
        return self._hearing.corner

    @property
    def grid_origin(self) -> str:
        """Where MAVROS counts from, in the grid's frame: EAST,NORTH,UP, metres; empty until it is known."""
        origin = self._hearing.origin
        return "" if origin is None else origin.to_text()

    def telemetry(self) -> Telemetry:
        """What is known of the vehicle now, times as of `time.monotonic`."""
        assert self._commands is not None, "it was opened"
        now_s, hearing = time.monotonic(), self._hearing
        self._commands.ask_for_messages(
            name for name in hearing.wanted() if now_s - hearing.heard.get(name, -math.inf) > STALE_S
        )
        if hearing.armed:
            self._commands.granted("arming")
        known = dataclasses.replace(
            hearing.telemetry(now_s, self._commands.refusal, self._commands.said),
            other_controller=self._other_publishers.on(self._publisher.topic_name),
        )
        if known.missing is not None:
            return known
        if now_s - self._looked_s >= LOOK_S:
            self._looked_s, self._wrong = now_s, self._graph_problem()
        return dataclasses.replace(known, missing=self._wrong)

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, from now on; or none. To be called at 2 Hz or more.

        MAVROS passes a yaw on with each position: it is the one that the vehicle has as it begins to follow.
        """
        hearing = self._hearing
        if setpoint is None or not hearing.takes_setpoints:
            self._stream.set_setpoint(None)
            return
        if self._yaw_rad is None or hearing.mode is not Mode.COMMANDED:
            self._yaw_rad = hearing.yaw_rad
        self._stream.set_setpoint(Target(hearing.to_mavros(setpoint), self._yaw_rad))

    def send_command(self, command: Command) -> None:
        """Pass a command on, once; whether it was fulfilled, `telemetry` tells."""
        dialect, position = self._hearing.dialect, self._hearing.position
        if dialect is not None and self._commands is not None:
            self._commands.send_command(command, dialect, position.up_m if position is not None else 0.0)

    # Hearing.

    def _hear(self, kind: Any, topic: str, callback: Callable[[Any, Any], None], profile: QoSProfile) -> None:
        handler: Any = callback  # rclpy sees by the signature what it takes; its types do not
        self._subscriptions[topic] = self._node.create_subscription(
            kind,
            topic,
            handler,
            profile,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )

    def _on_pose(self, message: PoseStamped, info: Any) -> None:
        try:
            local = Enu(*position_m(message).tolist())
        except MessageError as error:
            self._hearing.on_bad_pose(str(error))
            return
        q = message.pose.orientation
        stamp_s, tilt = stamp_ns(message.header.stamp) * 1e-9, tilt_rad(q.w, q.x, q.y, q.z)
        self._hearing.on_pose(local, _yaw_rad(message), stamp_s, _arrived_s(info), tilt)

    def _on_diagnostics(self, message: DiagnosticArray, info: Any) -> None:
        now_s = _arrived_s(info)
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self._hearing.diagnostics.on_status(status.name, status.hardware_id, values, now_s)

    def _on_battery(self, message: BatteryState, _: Any) -> None:
        self._hearing.on_battery(message.location, message.percentage, message.voltage)

    def _on_fix(self, message: NavSatFix, info: Any) -> None:
        has_fix = message.status.status >= NavSatStatus.STATUS_FIX
        self._hearing.on_fix(has_fix, message.latitude, message.longitude, _arrived_s(info))

    def _graph_problem(self) -> str | None:
        """That nobody hears setpoints, or that there are two vehicles; None: all is well."""
        if self._publisher.get_subscription_count() == 0:
            return f"nobody hears {self._publisher.topic_name}; expected MAVROS to"
        poses = self._subscriptions[POSE].topic_name
        if (count := self._node.count_publishers(poses)) > 1:
            return f"{count} nodes publish {poses}; expected one vehicle only"
        return None

    # The stream: in a thread of its own.

    def _publish(self, target: Target) -> None:
        message = PoseStamped()
        message.header.frame_id = FRAME
        message.header.stamp = self._node.get_clock().now().to_msg()
        point, orientation = message.pose.position, message.pose.orientation
        point.x, point.y, point.z = target.position
        orientation.z, orientation.w = math.sin(target.yaw_rad / 2), math.cos(target.yaw_rad / 2)
        self._publisher.publish(message)


def _timed(take: Callable[[Any, float], None]) -> Callable[[Any, Any], None]:
    """A callback that tells when a message arrived."""

    def callback(message: Any, info: Any) -> None:
        take(message, _arrived_s(info))

    return callback


def _arrived_s(info: Any) -> float:
    """When a message arrived at this machine, steady time: it may have waited for a busy executor."""
    waited_s = (time.time_ns() - info["received_timestamp"]) * 1e-9 if info["received_timestamp"] else 0.0
    return time.monotonic() - max(0.0, waited_s)


def _yaw_rad(message: PoseStamped) -> float:
    """Yaw of a pose, counter-clockwise from the east; 0 of an orientation that is none."""
    q = message.pose.orientation
    yaw_rad = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return yaw_rad if math.isfinite(yaw_rad) else 0.0
