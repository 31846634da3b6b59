"""A fake autopilot: a process that sends and receives MAVLink 2 over TCP or UDP, like ArduCopter or like PX4.

    python -m tests.support.fake_autopilot.autopilot --kind ardupilot --tcp 0 --speed 20

The vehicle itself is in `copter`. The process prints events as lines of JSON, first its port, and reads
commands from standard input: `Control` lists all of them. Simulated time runs `--speed` times faster than
the clock.

Imitated, from a real ArduCopter (4.6) in simulation, or from PX4's documentation: a TCP server starts with
its first client; messages at the requested rates; an estimate that is ready after a while, and arming that
is rejected before, with a text; GUIDED without an estimate; one position setpoint that is followed without
end, a velocity setpoint for 3 s; a take-off by command, which a setpoint interrupts; OFFBOARD only after a
second of setpoints at more than 2 Hz, and a failsafe (return) when they end; the frames each of them
accepts; speeds; disarming on the ground; MAVLink 1 until MAVLink 2 is received; motors that need two seconds
to lift it; the last ten metres down at half a metre per second; the charge that ArduCopter's simulator counts
to nothing within seven minutes while the voltage stays; PX4's origin, sent when it changes or on request,
and its readiness, reported for its current mode; parameters, by name; ArduCopter's position target, reported
in GUIDED only, and silently ignored outside its fence; failsafes for its fence, a silent ground station (in
its own time), and low voltage (a text and the battery's health; neither acts on it). Its metres are those of
a sphere; all events have true ones. A foreign gimbal sends, too.

What a client sends to no system in particular, and all that the autopilot sends, also goes to a ground
station on UDP (`--station PORT`), whose messages it receives. Fence points are stored, and enforce nothing.

Not imitated: noise, GPS, missions, other failsafes, links that lose single messages, yaw. Unlike a real
autopilot's, its time waits (a quarter of a second at most) for a client that is late: the machine that tests
run on is busy.
"""

import argparse
import contextlib
import math
import os
import select
import socket
import struct
import sys
import time
from typing import Any

import pymap3d
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.support.fake_autopilot.copter import FOLLOWS, RETURNS, TICK_S, Copter, emit
from tests.support.fake_autopilot.fences import FenceStore

ADVICE_S = 30.0
OFFBOARD_GAP_S, OFFBOARD_PROOF_S = 0.5, 1.0
SO_TIMESTAMPNS = 35  # of Linux: when a datagram came, however late this process reads it
# Wall: for a client that streams setpoints, for another one; simulated.
PATIENCE_S, PATIENCE_BEFORE_S, LEAP_S = 1.0, 0.25, 0.4
AHEAD_S, AHEAD_OF_HEARTBEATS_S = 0.4, 1.2  # simulated: of a client that streams; of one that does not
FLAGS, MADE_UP = 0x33F, 0x80
HOME = (47.397742, 8.545594, 488.0)
EARTH_M = {"ardupilot": 111318.84502145034 * 180 / math.pi, "px4": 6371000.0}  # LATLON_TO_M; of a sphere
BRIDGE = (255, 191)  # system and component of a bridge
POSITION, VELOCITY = 0xDF8, 0xDC7  # POSITION_TARGET_TYPEMASK
RIVAL_S, RIVAL_ACK_S, RIVAL_HEARTBEAT_S = 0.1, 2.0, 1.0


def scale_of(kind: str) -> list[float]:
    """An autopilot's metres in a true one, north, east, down: it takes the Earth for a sphere.

    ArduPilot's `Location::get_distance_NE`, and PX4's projection near its centre.
    """
    north_deg = pymap3d.enu2geodetic(0.0, 1000.0, 0.0, *HOME)[0] - HOME[0]
    east_deg = pymap3d.enu2geodetic(1000.0, 0.0, 0.0, *HOME)[1] - HOME[1]
    along_m = math.radians(north_deg) * EARTH_M[kind]
    across_m = math.radians(east_deg) * EARTH_M[kind] * math.cos(math.radians(HOME[0]))
    return [along_m / 1000.0, across_m / 1000.0, 1.0]


class Codec(mav.MAVLink):
    """Sends MAVLink 1 until it has received MAVLink 2."""

    old = True

    def send(self, message: Any, force_mavlink1: bool = False) -> None:
        super().send(message, force_mavlink1=self.old)


class Autopilot:
    """The copter's radio: messages in and out, and the faults."""

    def __init__(self, copter: Copter, system: int) -> None:
        self.copter = copter
        self.scale = scale_of("px4" if copter.px4 else "ardupilot")
        self.mav = Codec(self, system, 1)
        self.gimbal = Codec(self, system, 154)
        self.rival = Codec(self, *BRIDGE)  # a second bridge, whose messages come by way of this autopilot
        self.rival_heartbeats, self.rival_acks = False, False
        self.rival_target: list[float] | None = None
        self.rival_due = {"heartbeat": 0.0, "ack": 0.0, "target": 0.0}
        self.other: Autopilot | None = None  # a second vehicle on the same link
        self.origin_sent, self.advised_s = False, -math.inf
        self.parser = mav.MAVLink(None)
        self.parser.robust_parsing = True
        self.out = bytearray()
        self.fence_s = 0.0  # when fence items were last requested
        self.forwarded = bytearray()  # of clients, to other links
        self.fence = FenceStore(lambda event, **more: copter.emit(event, **more))
        self.due = {mav.MAVLINK_MSG_ID_HEARTBEAT: (1.0, 0.0)}  # period, next
        self.frozen, self.offset, self.late_s = False, [0.0, 0.0, 0.0], 0.0
        self.later: list[tuple[float, Any]] = []
        self.setpoints, self.last_setpoint, self.interrupted = 0, None, 0
        self.heartbeats = 0
        self.came_s = 0.0
        self.times: list[float] | None = None  # when setpoints came, as the system stamped them; UDP only
        self.ignores: dict[int, int] = {}  # how many more commands of a number are lost on their way
        self.echoes, self.twice = False, False
        self.next_late_s = 0.0  # of the next position
        self.next_is_zeroed, self.next_is_nonsense = False, False
        self.held_back: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:  # pymavlink calls it
        self.out += data

    def forget_rates(self) -> None:
        self.due = {mav.MAVLINK_MSG_ID_HEARTBEAT: (1.0, self.copter.t_s)}
        self.origin_sent = False

    # Out.

    def send_text(self, text: str, severity: int = mav.MAV_SEVERITY_CRITICAL) -> None:
        self.mav.statustext_send(severity, text.encode())

    def send_due(self) -> None:
        if self.other is not None:
            self.other.copter.tick()
            self.other.answer()
            self.other.send_due()
            self.out += self.other.out
            self.other.out.clear()
        self._send_as_second_bridge()
        t_s = self.copter.t_s
        while self.copter.texts:
            self.send_text(self.copter.texts.pop(0))
        if t_s - self.fence_s >= 1.0:
            self.fence_s = t_s
            self.fence.repeat(self.mav)
        while self.held_back and self.held_back[0][0] <= t_s:
            self.out += self.held_back.pop(0)[1]
        if not self.copter.ready and not self.copter.px4 and t_s - self.advised_s >= ADVICE_S:
            self.advised_s = t_s
            self.send_text("PreArm: AHRS: waiting for home")
        for number, (period_s, next_s) in list(self.due.items()):
            if t_s + 1e-9 >= next_s:
                self.due[number] = (period_s, max(next_s + period_s, t_s - period_s))
                begin = len(self.out)
                self._send(number)
                if number == mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED and self.next_late_s > 0.0:
                    self.held_back.append((t_s + self.next_late_s, bytes(self.out[begin:])))
                    self.next_late_s = 0.0
                    del self.out[begin:]
                elif self.twice:
                    self.out += self.out[begin:]

    def _send_as_second_bridge(self) -> None:
        """Messages of a second bridge, and the answers to it."""
        c = self.copter

        def due(what: str, wanted: bool, period_s: float) -> bool:
            if not wanted or c.t_s < self.rival_due[what]:
                return False
            self.rival_due[what] = c.t_s + period_s
            return True

        if due("heartbeat", self.rival_heartbeats, RIVAL_HEARTBEAT_S):
            self.rival.heartbeat_send(mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, 4)
            c.gcs_s = c.t_s
        if due("ack", self.rival_acks, RIVAL_ACK_S):
            self.mav.command_ack_send(mav.MAV_CMD_DO_SET_MODE, 0, 0, 0, *BRIDGE)
        if due("target", self.rival_target is not None, RIVAL_S) and self.rival_target is not None:
            self._note_stream()
            if c.mode in FOLLOWS and not c.landed:
                c.aim(list(self.rival_target))

    def _send(self, number: int) -> None:
        c = self.copter
        boot_ms = round(c.t_s * 1e3)
        if number == mav.MAVLINK_MSG_ID_HEARTBEAT:
            base = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mav.MAV_MODE_FLAG_SAFETY_ARMED if c.armed else 0)
            kind = mav.MAV_AUTOPILOT_PX4 if c.px4 else mav.MAV_AUTOPILOT_ARDUPILOTMEGA
            self.mav.heartbeat_send(mav.MAV_TYPE_QUADROTOR, kind, base, c.modes[c.mode], 4 if c.armed else 3)
            self.gimbal.heartbeat_send(mav.MAV_TYPE_GIMBAL, mav.MAV_AUTOPILOT_INVALID, 128, 99, 4)
        elif number == mav.MAVLINK_MSG_ID_SYSTEM_TIME:
            self.mav.system_time_send(0, boot_ms)
        elif number == mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            if c.t_s >= c.ready_s and not self.frozen:
                ned = self._own([p + o for p, o in zip(c.ned, self.offset, strict=True)])
                if self.next_is_nonsense:
                    ned = [math.nan, 1e9, math.inf]
                sent_ms = 0 if self.next_is_zeroed else boot_ms
                self.next_is_nonsense = self.next_is_zeroed = False
                self.mav.local_position_ned_send(sent_ms, *ned, *c.velocity)
        elif number == mav.MAVLINK_MSG_ID_ATTITUDE:
            self.mav.attitude_send(boot_ms, c.tilt_rad, 0.0, 0.0, 0.0, 0.0, 0.0)
        elif number == mav.MAVLINK_MSG_ID_HOME_POSITION:
            if c.t_s >= c.ready_s:
                here = [round(v * s) for v, s in zip(HOME, (1e7, 1e7, 1e3), strict=True)]
                self.mav.home_position_send(*here, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
        elif number == mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED:
            self._report_target(boot_ms)
        elif number == mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
            if c.t_s >= c.ready_s and not (c.px4 and self.origin_sent):
                self.origin_sent = True
                self.mav.gps_global_origin_send(
                    *(round(v * s) for v, s in zip(HOME, (1e7, 1e7, 1e3), strict=True))
                )
        elif number == mav.MAVLINK_MSG_ID_SYS_STATUS:
            ready = c.ready and not c.refuses and (not c.px4 or c.mode == "OFFBOARD")
            battery = mav.MAV_SYS_STATUS_SENSOR_BATTERY
            health = (0 if c.battery_failed else battery) | (mav.MAV_SYS_STATUS_PREARM_CHECK if ready else 0)
            volts, charge = round(c.volts * 1e3), round(c.charge * 100)
            self.mav.sys_status_send(battery, battery, health, 0, volts, 0, charge, 0, 0, 0, 0, 0, 0)
        elif number == mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            self.mav.extended_sys_state_send(0, c.landed_state)
        elif number == mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT:
            self.mav.ekf_status_report_send(FLAGS if c.ready else MADE_UP | 1, 0, 0, 0, 0, 0)
        elif number == mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS:
            self.mav.estimator_status_send(0, FLAGS if c.ready else MADE_UP | 1, 0, 0, 0, 0, 0, 0, 0, 0)

    def _own(self, ned: list[float]) -> list[float]:
        """True metres, in the autopilot's own."""
        return [n * s for n, s in zip(ned, self.scale, strict=True)]

    def _report_target(self, boot_ms: int) -> None:
        c = self.copter
        if c.landed or not (c.px4 or c.mode in FOLLOWS):
            return
        if c.mode not in FOLLOWS:  # PX4: the controllers' own
            ned, mask = [math.nan] * 3, 0
        elif c.taking_off_to_m is not None:
            ned, mask = [*c.ned[:2], -c.taking_off_to_m], POSITION
        elif c.target is not None:
            ned, mask = c.target, 0 if c.px4 else POSITION
        else:
            ned, mask = [0.0] * 3, VELOCITY
        self.mav.position_target_local_ned_send(boot_ms, 1, mask, *self._own(ned), 0, 0, 0, 0, 0, 0, 0, 0)

    def _send_parameter(self, name: str) -> None:
        """Send a parameter; there is no answer for an unknown one."""
        value = self.copter.parameters.get(name)
        if value is None:
            return
        kind = mav.MAV_PARAM_TYPE_REAL32
        if self.copter.px4 and isinstance(value, int):  # byte by byte, whatever number that makes
            kind, value = mav.MAV_PARAM_TYPE_INT32, struct.unpack("<f", struct.pack("<i", value))[0]
        self.mav.param_value_send(name.encode(), value, kind, len(self.copter.parameters), 0)

    # In.

    def receive(self, data: bytes, station: mav.MAVLink | None = None) -> bool:
        """Process bytes, of a client or of a `station`; returns whether a message was among them."""
        if self.other is not None:
            self.other.receive(data)
        if self.echoes:
            self.out += data
        messages = (station or self.parser).parse_buffer(data) or []
        for message in messages:
            if message.get_msgbuf()[0] == mav.PROTOCOL_MARKER_V2:
                self.mav.old = self.gimbal.old = False
            name = message.get_type()
            if station is None and getattr(message, "target_system", 0) == 0:
                self.forwarded += message.get_msgbuf()
            if getattr(message, "target_system", self.mav.srcSystem) != self.mav.srcSystem:
                continue
            if name == "COMMAND_LONG" and self.ignores.get(message.command, 0) > 0:
                self.ignores[message.command] -= 1
                self.copter.emit("lost", command=message.command)
            elif name == "COMMAND_LONG":
                self.later.append((self.copter.t_s + self.late_s, message))
            elif name == "SET_POSITION_TARGET_LOCAL_NED":
                message.x, message.y = message.x / self.scale[0], message.y / self.scale[1]
                self._setpoint(message)
            elif name.startswith("MISSION_"):
                self.fence.receive(message, self.mav)
            elif name == "PARAM_REQUEST_READ":
                self._send_parameter(message.param_id)
            elif name == "HEARTBEAT":
                self.heartbeats += 1
                if message.get_srcSystem() == BRIDGE[0]:
                    self.copter.gcs_s = self.copter.t_s
        return bool(messages)

    def answer(self) -> None:
        """Execute the commands that are due."""
        while self.later and self.later[0][0] <= self.copter.t_s:
            message = self.later.pop(0)[1]
            result, why = self._command(message)
            self.mav.command_ack_send(
                message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
            if why:
                self.send_text(why)
            if message.command not in (mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAV_CMD_REQUEST_MESSAGE):
                self.copter.emit("command", command=message.command, result=result, why=why)

    def _command(self, m: Any) -> tuple[int, str]:
        c = self.copter
        failed = mav.MAV_RESULT_TEMPORARILY_REJECTED if c.px4 else mav.MAV_RESULT_FAILED
        if m.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL:
            mine, other = mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT, mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS
            if int(m.param1) == (mine if c.px4 else other):
                return mav.MAV_RESULT_FAILED, ""
            if m.param2 > 0:
                self.due[int(m.param1)] = (m.param2 / 1e6, c.t_s)
            else:
                self.due.pop(int(m.param1), None)
            return 0, ""
        if m.command == mav.MAV_CMD_REQUEST_MESSAGE:
            self.origin_sent = False
            self._send(int(m.param1))
            return 0, ""
        if m.command == mav.MAV_CMD_DO_SET_MODE:
            number = int(m.param2) << 16 | int(m.param3) << 24 if c.px4 else int(m.param2)
            name = next((name for name, mode in c.modes.items() if mode == number), None)
            if name is None or not int(m.param1) & 1:
                return mav.MAV_RESULT_DENIED, "unknown mode"
            if name in RETURNS and not c.ready:
                return failed, f"Mode change to {name} failed: requires position"
            if name == "OFFBOARD" and not self._stream_proven():
                return failed, "Offboard control signal lost: no setpoints"
            c.set_mode(name, "commanded")
            return 0, ""
        if m.command == mav.MAV_CMD_COMPONENT_ARM_DISARM:
            if m.param1 < 0.5:
                c.arm(False, "commanded")
                return 0, ""
            if c.refuses or c.balks:
                return failed, "Arm: Motors: check frame class"
            if not c.ready:
                return failed, "Preflight Fail: no local position" if c.px4 else "Arm: waiting for home"
            c.arm(True, "commanded")
            return 0, ""
        if m.command == mav.MAV_CMD_NAV_TAKEOFF and not c.px4:
            if not (c.armed and c.landed and c.mode == "GUIDED"):
                return failed, ""
            c.taking_off_to_m, c.take_off_s = m.param7, c.t_s
            return 0, ""
        return mav.MAV_RESULT_UNSUPPORTED, ""

    def _stream_proven(self) -> bool:
        c = self.copter
        fresh = c.t_s - c.streamed_s <= OFFBOARD_GAP_S
        return fresh and c.streamed_s - c.streamed_since_s >= OFFBOARD_PROOF_S

    def _note_stream(self) -> None:
        """A setpoint came, of anybody's."""
        c = self.copter
        if c.t_s - c.streamed_s > OFFBOARD_GAP_S:
            c.streamed_since_s = c.t_s
        c.streamed_s = c.t_s

    def _setpoint(self, m: Any) -> None:
        c = self.copter
        self.setpoints += 1
        if self.times is not None:
            self.times.append(self.came_s)
        ned, key = [m.x, m.y, m.z], (m.coordinate_frame, m.type_mask, m.x, m.y, m.z, m.vx, m.vy, m.vz)
        if key != self.last_setpoint:
            self.last_setpoint = key
            c.emit("setpoint", frame=m.coordinate_frame, mask=m.type_mask, ned=ned, mode=c.mode)
        frames = (1, 8) if c.px4 else (1, 7, 8, 9)
        if m.coordinate_frame not in frames:
            return
        self._note_stream()
        if c.mode not in FOLLOWS or (c.landed and not c.px4):
            return
        if c.taking_off_to_m is not None:
            self.interrupted += 1
            c.emit("take-off interrupted", ned=c.ned)
            c.taking_off_to_m = None
        if not m.type_mask & 0x7:  # position
            here = c.ned if m.coordinate_frame in (7, 9) else [0.0, 0.0, 0.0]
            c.aim([h + n for h, n in zip(here, ned, strict=True)])
        elif not m.type_mask & 0x38:
            c.target_velocity, c.target_s = [m.vx, m.vy, m.vz], c.t_s


class Control:
    """Commands on standard input, a line each; 0|1 ends or begins something, times are the vehicle's.

    Of the vehicle:
        mode NAME, arm, disarm           a pilot does
        fly NORTH EAST UP                it is in the air there, in the commanded mode, as a mission left it
        param NAME VALUE|none            sets a parameter (whole numbers are PX4's integers); none: unknown
        wind NORTH EAST                  m/s; more than 12 blow it away: it returns, and gets no nearer
        motor SECONDS                    a motor fails: it tilts and falls, and is armed so long after that
        battery SHARE                    another battery: charge and voltage
        counted SHARE                    charge alone; the voltage stays
        volts VOLTS|none                 voltage alone; the charge stays (below 10.5 V for 10 s: a text, and
                                         the battery's health bit off, until it is switched on anew)
        lose 0|1                         the position estimate
        jump NORTH EAST DOWN             of the position that it reports; 0 0 0: back
        reboot                           parameters and wind stay
    Of commands:
        refuse 0|1                       to arm, and reports that before
        balk 0|1                         to arm, without a warning
        late SECONDS                     until commands are looked at
        ignore COMMAND N                 the next N commands of that number (MAV_CMD) are lost on the way
    Of fences:
        fence refuse RESULT              uploads end with that MAV_MISSION_RESULT
        fence silent 0|1                 no answer
        fence other                      it has the points of another fence
    Of the link:
        drop SECONDS                     silent, wall time; on TCP the client is hung up on
        freeze 0|1                       no positions
        late_position SECONDS            the next position comes so late, behind those that follow it
        zero_time, nonsense              the next position: at time_boot_ms 0; no finite numbers
        twice 0|1                        each message comes twice
        echo 0|1                         what a client sends comes back to it
    Of others on the link:
        second_bridge_heartbeats 0|1     of system 255, component 191, once a second
        second_bridge_acks 0|1           answers to commands that this client did not send
        second_bridge_target NORTH EAST DOWN|none   a setpoint of its own, ten times a second
        second_vehicle SYSTEM [KIND]     another autopilot, on the ground; its events begin with "second ";
                                         0: it is gone
    Of this process:
        times (of setpoints, from now on); report; quit
    """

    def __init__(self, autopilot: Autopilot) -> None:
        self.autopilot, self.pending = autopilot, b""
        self.dropped_until = -math.inf
        self.ended = False

    def read(self) -> None:
        while select.select([sys.stdin.fileno()], [], [], 0)[0]:
            data = os.read(sys.stdin.fileno(), 4096)
            if not data:
                self.ended = True
                return
            *lines, self.pending = (self.pending + data).split(b"\n")
            for line in lines:
                self._do(*line.decode().split())

    def _do(self, verb: str, *words: str) -> None:
        a, c = self.autopilot, self.autopilot.copter
        emit("control", c.t_s, line=" ".join((verb, *words)))
        match verb:
            case "refuse":
                c.refuses = words[0] == "1"
            case "balk":
                c.balks = words[0] == "1"
            case "drop":
                self.dropped_until = time.monotonic() + float(words[0])
            case "freeze":
                a.frozen = words[0] == "1"
            case "jump":
                a.offset = [float(word) for word in words]
            case "mode":
                c.set_mode(words[0], "pilot")
            case "arm" | "disarm":
                c.arm(verb == "arm", "pilot")
            case "battery":
                c.battery, c.counted = float(words[0]), 0.0
                c.volts_set, c.battery_failed = None, False
            case "counted":
                c.counted = c.battery - float(words[0])
            case "lose":
                c.lost = words[0] == "1"
            case "late":
                a.late_s = float(words[0])
            case "fence":
                match words:
                    case ("refuse", result):
                        a.fence.result = int(result)
                    case ("silent", value):
                        a.fence.is_silent = value == "1"
                    case ("other",):
                        a.fence.points = [(5003, 473977420, 85455940, 100.0)]
                    case _:
                        raise ValueError(words)
            case "reboot":
                c.switch_on()
                a.forget_rates()
            case "fly":
                north, east, up = map(float, words)
                c.put([north, east, -up])
            case "param":
                name, value = words
                c.parameters.pop(name, None)
                if value != "none":
                    c.parameters[name] = int(value) if value.lstrip("-").isdecimal() else float(value)
            case "wind":
                c.wind = [float(word) for word in words]
            case "motor":
                c.falls, c.fallen_armed_s = True, float(words[0])
            case "volts":
                c.volts_set = None if words[0] == "none" else float(words[0])
            case "ignore":
                a.ignores[int(words[0])] = int(words[1])
            case "late_position":
                a.next_late_s = float(words[0])
            case "zero_time":
                a.next_is_zeroed = True
            case "nonsense":
                a.next_is_nonsense = True
            case "twice":
                a.twice = words[0] == "1"
            case "echo":
                a.echoes = words[0] == "1"
            case "second_bridge_heartbeats":
                a.rival_heartbeats = words[0] == "1"
            case "second_bridge_acks":
                a.rival_acks = words[0] == "1"
            case "second_bridge_target":
                a.rival_target = None if words[0] == "none" else [float(word) for word in words]
            case "second_vehicle":
                kind = words[1] if len(words) > 1 else "ardupilot"
                second = Autopilot(Copter(kind, 0.0, "second "), int(words[0])) if words[0] != "0" else None
                a.other = second
            case "times":
                a.times = []
            case "report":
                emit(
                    "report",
                    c.t_s,
                    ned=c.ned,
                    velocity=c.velocity,
                    mode=c.mode,
                    armed=c.armed,
                    setpoints=a.setpoints,
                    heartbeats=a.heartbeats,
                    landed=c.landed,
                    interrupted=a.interrupted,
                    times=a.times,
                    target=c.target,
                    wind=c.wind,
                    tilt_rad=c.tilt_rad,
                )
            case "quit":
                self.ended = True
            case _:
                raise ValueError(verb)


class Wire:
    """One client at a time, on TCP; a port to speak to, on UDP."""

    def __init__(self, tcp: int | None, udp: int | None, station: int | None = None) -> None:
        self.server = self.client = None
        self.station: socket.socket | None = None
        if station is not None:
            self.station = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.station.setblocking(False)
            self.station.connect(("127.0.0.1", station))
            self.station_parser = mav.MAVLink(None)
            self.station_parser.robust_parsing = True
        self.udp: socket.socket | None = None
        if tcp is not None:
            self.server = socket.create_server(("127.0.0.1", tcp))
            self.server.setblocking(False)
            port = self.server.getsockname()[1]
        else:
            self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.udp.setblocking(False)
            self.udp.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            self.peer = ("127.0.0.1", udp)
            port = udp
        self.met = False
        emit("listens", 0.0, port=port)

    def files(self) -> list[socket.socket]:
        """To wait for."""
        return [file for file in (self.client or self.server, self.udp) if file is not None]

    def exchange(self, autopilot: Autopilot, dropped: bool) -> bool:
        """Pass bytes both ways; did a message come."""
        data, out, met = b"", bytes(autopilot.out), False
        autopilot.out.clear()
        if self.station is not None:
            self._exchange_with_station(autopilot, out)
        if self.udp is not None:
            self.met = True
            with contextlib.suppress(OSError):
                while True:  # a datagram is a message or several, and came when the system says
                    data, more, _, _ = self.udp.recvmsg(65536, 64)
                    seconds, nanoseconds = struct.unpack("@ll", more[0][2])
                    autopilot.came_s = seconds + nanoseconds * 1e-9
                    met = (not dropped and autopilot.receive(data)) or met
            if out and not dropped:
                with contextlib.suppress(OSError):
                    self.udp.sendto(out, self.peer)
            return met
        if dropped:
            self._hang_up()
            return False
        if self.client is None:
            try:
                self.client, _ = self.server.accept()
            except BlockingIOError:
                return False
            self.client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.client.setblocking(False)
            self.met = True
            autopilot.forget_rates()
            autopilot.out.clear()
            return False
        try:
            if out:
                self.client.sendall(out)
            data = self.client.recv(65536)
            if not data:
                self._hang_up()
        except BlockingIOError:
            pass
        except OSError:
            self._hang_up()
        return autopilot.receive(data) if data else False

    def _exchange_with_station(self, autopilot: Autopilot, out: bytes) -> None:
        assert self.station is not None
        received = b""
        with contextlib.suppress(OSError):  # it may not listen yet
            received = self.station.recv(65536)
        for data in (out, bytes(autopilot.forwarded)):
            with contextlib.suppress(OSError):
                self.station.send(data) if data else None
        autopilot.forwarded.clear()
        autopilot.receive(received, self.station_parser)

    def _hang_up(self) -> None:
        if self.client is not None:
            self.client.close()
            self.client = None


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--kind", choices=["ardupilot", "px4"], required=True)
    parser.add_argument("--tcp", type=int)
    parser.add_argument("--udp", type=int)
    parser.add_argument("--station", type=int)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--ready-s", type=float, default=42.0)
    options = parser.parse_args()
    copter = Copter(options.kind, options.ready_s)
    autopilot = Autopilot(copter, system=1)
    control, wire = Control(autopilot), Wire(options.tcp, options.udp, options.station)
    wall_s = heard_wall_s = time.monotonic()
    heard_s, owed_s, setpoints, streamed_wall_s = 0.0, 0.0, 0, 0.0
    while not control.ended:
        select.select([*wire.files(), sys.stdin], [], [], 0.001 if wire.met else 0.05)
        control.read()
        now_s = time.monotonic()
        is_dropped = now_s < control.dropped_until
        if wire.exchange(autopilot, is_dropped):
            heard_wall_s, heard_s = now_s, copter.t_s
        if autopilot.setpoints != setpoints:
            setpoints, streamed_wall_s = autopilot.setpoints, now_s
        passed_s, wall_s = now_s - wall_s, now_s
        autopilot.answer()
        streams = copter.t_s - copter.streamed_s < 2 * AHEAD_OF_HEARTBEATS_S
        if streams:  # a setpoint, since other threads of the client send the rest
            waits = now_s - streamed_wall_s < PATIENCE_S and copter.t_s - copter.streamed_s >= AHEAD_S
        else:
            is_patient = now_s - heard_wall_s < PATIENCE_BEFORE_S
            waits = is_patient and copter.t_s - heard_s >= AHEAD_OF_HEARTBEATS_S
        if not wire.met or (waits and not is_dropped):
            continue
        owed_s = min(owed_s + passed_s * options.speed, LEAP_S)
        while owed_s >= TICK_S:
            owed_s -= TICK_S
            copter.tick()
            autopilot.send_due()


if __name__ == "__main__":
    main()
