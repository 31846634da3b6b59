"""What MAVROS is asked to do, by the services of mavros_msgs. Without that package it cannot be asked."""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from rclpy.node import Node

from uav_dc_ros.nodes.vehicles.mavros_messages import PACKAGE, MavrosMsgs
from uav_dc_ros.offboard.flight_stacks import FlightStack
from uav_dc_ros.offboard.mavros.telemetry import ESTIMATOR_STATUS, EXTENDED_STATE, POSE
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, TakeOff

SET_MODE, ARM, TAKE_OFF = "mavros/set_mode", "mavros/cmd/arming", "mavros/cmd/takeoff"
SET_INTERVAL = "mavros/set_message_interval"
MESSAGES = {POSE: (32, 30.0), EXTENDED_STATE: (245, 5.0), ESTIMATOR_STATUS: (230, 5.0)}  # MAVLink's, and Hz
ASK_AGAIN_S = 3.0  # for messages that do not come
WARNING = 4  # MAV_SEVERITY; what is below is worse
TEXT_S = 2.0  # a reason comes within this time before or after the refusal
SEEN = 64  # texts that are kept


class Commands:
    """Passes commands on, once each, and keeps what was refused and why. To be used in the executor's thread.

    Args:
        node: whose clients they are.
        package: mavros_msgs; None: it is not installed.
        clock: steady, seconds.
    """

    def __init__(self, node: Node, package: MavrosMsgs | None, clock: Callable[[], float]) -> None:
        self._node, self._package, self._clock = node, package, clock
        self._texts: deque[tuple[float, str]] = deque(maxlen=SEEN)
        self._refusals: dict[str, tuple[float, str]] = {}
        self._told: set[str] = set()
        self._asked_s: dict[str, float] = {}
        self._clients: dict[str, Any] = {}
        if package is not None:
            self._clients = {
                name: node.create_client(kind, name)
                for name, kind in (
                    (SET_MODE, package.set_mode),
                    (ARM, package.command_bool),
                    (TAKE_OFF, package.command_tol),
                    (SET_INTERVAL, package.message_interval),
                )
            }

    def close(self) -> None:
        """Ask for nothing any more."""
        for client in self._clients.values():
            self._node.destroy_client(client)
        self._clients = {}

    # Commands.

    def send_command(self, command: Command, dialect: FlightStack, up_m: float) -> None:
        """Pass a command on.

        Args:
            command: what is wished.
            dialect: of the autopilot.
            up_m: where the vehicle is, above the grid's ground: MAVROS is told how far to climb from there.
                (It passes the altitude on as it is; to ArduPilot it is above home, where the vehicle stands.)
        """
        package = self._package
        match command:
            case SetMode(mode):
                name = dialect.mode_names[dialect.custom_modes[Mode(mode)]]
                if package is None:
                    self._cannot(f"the change of mode to {name}", f"a pilot has to set {name}")
                    return
                request = package.set_mode.Request(custom_mode=name)
                self._call(SET_MODE, request, "the change of mode", lambda answer: answer.mode_sent)
            case Arm():
                if package is None:
                    self._cannot("arming", "a pilot has to arm")
                    return
                request = package.command_bool.Request(value=True)
                self._call(ARM, request, "arming", lambda answer: answer.success)
            case TakeOff(altitude_m) if not dialect.takes_off_by_setpoint:
                if package is None:
                    self._cannot("taking off", "a pilot has to take off, and set the mode in the air")
                    return
                request = package.command_tol.Request(altitude=altitude_m - up_m)
                self._call(TAKE_OFF, request, "taking off", lambda answer: answer.success)

    def ask_for_messages(self, lacking: Iterable[str]) -> None:
        """Ask for the messages behind topics that nothing comes on: some autopilots send none unasked."""
        if self._package is None:
            return
        now_s = self._clock()
        for topic in set(lacking) & MESSAGES.keys():
            if now_s - self._asked_s.get(topic, -ASK_AGAIN_S) >= ASK_AGAIN_S:
                self._asked_s[topic] = now_s
                number, rate_hz = MESSAGES[topic]
                request = self._package.message_interval.Request(message_id=number, message_rate=rate_hz)
                self._call(SET_INTERVAL, request, "", lambda answer: True)

    def _call(self, service: str, request: Any, what: str, granted: Callable[[Any], bool]) -> None:
        client = self._clients.get(service)
        if client is None or not client.service_is_ready():
            if what:
                self._refused(what, f"nobody offers {service}")
            return

        def answered(future: Any) -> None:
            answer = future.result()
            if what and answer is not None and granted(answer):
                self.granted(what)
            elif what:
                result = getattr(answer, "result", None)  # MAV_RESULT
                self._refused(what, "MAVROS does not know it" if result is None else f"result {result}")

        client.call_async(request).add_done_callback(answered)

    def _cannot(self, what: str, instead: str) -> None:
        why = f"{PACKAGE} is not installed: {instead}"
        self._refused(what, why)
        if what not in self._told:
            self._told.add(what)
            self._node.get_logger().warning(f"{what}: {why}")

    # What became of them.

    def on_statustext(self, text: Any) -> None:
        """A StatusText."""
        if text.severity <= WARNING:
            self._texts.append((self._clock(), text.text.strip()))

    def granted(self, what: str) -> None:
        """Forget that something was refused."""
        self._refusals.pop(what, None)

    def _refused(self, what: str, why: str) -> None:
        self._refusals[what] = self._clock(), why

    def _said(self, from_s: float, to_s: float) -> str:
        """What the autopilot warned of between two times, each of it once."""
        return "; ".join(dict.fromkeys(text for text_s, text in self._texts if from_s <= text_s <= to_s))

    @property
    def said(self) -> str:
        """What the autopilot warned of lately, in its own words; empty: nothing."""
        now_s = self._clock()
        return self._said(now_s - TEXT_S, now_s)

    @property
    def refusal(self) -> str | None:
        """What was refused last, and why."""
        if not self._refusals:
            return None
        what, (at_s, why) = max(self._refusals.items(), key=lambda refusal: refusal[1][0])
        return f"{what} refused: {self._said(at_s - TEXT_S, at_s + TEXT_S) or why}"
