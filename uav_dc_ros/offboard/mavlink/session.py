"""MAVLink with one vehicle, without a link and without a clock: bytes in, bytes out, at steady times.

It sends commands, streams setpoints, and requests what the vehicle does not send. Heartbeats and setpoints
end `STREAM_TIMEOUT_S` after the last call of `set_setpoint`; then the autopilot's own failsafes take over, as
they do when the process has died.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.ground_station import StatusText
from uav_dc_ros.offboard.mavlink.status_text import StatusTextQueue
from uav_dc_ros.offboard.mavlink.systems import AUTOPILOT, COMPONENT, SYSTEM
from uav_dc_ros.offboard.mavlink.telemetry import OPTIONAL_RATES_HZ, MavlinkTelemetry
from uav_dc_ros.offboard.setpoint_stream import (
    STREAM_S,
    STREAM_TIMEOUT_S,
    STREAM_VEHICLE_S,
    Heartbeat,
    next_due_s,
)
from uav_dc_ros.offboard.vehicle import Arm, Command, Mode, SetMode, TakeOff

ONBOARD_CONTROLLER, NO_AUTOPILOT, ACTIVE = 18, 8, 4  # MAV_TYPE, MAV_AUTOPILOT, MAV_STATE of this bridge
SET_MODE, ARM, TAKE_OFF, SET_INTERVAL, REQUEST = 176, 400, 22, 511, 512  # MAV_CMD
ACCEPTED, IN_PROGRESS = 0, 5  # MAV_RESULT
CUSTOM_MODE = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
LOCAL_NED = 1  # MAV_FRAME; accepted by ArduPilot and PX4
POSITION_ONLY = 0xDF8  # POSITION_TARGET_TYPEMASK: ignore velocity, acceleration, yaw and yaw rate
NUMBERS = 256  # of MAVLink's messages, which then wrap around

REQUEST_S = 0.5  # between checks for messages and parameters that are missing
RETRY_S, RETRY_OPTIONAL_S = 3.0, 10.0  # for a required message, for an optional one
VALUES_S = 1.0  # between the values for ground stations
ONCE = frozenset({"GPS_GLOBAL_ORIGIN"})  # PX4 sends it only when it changes, or on request

NAMES = {SET_MODE: "the change of mode", ARM: "arming", TAKE_OFF: "taking off"}  # as in "arming refused"


class Session:
    """One vehicle, on links that come and go. `write` sends bytes, and returns whether there is a peer."""

    def __init__(self, codec: Any, telemetry: MavlinkTelemetry, write: Callable[[bytes], bool]) -> None:
        self.telemetry = telemetry
        self.next_setpoint_s = -math.inf  # steady clock: when the next setpoint is due
        self._codec, self._write_bytes = codec, write
        self._mav = codec.MAVLink(None, SYSTEM, COMPONENT)
        self._mav.robust_parsing = True  # skips bytes that are no message
        self._setpoint: Enu | None = None
        self._streamed: tuple[Enu | None, float] = None, 0.0  # the last setpoint, and its vehicle time
        self._alive_s = -math.inf  # last call of `set_setpoint` or `keep_alive`
        self._commands: list[Command] = []
        self._connected_s = math.inf  # commands wait until a heartbeat was received after this
        self._request_s = -math.inf
        self._requested_s: dict[str, float] = {}
        self._heartbeat = Heartbeat()
        # Ground stations show texts and values of the vehicle's own system, as an onboard computer's.
        self._onboard = codec.MAVLink(None, 0, COMPONENT)
        self._texts = StatusTextQueue()
        self._values: Mapping[str, float] = {}
        self._values_s = -math.inf

    def on_connected(self, now_s: float) -> None:
        """Start over on a new link, where a vehicle sends nothing unrequested."""
        self._connected_s = self.next_setpoint_s = self._request_s = now_s
        self._commands.clear()  # they were for the vehicle on the previous link
        self._requested_s.clear()
        self._heartbeat.begin()
        if (fence := self.telemetry.fence) is not None and not fence.is_over:
            fence.begin()

    def set_setpoint(self, setpoint: Enu | None, now_s: float) -> bool:
        """Stream a setpoint from now on, or none; returns whether one is due at once."""
        due = setpoint != self._setpoint or now_s - self._alive_s > STREAM_TIMEOUT_S
        self._setpoint, self._alive_s = setpoint, now_s
        return due

    def keep_alive(self, now_s: float) -> None:
        """Send heartbeats before the first call of `set_setpoint`, too."""
        self._alive_s = now_s

    def queue_command(self, command: Command) -> None:
        """Send a command with the next call of `send`."""
        self._commands.append(command)

    def report_text(self, text: StatusText) -> None:
        """Send a text to ground stations, see `StatusTextQueue`."""
        self._texts.add(text)

    def report_values(self, values: Mapping[str, float]) -> None:
        """Send values to ground stations, every `VALUES_S`, unless another controller flies the vehicle."""
        self._values = values

    def receive(self, data: bytes, now_s: float) -> bool:
        """Process received bytes; returns whether a message of the vehicle was among them."""
        messages = self._mav.parse_buffer(data) if data else None
        return sum(self._on_message(message, now_s) for message in messages or ()) > 0

    def send(self, now_s: float) -> None:
        """Send what is due."""
        telemetry = self.telemetry
        vehicle_s, alive = telemetry.vehicle_s, now_s - self._alive_s <= STREAM_TIMEOUT_S
        if alive and self._heartbeat.is_due(now_s, vehicle_s):
            self._send_heartbeat(now_s, vehicle_s)
        rates_hz = telemetry.rates_hz()
        if now_s >= self._request_s or rates_hz.keys() - self._requested_s.keys():
            self._request_s = next_due_s(self._request_s, REQUEST_S, now_s)
            self._request_missing(rates_hz, now_s)
        commands, self._commands = self._commands, []
        # While the mode is uncertain it may be a pilot's; the bridge retries what was not executed.
        if not telemetry.is_mode_uncertain(now_s):
            for command in commands:
                self._send_command(command)
        streamed, streamed_vehicle_s = self._streamed
        due = now_s >= self.next_setpoint_s or self._setpoint != streamed
        if due or vehicle_s - streamed_vehicle_s >= STREAM_VEHICLE_S:
            if now_s >= self.next_setpoint_s:
                self.next_setpoint_s = next_due_s(self.next_setpoint_s, STREAM_S, now_s)
            self._streamed = self._setpoint, vehicle_s
            if alive and self._setpoint is not None:
                self._send_setpoint(self._setpoint, vehicle_s)
        if telemetry.flight_stack is not None:
            self._report(now_s)
            self._upload_fence(now_s)

    def _on_message(self, message: Any, now_s: float) -> bool:
        accepted = self.telemetry.update(message, now_s)
        name = message.get_type()
        if accepted and name == "COMMAND_ACK":
            self._on_ack(message, now_s)
        if accepted and name.startswith("MISSION_") and self.telemetry.fence is not None:
            self.telemetry.fence.on_message(message, self._codec)
        return accepted

    def _on_ack(self, message: Any, now_s: float) -> None:
        target = message.target_system or SYSTEM, message.target_component or COMPONENT
        if target != (SYSTEM, COMPONENT):
            return
        telemetry = self.telemetry
        telemetry.other_controllers.on_ack(message.command, telemetry.vehicle_s)
        name = NAMES.get(message.command)
        if name is None or message.result == IN_PROGRESS:
            return
        if message.result == ACCEPTED:
            telemetry.rejections.accept(name)
        else:
            results = self._codec.enums["MAV_RESULT"]
            result = results[message.result].name if message.result in results else str(message.result)
            result = result.removeprefix("MAV_RESULT_").lower().replace("_", " ")
            telemetry.rejections.reject(name, result, now_s)

    def _write(self, message: Any, mav: Any = None) -> bool:
        """Send a message, of this bridge or of another identity; returns whether there is a peer."""
        mav = self._mav if mav is None else mav
        if not self._write_bytes(message.pack(mav)):
            return False
        mav.seq = (mav.seq + 1) % NUMBERS
        return True

    def _report(self, now_s: float) -> None:
        """Send texts and values to ground stations."""
        telemetry, onboard = self.telemetry, self._onboard
        onboard.srcSystem = telemetry.system
        for chunk in self._texts.due(now_s):
            self._write(onboard.statustext_encode(*chunk), onboard)
        if self._values and now_s - self._values_s >= VALUES_S and not telemetry.is_flown_by_others:
            self._values_s = next_due_s(self._values_s, VALUES_S, now_s)
            boot_ms = int(telemetry.vehicle_s * 1e3) & 0xFFFFFFFF
            for name, value in self._values.items():
                self._write(onboard.named_value_float_encode(boot_ms, name.encode(), value), onboard)

    def _upload_fence(self, now_s: float) -> None:
        """Upload the fence, while the vehicle is disarmed on the ground."""
        telemetry, fence = self.telemetry, self.telemetry.fence
        if fence is None or not telemetry.is_at_rest or telemetry.datum is None:
            return
        message = fence.due(self._mav, telemetry.system or 0, telemetry.datum, now_s)
        if message is not None:
            self._write(message)

    def _send_heartbeat(self, now_s: float, vehicle_s: float) -> None:
        number = self._mav.seq
        if self._write(self._mav.heartbeat_encode(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, ACTIVE)):
            self._heartbeat.sent(now_s, vehicle_s)
            self.telemetry.other_controllers.sent_heartbeat(number)

    def _request_missing(self, rates_hz: dict[str, float], now_s: float) -> None:
        """Request messages and parameters that the vehicle has not sent."""
        for parameter in self.telemetry.parameters_to_request(now_s):
            request = self.telemetry.system, AUTOPILOT, parameter.encode(), -1  # by name
            self._write(self._mav.param_request_read_encode(*request))
        for name, rate_hz in rates_hz.items():
            retry_s = RETRY_OPTIONAL_S if name in OPTIONAL_RATES_HZ else RETRY_S
            requested_s = self._requested_s.get(name, -math.inf)
            last_s = max(self.telemetry.received_s.get(name, -math.inf), requested_s)
            if now_s - last_s >= retry_s or name not in self._requested_s:
                self._requested_s[name] = now_s
                number = getattr(self._codec, f"MAVLINK_MSG_ID_{name}")
                self._send_command_long(SET_INTERVAL, float(number), 1e6 / rate_hz)
                if name in ONCE:
                    self._send_command_long(REQUEST, float(number))

    def _send_command_long(self, command: int, *parameters: float) -> None:
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self.telemetry.other_controllers.sent_command(command, self.telemetry.vehicle_s)
        self._write(self._mav.command_long_encode(self.telemetry.system, AUTOPILOT, command, 0, *filled))

    def _send_command(self, command: Command) -> None:
        stack, position = self.telemetry.flight_stack, self.telemetry.position
        heartbeat_s = self.telemetry.received_s.get("HEARTBEAT", -math.inf)
        if stack is None or heartbeat_s < self._connected_s:
            return  # the vehicle's state on this link is unknown, and a link may deliver late
        match command:
            case SetMode(mode):
                self._send_command_long(SET_MODE, CUSTOM_MODE, *stack.mode_parameters(Mode(mode)))
            case Arm():
                self._send_command_long(ARM, 1.0)
            case TakeOff(altitude_m) if not stack.takes_off_by_setpoint and position is not None:
                climb_m = altitude_m - position.up_m  # above home, where the vehicle stands
                self._send_command_long(TAKE_OFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, climb_m)

    def _send_setpoint(self, setpoint: Enu, vehicle_s: float) -> None:
        telemetry = self.telemetry
        stack, frame = telemetry.flight_stack, telemetry.frame
        if stack is None or frame is None or not stack.accepts_setpoints(telemetry.landed_state):
            return
        ned = frame.to_autopilot(setpoint)
        telemetry.other_controllers.sent_setpoint(ned)
        boot_ms = int(vehicle_s * 1e3) & 0xFFFFFFFF
        self._write(
            self._mav.set_position_target_local_ned_encode(
                *(boot_ms, telemetry.system, AUTOPILOT, LOCAL_NED, POSITION_ONLY),
                *(*ned, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            )
        )
