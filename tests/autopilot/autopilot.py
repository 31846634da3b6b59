"""A fake autopilot: a process that speaks MAVLink 2 over TCP or UDP, like ArduCopter or like PX4.

    python -m tests.autopilot.autopilot --kind ardupilot --tcp 0 --speed 20

It tells in lines of JSON on standard output what happened to it, first where it listens, and takes commands
on standard input (see `Control`). Simulated time runs `--speed` times faster than the clock.

Imitated, as it was seen with a real ArduCopter (4.6) in simulation, or as PX4's documentation tells:
a TCP server starts when its first client comes; messages at the rates that were asked for; an estimate that
is ready after a while, and arming that is refused before, with a text; GUIDED without an estimate; one
position setpoint that is followed for ever, a velocity setpoint for 3 s; a take-off by command, which a
setpoint interrupts; OFFBOARD only after a second of setpoints at more than 2 Hz, and a failsafe (return) when
they end; the frames each of them takes; speeds; disarming on the ground; MAVLink 1 until MAVLink 2 is
heard; motors that need two seconds to lift it; the last ten metres down at half a metre per second; the
charge that ArduCopter's simulator counts to nothing within seven minutes while the voltage stays; PX4's
origin, sent when it changes or when asked for it, and its readiness, told for the mode that it is in.
A foreign gimbal speaks too.

Not imitated: attitude, wind, noise, GPS, parameters, missions, failsafes other than PX4's for setpoints,
links that lose single messages, yaw. Unlike any real one, its time waits (a quarter of a second at most)
for a client that was heard lately and is late now: the machine that tests run on has other work to do.
"""

import argparse
import contextlib
import json
import math
import os
import select
import socket
import struct
import sys
import time
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

TICK_S = 0.02
ACROSS_MPS, UP_MPS, DOWN_MPS, ACROSS_MPS2 = 10.2, 2.5, 1.5, 1.9
SLOW_M, SLOW_MPS = 10.0, 0.5  # LAND_ALT_LOW, LAND_SPEED
SPOOL_S = 2.0  # from the command to take off until it leaves the ground
RETURN_M = 15.0
FULL_V, SAG_V, EMPTY_V = 12.6, 0.3, 10.2  # at rest, less in the air, at rest without charge
COUNTED_PER_S = 29.3 / 3600 / 3.3  # amperes of ArduCopter's simulator, ampere-hours of BATT_CAPACITY
ADVICE_S = 30.0
VELOCITY_S = 3.0  # GUID_TIMEOUT
OFFBOARD_GAP_S, OFFBOARD_PROOF_S, OFFBOARD_LOSS_S = 0.5, 1.0, 1.0
IDLE_DISARM_S, LANDED_DISARM_S = 10.0, 1.0
SO_TIMESTAMPNS = 35  # of Linux: when a datagram came, however late this process reads it
PATIENCE_S, AHEAD_S, LEAP_S = 0.25, 0.4, 0.4  # wall, simulated, simulated
FLAGS, MADE_UP = 0x33F, 0x80
HOME = (47.397742, 8.545594, 488.0)

ARDUPILOT_MODES = {"STABILIZE": 0, "ALT_HOLD": 2, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9, "BRAKE": 17}
PX4_MODES = {
    name: main << 16 | sub << 24
    for name, main, sub in [
        *[("MANUAL", 1, 0), ("POSCTL", 3, 0), ("AUTO.LOITER", 4, 3), ("AUTO.RTL", 4, 5)],
        *[("AUTO.LAND", 4, 6), ("OFFBOARD", 6, 0)],
    ]
}
FOLLOWS, RETURNS, LANDS = ("GUIDED", "OFFBOARD"), ("RTL", "AUTO.RTL"), ("LAND", "AUTO.LAND")


def tell(event: str, t_s: float, **more: Any) -> None:
    print(json.dumps({"event": event, "t_s": round(t_s, 3), **more}), flush=True)


class Copter:
    """Where it is, and what it does. NED metres from where it was switched on."""

    def __init__(self, kind: str, ready_s: float) -> None:
        self.px4 = kind == "px4"
        self.modes = PX4_MODES if self.px4 else ARDUPILOT_MODES
        self.mode = "POSCTL" if self.px4 else "STABILIZE"
        self.ready_s, self.t_s = ready_s, 0.0
        self.ned, self.velocity = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self.armed, self.landed, self.taking_off_to_m = False, True, None
        self.target: list[float] | None = None  # NED
        self.target_velocity: list[float] | None = None
        self.target_s = -math.inf
        self.streamed_since_s, self.streamed_s = math.inf, -math.inf
        self.ground_since_s = 0.0
        self.take_off_s, self.counted = 0.0, 0.0
        self.battery, self.lost, self.refuses, self.balks = 1.0, False, False, False

    @property
    def ready(self) -> bool:
        return self.t_s >= self.ready_s and not self.lost

    @property
    def landed_state(self) -> int:
        if self.landed:
            return 1
        if self.taking_off_to_m is not None:
            return 3
        return 4 if self.mode in LANDS else 2

    @property
    def charge(self) -> float:
        return self.battery if self.px4 else max(0.0, self.battery - self.counted)

    @property
    def volts(self) -> float:
        return EMPTY_V + (FULL_V - EMPTY_V) * self.battery - (0.0 if self.landed else SAG_V)

    def set_mode(self, mode: str, why: str) -> None:
        if mode != self.mode:
            self.mode, self.taking_off_to_m = mode, None
            self.target, self.target_velocity, self.target_s = None, None, self.t_s
            tell("mode", self.t_s, mode=mode, why=why)

    def arm(self, armed: bool, why: str) -> None:
        if armed != self.armed:
            self.armed, self.ground_since_s = armed, self.t_s
            tell("armed" if armed else "disarmed", self.t_s, why=why, ned=self.ned)

    def tick(self) -> None:
        self.t_s += TICK_S
        self.counted += 0.0 if self.landed else COUNTED_PER_S * TICK_S
        if self.px4 and self.mode == "OFFBOARD" and self.t_s - self.streamed_s > OFFBOARD_LOSS_S:
            self.set_mode("AUTO.RTL", "failsafe: no offboard setpoints")
        goal = self.ned if self.landed else self._goal()
        if self.armed and self.landed:
            goal = self._lift_off()
        self._fly(goal)
        if self.armed and self.landed:
            down = self.mode in LANDS or self.mode in RETURNS
            if self.t_s - self.ground_since_s > (LANDED_DISARM_S if down else IDLE_DISARM_S):
                self.arm(False, "on the ground")

    def _lift_off(self) -> list[float]:
        """What lifts it from the ground: a command to take off; a setpoint above, of PX4."""
        if self.px4:
            rises = self.target is not None and self.target[2] < self.ned[2] - 0.5
            self.landed = not (self.mode == "OFFBOARD" and rises)
        else:
            turning = self.taking_off_to_m is not None and self.t_s - self.take_off_s >= SPOOL_S
            self.landed = not (self.mode == "GUIDED" and turning)
        return self._goal() if not self.landed else self.ned

    def _goal(self) -> list[float]:
        north, east, down = self.ned
        if self.mode in LANDS:
            return [north, east, 1.0]
        if self.mode in RETURNS:
            if math.hypot(north, east) > 0.5:
                high = down <= -RETURN_M + 0.5
                return [0.0, 0.0, down] if high else [north, east, -RETURN_M]
            return [0.0, 0.0, 1.0]
        if self.taking_off_to_m is not None:
            if down <= -self.taking_off_to_m + 0.2:
                self.taking_off_to_m = None
                self.target, self.target_velocity = [north, east, down], None
                tell("taken off", self.t_s, ned=self.ned)
            else:
                return [north, east, -self.taking_off_to_m]
        if self.mode in FOLLOWS and self.target_velocity is not None:
            if self.t_s - self.target_s > VELOCITY_S:
                self.target, self.target_velocity = [north, east, down], None
                tell("velocity timed out", self.t_s)
            else:
                return [p + 10.0 * v for p, v in zip(self.ned, self.target_velocity, strict=True)]
        if self.mode in FOLLOWS and self.target is not None:
            return self.target
        if self.target is None:
            self.target = [north, east, down]
        return self.target

    def _fly(self, goal: list[float]) -> None:
        """Towards a goal, within what it can accelerate across, and climb or sink."""
        if not self.armed or self.landed:
            self.velocity = [0.0, 0.0, 0.0]
            return
        dn, de, dd = (g - p for g, p in zip(goal, self.ned, strict=True))
        far = math.hypot(dn, de)
        speed = min(ACROSS_MPS, math.sqrt(2 * 0.9 * ACROSS_MPS2 * far), 1.0 * far)
        if self.target_velocity is not None and self.mode in FOLLOWS:
            speed = min(ACROSS_MPS, math.hypot(*self.target_velocity[:2]))
        wanted = [speed * dn / far, speed * de / far] if far > 1e-9 else [0.0, 0.0]
        change = [w - v for w, v in zip(wanted, self.velocity, strict=False)]
        size = math.hypot(*change)
        share = min(1.0, ACROSS_MPS2 * TICK_S / size) if size else 0.0
        self.velocity[0] += change[0] * share
        self.velocity[1] += change[1] * share
        up, down = UP_MPS, DOWN_MPS
        if self.ned[2] > -SLOW_M and goal[2] > 0.0:
            down = SLOW_MPS
        if self.target_velocity is not None and self.mode in FOLLOWS:
            up, down = min(up, abs(self.target_velocity[2])), min(down, abs(self.target_velocity[2]))
        self.velocity[2] = max(-up, min(down, 2.0 * dd))
        self.ned = [p + v * TICK_S for p, v in zip(self.ned, self.velocity, strict=True)]
        if self.ned[2] >= 0.0 and self.velocity[2] >= 0.0:
            self.ned[2], self.velocity, self.landed = 0.0, [0.0, 0.0, 0.0], True
            self.ground_since_s, self.taking_off_to_m = self.t_s, None
            tell("touched down", self.t_s, ned=self.ned)


class Codec(mav.MAVLink):
    """Speaks MAVLink 1 until it has heard MAVLink 2."""

    old = True

    def send(self, message: Any, force_mavlink1: bool = False) -> None:
        super().send(message, force_mavlink1=self.old)


class Autopilot:
    """The copter's radio: messages in and out, and the faults."""

    def __init__(self, copter: Copter, system: int) -> None:
        self.copter = copter
        self.mav = Codec(self, system, 1)
        self.gimbal = Codec(self, system, 154)
        self.origin_sent, self.advised_s = False, -math.inf
        self.parser = mav.MAVLink(None)
        self.parser.robust_parsing = True
        self.out = bytearray()
        self.due = {mav.MAVLINK_MSG_ID_HEARTBEAT: (1.0, 0.0)}  # period, next
        self.frozen, self.offset, self.late_s = False, [0.0, 0.0, 0.0], 0.0
        self.later: list[tuple[float, Any]] = []
        self.setpoints, self.last_setpoint, self.interrupted = 0, None, 0
        self.heartbeats = 0
        self.came_s = 0.0
        self.times: list[float] | None = None  # when setpoints came, as the system stamped them; UDP only

    def write(self, data: bytes) -> None:  # pymavlink calls it
        self.out += data

    def forget_rates(self) -> None:
        self.due = {mav.MAVLINK_MSG_ID_HEARTBEAT: (1.0, self.copter.t_s)}
        self.origin_sent = False

    # Out.

    def say(self, text: str, severity: int = mav.MAV_SEVERITY_CRITICAL) -> None:
        self.mav.statustext_send(severity, text.encode())

    def speak(self) -> None:
        t_s = self.copter.t_s
        if not self.copter.ready and not self.copter.px4 and t_s - self.advised_s >= ADVICE_S:
            self.advised_s = t_s
            self.say("PreArm: AHRS: waiting for home")
        for number, (period_s, next_s) in list(self.due.items()):
            if t_s + 1e-9 >= next_s:
                self.due[number] = (period_s, max(next_s + period_s, t_s - period_s))
                self._send(number)

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
                ned = [p + o for p, o in zip(c.ned, self.offset, strict=True)]
                self.mav.local_position_ned_send(boot_ms, *ned, *c.velocity)
        elif number == mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
            if c.t_s >= c.ready_s and not (c.px4 and self.origin_sent):
                self.origin_sent = True
                self.mav.gps_global_origin_send(
                    *(round(v * s) for v, s in zip(HOME, (1e7, 1e7, 1e3), strict=True))
                )
        elif number == mav.MAVLINK_MSG_ID_SYS_STATUS:
            ready = c.ready and not c.refuses and (not c.px4 or c.mode == "OFFBOARD")
            battery = mav.MAV_SYS_STATUS_SENSOR_BATTERY
            health = battery | (mav.MAV_SYS_STATUS_PREARM_CHECK if ready else 0)
            volts, charge = round(c.volts * 1e3), round(c.charge * 100)
            self.mav.sys_status_send(health, battery, health, 0, volts, 0, charge, 0, 0, 0, 0, 0, 0)
        elif number == mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            self.mav.extended_sys_state_send(0, c.landed_state)
        elif number == mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT:
            self.mav.ekf_status_report_send(FLAGS if c.ready else MADE_UP | 1, 0, 0, 0, 0, 0)
        elif number == mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS:
            self.mav.estimator_status_send(0, FLAGS if c.ready else MADE_UP | 1, 0, 0, 0, 0, 0, 0, 0, 0)

    # In.

    def hear(self, data: bytes) -> bool:
        """Take in bytes; was a message among them."""
        messages = self.parser.parse_buffer(data) or []
        for message in messages:
            if message.get_msgbuf()[0] == mav.PROTOCOL_MARKER_V2:
                self.mav.old = self.gimbal.old = False
            name = message.get_type()
            if name == "COMMAND_LONG" and message.target_system == self.mav.srcSystem:
                self.later.append((self.copter.t_s + self.late_s, message))
            elif name == "SET_POSITION_TARGET_LOCAL_NED":
                self._setpoint(message)
            elif name == "HEARTBEAT":
                self.heartbeats += 1
        return bool(messages)

    def answer(self) -> None:
        """Do what was asked long enough ago."""
        while self.later and self.later[0][0] <= self.copter.t_s:
            message = self.later.pop(0)[1]
            result, why = self._command(message)
            self.mav.command_ack_send(
                message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
            if why:
                self.say(why)
            if message.command not in (mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAV_CMD_REQUEST_MESSAGE):
                tell("command", self.copter.t_s, command=message.command, result=result, why=why)

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

    def _setpoint(self, m: Any) -> None:
        c = self.copter
        self.setpoints += 1
        if self.times is not None:
            self.times.append(self.came_s)
        ned, key = [m.x, m.y, m.z], (m.coordinate_frame, m.type_mask, m.x, m.y, m.z, m.vx, m.vy, m.vz)
        if key != self.last_setpoint:
            self.last_setpoint = key
            tell("setpoint", c.t_s, frame=m.coordinate_frame, mask=m.type_mask, ned=ned, mode=c.mode)
        frames = (1, 8) if c.px4 else (1, 7, 8, 9)
        if m.coordinate_frame not in frames:
            return
        if c.t_s - c.streamed_s > OFFBOARD_GAP_S:
            c.streamed_since_s = c.t_s
        c.streamed_s = c.t_s
        if c.mode not in FOLLOWS or (c.landed and not c.px4):
            return
        if c.taking_off_to_m is not None:
            self.interrupted += 1
            tell("take-off interrupted", c.t_s, ned=c.ned)
            c.taking_off_to_m = None
        if not m.type_mask & 0x7:  # position
            here = c.ned if m.coordinate_frame in (7, 9) else [0.0, 0.0, 0.0]
            c.target, c.target_velocity = [h + n for h, n in zip(here, ned, strict=True)], None
        elif not m.type_mask & 0x38:
            c.target_velocity = [m.vx, m.vy, m.vz]
        c.target_s = c.t_s


class Control:
    """Commands on standard input, a line each.

    refuse 0|1 (to arm, and tells so before); balk 0|1 (to arm, without a warning); drop SECONDS (wall);
    freeze 0|1; jump NORTH EAST DOWN (0 0 0: back); mode NAME, arm, disarm (a pilot); battery SHARE; counted
    SHARE (of the battery, whose voltage stays); lose 0|1 (the estimate); late SECONDS (simulated); reboot;
    times (of setpoints, from now on); report; quit.
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
        tell("control", c.t_s, line=" ".join((verb, *words)))
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
            case "counted":
                c.counted = c.battery - float(words[0])
            case "lose":
                c.lost = words[0] == "1"
            case "late":
                a.late_s = float(words[0])
            case "reboot":
                c.__init__("px4" if c.px4 else "ardupilot", c.ready_s)  # type: ignore[misc]
                a.forget_rates()
            case "times":
                a.times = []
            case "report":
                tell(
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
                )
            case "quit":
                self.ended = True
            case _:
                raise ValueError(verb)


class Wire:
    """One client at a time, on TCP; a port to speak to, on UDP."""

    def __init__(self, tcp: int | None, udp: int | None) -> None:
        self.server = self.client = None
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
        tell("listens", 0.0, port=port)

    def files(self) -> list[socket.socket]:
        """To wait for."""
        return [file for file in (self.client or self.server, self.udp) if file is not None]

    def exchange(self, autopilot: Autopilot, dropped: bool) -> bool:
        """Pass bytes both ways; did a message come."""
        data, out, met = b"", bytes(autopilot.out), False
        autopilot.out.clear()
        if self.udp is not None:
            self.met = True
            with contextlib.suppress(OSError):
                while True:  # a datagram is a message or several, and came when the system says
                    data, more, _, _ = self.udp.recvmsg(65536, 64)
                    seconds, nanoseconds = struct.unpack("@ll", more[0][2])
                    autopilot.came_s = seconds + nanoseconds * 1e-9
                    met = (not dropped and autopilot.hear(data)) or met
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
        return autopilot.hear(data) if data else False

    def _hang_up(self) -> None:
        if self.client is not None:
            self.client.close()
            self.client = None


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--kind", choices=["ardupilot", "px4"], required=True)
    parser.add_argument("--tcp", type=int)
    parser.add_argument("--udp", type=int)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--ready-s", type=float, default=42.0)
    options = parser.parse_args()
    copter = Copter(options.kind, options.ready_s)
    autopilot = Autopilot(copter, system=1)
    control, wire = Control(autopilot), Wire(options.tcp, options.udp)
    wall_s = heard_wall_s = time.monotonic()
    heard_s, owed_s = 0.0, 0.0
    while not control.ended:
        select.select([*wire.files(), sys.stdin], [], [], 0.001 if wire.met else 0.05)
        control.read()
        now_s = time.monotonic()
        if wire.exchange(autopilot, now_s < control.dropped_until):
            heard_wall_s, heard_s = now_s, copter.t_s
        passed_s, wall_s = now_s - wall_s, now_s
        autopilot.answer()
        waits = now_s - heard_wall_s < PATIENCE_S and copter.t_s - heard_s >= AHEAD_S
        if not wire.met or waits:
            continue
        owed_s = min(owed_s + passed_s * options.speed, LEAP_S)
        while owed_s >= TICK_S:
            owed_s -= TICK_S
            copter.tick()
            autopilot.speak()


if __name__ == "__main__":
    main()
