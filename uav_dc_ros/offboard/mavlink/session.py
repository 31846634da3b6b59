"""MAVLink with one vehicle, without a link and without a clock: bytes in, bytes out, at steady times.

It decides nothing: it passes commands on, streams setpoints, and asks for what the vehicle does not send. It
    is
a sign of life of those who decide: heartbeats and setpoints end `STREAM_TIMEOUT_S` after the last call of
    `set_setpoint`, and
then the autopilot's own failsafes take over, as they do when the process is gone.
"""

import math
from collections.abc import Callable
from typing import Any

from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mavlink.systems import AUTOPILOT, COMPONENT, SYSTEM
from uav_dc_ros.offboard.mavlink.telemetry import ACCEPTED, HELPFUL_HZ, IN_PROGRESS, ONCE, MavlinkTelemetry
from uav_dc_ros.offboard.setpoint_stream import (
    STREAM_S,
    STREAM_TIMEOUT_S,
    STREAM_VEHICLE_S,
    Heartbeat,
    next_due_s,
)
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, TakeOff

ONBOARD_CONTROLLER, NO_AUTOPILOT, ACTIVE = 18, 8, 4  # MAV_TYPE, MAV_AUTOPILOT, MAV_STATE of this end
SET_MODE, ARM, TAKE_OFF, SET_INTERVAL, REQUEST = 176, 400, 22, 511, 512  # MAV_CMD
CUSTOM_MODE = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
LOCAL_NED = 1  # MAV_FRAME; the one that ArduPilot and PX4 both take
POSITION_ONLY = 0xDF8  # POSITION_TARGET_TYPEMASK: ignore velocity, acceleration, yaw and its rate
NUMBERS = 256  # of MAVLink's messages, which then begin anew

ASK_S = 0.5  # between looks for messages and parameters that do not come
ASK_AGAIN_S, ASK_AGAIN_HELPFUL_S = 3.0, 10.0  # for a message that does not come; for one that nobody needs

NAMES = {SET_MODE: "the change of mode", ARM: "arming", TAKE_OFF: "taking off"}  # as in "arming refused"


class Session:
    """One vehicle, on links that come and go.

    Args:
        codec: pymavlink's messages.
        hearing: takes in what the vehicle tells.
        write: sends bytes; was there anybody to send them to?

    Attributes:
        stream_s: when the next setpoint is due, steady clock.
    """

    def __init__(self, codec: Any, hearing: MavlinkTelemetry, write: Callable[[bytes], bool]) -> None:
        self.hearing, self.stream_s = hearing, -math.inf
        self._codec, self._write_bytes = codec, write
        self._mav = codec.MAVLink(None, SYSTEM, COMPONENT)
        self._mav.robust_parsing = True  # skips bytes that are no message
        self._setpoint: Enu | None = None
        self._streamed: tuple[Enu | None, float] = None, 0.0  # the last one, and when, vehicle time
        self._alive_s = -math.inf  # last sign of life of those who decide
        self._commands: list[Command] = []
        self._met_s = math.inf  # when the link was opened; commands wait until the vehicle was heard on it
        self._ask_s = -math.inf
        self._asked_s: dict[str, float] = {}
        self._heartbeat = Heartbeat()

    def begin(self, now_s: float) -> None:
        """Another link was opened: whoever is on it sends nothing unasked."""
        self._met_s = self.stream_s = self._ask_s = now_s
        self._commands.clear()  # sent to a vehicle that may be another's by now
        self._asked_s.clear()
        self._heartbeat.begin()

    def set_setpoint(self, setpoint: Enu | None, now_s: float) -> bool:
        """Stream a setpoint from now on, or none, and be alive; is there something to send at once."""
        news = setpoint != self._setpoint or now_s - self._alive_s > STREAM_TIMEOUT_S
        self._setpoint, self._alive_s = setpoint, now_s
        return news

    def live(self, now_s: float) -> None:
        """Somebody is there who will decide."""
        self._alive_s = now_s

    def queue_command(self, command: Command) -> None:
        """Pass a command on with what is sent next."""
        self._commands.append(command)

    def receive(self, data: bytes, now_s: float) -> bool:
        """Take in what came; was something of the vehicle's among it."""
        messages = self._mav.parse_buffer(data) if data else None
        return sum(self._take(message, now_s) for message in messages or ()) > 0

    def send(self, now_s: float) -> None:
        """Send what is due."""
        hearing = self.hearing
        vehicle_s, alive = hearing.vehicle_s, now_s - self._alive_s <= STREAM_TIMEOUT_S
        if alive and self._heartbeat.is_due(now_s, vehicle_s):
            self._send_heartbeat(now_s, vehicle_s)
        if now_s >= self._ask_s or hearing.wanted().keys() - self._asked_s.keys():
            self._ask_s = next_due_s(self._ask_s, ASK_S, now_s)
            self._ask_for_messages(now_s)
        commands, self._commands = self._commands, []
        if not hearing.doubts_mode(now_s):  # it may be a pilot; the bridge sends again what was not executed
            for command in commands:
                self._send_command(command, now_s)
        streamed, streamed_vehicle_s = self._streamed
        due = now_s >= self.stream_s or self._setpoint != streamed
        if due or vehicle_s - streamed_vehicle_s >= STREAM_VEHICLE_S:
            if now_s >= self.stream_s:
                self.stream_s = next_due_s(self.stream_s, STREAM_S, now_s)
            self._streamed = self._setpoint, vehicle_s
            if alive and self._setpoint is not None:
                self._send_setpoint(self._setpoint, vehicle_s)

    # What came.

    def _take(self, message: Any, now_s: float) -> bool:
        taken = self.hearing.hear(message, now_s)
        if taken and message.get_type() == "COMMAND_ACK":
            self._take_answer(message, now_s)
        return taken

    def _take_answer(self, message: Any, now_s: float) -> None:
        if (message.target_system or SYSTEM) != SYSTEM or (
            message.target_component or COMPONENT
        ) != COMPONENT:
            return  # the answer to somebody else
        self.hearing.rivals.answer(message.command, self.hearing.vehicle_s)
        name = NAMES.get(message.command)
        if name is None or message.result == IN_PROGRESS:
            return
        if message.result == ACCEPTED:
            self.hearing.granted(name)
        else:
            results = self._codec.enums["MAV_RESULT"]
            result = results[message.result].name if message.result in results else str(message.result)
            self.hearing.refused(name, result.removeprefix("MAV_RESULT_").lower().replace("_", " "), now_s)

    # What is sent.

    def _write(self, message: Any) -> bool:
        """Send a message; was there anybody to send it to."""
        if not self._write_bytes(message.pack(self._mav)):
            return False
        self._mav.seq = (self._mav.seq + 1) % NUMBERS
        return True

    def _send_heartbeat(self, now_s: float, vehicle_s: float) -> None:
        number = self._mav.seq
        if self._write(self._mav.heartbeat_encode(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, ACTIVE)):
            self._heartbeat.sent(now_s, vehicle_s)
            self.hearing.rivals.sent_heartbeat(number)

    def _ask_for_messages(self, now_s: float) -> None:
        """Ask for messages that do not come: on a new link, or started anew, a vehicle sends none unasked."""
        heard, wanted = self.hearing.heard, self.hearing.wanted()
        for parameter in self.hearing.unanswered(now_s):
            what = parameter.encode(), -1  # by name
            self._write(self._mav.param_request_read_encode(self.hearing.system, AUTOPILOT, *what))
        for name, rate_hz in wanted.items():
            again_s = ASK_AGAIN_HELPFUL_S if name in HELPFUL_HZ else ASK_AGAIN_S
            last_s = max(heard.get(name, -math.inf), self._asked_s.get(name, -math.inf))
            if now_s - last_s >= again_s or name not in self._asked_s:
                self._asked_s[name] = now_s
                number = getattr(self._codec, f"MAVLINK_MSG_ID_{name}")
                self._send_command_long(SET_INTERVAL, float(number), 1e6 / rate_hz)
                if name in ONCE:
                    self._send_command_long(REQUEST, float(number))

    def _send_command_long(self, command: int, *parameters: float) -> None:
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self.hearing.rivals.sent_command(command, self.hearing.vehicle_s)
        self._write(self._mav.command_long_encode(self.hearing.system, AUTOPILOT, command, 0, *filled))

    def _send_command(self, command: Command, now_s: float) -> None:
        dialect, known = self.hearing.dialect, self.hearing.telemetry(now_s)
        if dialect is None or (known.heartbeat_s or -math.inf) < self._met_s:
            return  # who knows what it does by now; a link may also keep things to deliver them late
        match command:
            case SetMode(mode):
                self._send_command_long(SET_MODE, CUSTOM_MODE, *dialect.mode_parameters(Mode(mode)))
            case Arm():
                self._send_command_long(ARM, 1.0)
            case TakeOff(altitude_m) if not dialect.takes_off_by_setpoint and known.position is not None:
                climb_m = altitude_m - known.position.up_m  # above home, which is where it stands
                self._send_command_long(TAKE_OFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, climb_m)

    def _send_setpoint(self, setpoint: Enu, vehicle_s: float) -> None:
        hearing = self.hearing
        if (
            hearing.dialect is None
            or hearing.frame is None
            or not hearing.dialect.accepts_setpoints(hearing.landed_state)
        ):
            return
        ned = hearing.frame.to_autopilot(setpoint)
        hearing.rivals.sent_setpoint(ned)
        self._write(
            self._mav.set_position_target_local_ned_encode(
                *(int(vehicle_s * 1e3) & 0xFFFFFFFF, hearing.system, AUTOPILOT, LOCAL_NED, POSITION_ONLY),
                *(*ned, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            )
        )
