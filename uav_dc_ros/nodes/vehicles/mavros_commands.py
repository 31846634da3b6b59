"""Commands to MAVROS, by the services of mavros_msgs. Without that package no command can be sent."""

import importlib
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from rclpy.node import Node

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.offboard.flight_stacks import FlightStack
from uav_dc_ros.offboard.mavros.telemetry import ESTIMATOR_STATUS, EXTENDED_STATE, MESSAGES, POSE
from uav_dc_ros.offboard.rejections import Rejections
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, TakeOff

PACKAGE = "mavros_msgs"
SET_MODE, ARM, TAKE_OFF = "mavros/set_mode", "mavros/cmd/arming", "mavros/cmd/takeoff"
SET_INTERVAL = "mavros/set_message_interval"
SERVICES = {SET_MODE: "SetMode", ARM: "CommandBool", TAKE_OFF: "CommandTOL", SET_INTERVAL: "MessageInterval"}
RATES_HZ = {POSE: (32, 30.0), EXTENDED_STATE: (245, 5.0), ESTIMATOR_STATUS: (230, 5.0)}  # MAVLink number, Hz
RETRY_S = 3.0  # for messages that are missing


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
