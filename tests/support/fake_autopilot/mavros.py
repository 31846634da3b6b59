"""A fake MAVROS beside a fake autopilot: a process with a real node, and standard messages only.

    python -m tests.support.fake_autopilot.mavros --kind px4 --speed 4 [ROS arguments]

It publishes as MAVROS does (its plugins local_position, sys_status and global_position; names, types, QoS,
frames, texts): poses at 30 Hz, best effort, in the ENU frame of the EKF's origin, stamped with the
autopilot's time; diagnostics once a second, a battery, and a fix. It follows
`mavros/setpoint_position/local`, best effort. It prints events as lines of JSON, and reads
commands from standard input, see `do`. Not imitated: services (mavros_msgs cannot be installed where this is
tested), MAVLink. Unlike any real one, its time waits (half a second at most) for setpoints that are late: the
machine that tests run on is busy.
"""

import argparse
import itertools
import json
import math
import os
import select
import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, NavSatFix

from tests.support.fake_autopilot.autopilot import (
    FOLLOWS,
    OFFBOARD_GAP_S,
    OFFBOARD_PROOF_S,
    TICK_S,
    Copter,
    emit,
)
from uav_dc_ros.nodes.ros import convert, fastdds
from uav_dc_ros.offboard.frames import Enu, Geodetic, Ned, to_enu, to_ned

POSE_S = 1 / 30
LATE_S, PATIENCE_S = 0.1, 0.5  # of setpoints, by the clock
ORIGIN = Geodetic(latitude_deg=47.397742, longitude_deg=8.545594, altitude_m=488.0)
KINDS = {"px4": "PX4 Autopilot", "ardupilot": "ArduPilot", "generic": "Generic autopilot"}
AHRS, PREARM, PRESENT = 1 << 21, 1 << 28, 0x1FFFFFFF


class FakeMavros:
    """The node and the copter behind it. `stands` is where the copter stands, in the EKF's frame (ENU)."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.speed = options, options.speed
        self.copter = Copter("px4" if options.kind == "px4" else "ardupilot", 0.0)
        self.stands = Enu(*(float(part) for part in options.stands.split(",")))
        self.yaw_rad = math.radians(options.yaw)
        self.vehicle, self.name, self.frame = "Quadrotor", "mavros", "map"
        self.frozen, self.again, self.critical, self.link_lost = False, False, False, False
        self.beats, self.setpoints, self.last, self.heard_s = 0, 0, None, -math.inf
        self.times: list[float] = []
        self.began_ns = self.stamp_ns = time.time_ns()
        self.node = node = rclpy.create_node("fake_mavros")
        pose_qos = 10 if options.reliable else qos_profile_sensor_data
        self.pose = node.create_publisher(PoseStamped, "mavros/local_position/pose", pose_qos)
        self.battery = node.create_publisher(BatteryState, "mavros/battery", qos_profile_sensor_data)
        self.fix = node.create_publisher(NavSatFix, "mavros/global_position/global", qos_profile_sensor_data)
        self.diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 1)
        node.create_subscription(
            PoseStamped, "mavros/setpoint_position/local", self.on_setpoint, qos_profile_sensor_data
        )

    # In.

    def on_setpoint(self, message: PoseStamped) -> None:
        c, point, q = self.copter, message.pose.position, message.pose.orientation
        self.setpoints += 1
        self.heard_s = time.monotonic()
        self.times.append(self.heard_s)
        yaw_deg = round(math.degrees(2 * math.atan2(q.z, q.w)), 3)
        told = (point.x, point.y, point.z, yaw_deg)
        if told != self.last:
            self.last = told
            emit("setpoint", c.t_s, enu=told[:3], yaw_deg=yaw_deg, frame=message.header.frame_id, mode=c.mode)
        if c.t_s - c.streamed_s > OFFBOARD_GAP_S:
            c.streamed_since_s = c.t_s
        c.streamed_s = c.t_s
        if c.mode in FOLLOWS and not (c.landed and not c.px4):
            here = Enu(*(p - s for p, s in zip((point.x, point.y, point.z), self.stands, strict=True)))
            c.target, c.target_s = list(to_ned(here)), c.t_s

    def do(self, verb: str, *words: str) -> None:
        """A command: mode NAME; arm; disarm; takeoff METRES; ..., or an attribute's name and its value."""
        c = self.copter
        match verb:
            case "mode":  # a pilot, who may have to wait: OFFBOARD wants a second of setpoints first
                if words[0] == "OFFBOARD" and c.streamed_s - c.streamed_since_s < OFFBOARD_PROOF_S:
                    emit("mode refused", c.t_s, mode=words[0])
                    return
                c.set_mode(words[0], "pilot")
            case "arm" | "disarm":
                c.arm(verb == "arm", "pilot")
            case "takeoff":
                c.taking_off_to_m, c.take_off_s = float(words[0]), c.t_s
            case "param":
                c.parameters[words[0]] = float(words[1])
            case "battery":
                c.battery = float(words[0])
            case "estimate_lost":
                c.lost = words[0] == "1"
            case "report":
                enu = [e + s for e, s in zip(to_enu(Ned(*c.ned)), self.stands, strict=True)]
                emit("report", c.t_s, enu=enu, mode=c.mode, armed=c.armed, landed=c.landed)
                emit("times", c.t_s, times=self.times, setpoints=self.setpoints)
            case "times":
                self.times = []
            case _:
                kind = type(getattr(self, verb))
                setattr(self, verb, words[0] == "1" if kind is bool else " ".join(words))

    # Out.

    def publish_pose(self) -> None:
        c = self.copter
        if self.frozen:
            return
        message = PoseStamped()
        message.header.frame_id = self.frame
        if not self.again:  # otherwise the same over and over
            self.stamp_ns = self.began_ns + round(c.t_s * 1e9)
        message.header.stamp = convert.stamp(self.stamp_ns)
        enu = to_enu(Ned(*c.ned))
        point, q = message.pose.position, message.pose.orientation
        point.x, point.y, point.z = (e + s for e, s in zip(enu, self.stands, strict=True))
        q.z, q.w = math.sin(self.yaw_rad / 2), math.cos(self.yaw_rad / 2)
        self.pose.publish(message)

    def publish_status(self) -> None:
        c = self.copter
        self.beats += not self.link_lost
        flying = c.armed and (c.px4 or not c.landed)
        state = "Critical" if self.critical else "Active" if flying else "Standby"
        heartbeat = {
            "Heartbeats since startup": str(self.beats),
            "Frequency (Hz)": "1.000000",
            "Vehicle type": self.vehicle,
            "Autopilot type": KINDS[self.options.kind],
            "Mode": c.mode,
            "System status": state,
        }
        healthy = 0 if c.lost else AHRS | PREARM
        system = {
            "Sensor present": f"0x{PRESENT:08X}",
            "Sensor enabled": f"0x{AHRS | PREARM:08X}",
            "Sensor health": f"0x{healthy:08X}",
            "pre-arm check status. Always healthy when armed": "Ok" if healthy else "Fail",
        }
        statuses = {"MAVROS UAS": {}, "Heartbeat": heartbeat, "System": system}
        self.diagnostics.publish(
            DiagnosticArray(
                status=[
                    DiagnosticStatus(
                        name=f"{self.name}: {task}",
                        hardware_id="uas:///uas1",
                        values=[KeyValue(key=key, value=value) for key, value in values.items()],
                    )
                    for task, values in statuses.items()
                ]
            )
        )
        self.battery.publish(BatteryState(voltage=c.volts, percentage=c.charge, location="id0", present=True))
        enu = to_enu(Ned(*c.ned))
        here = ORIGIN.at(Enu(*(e + s for e, s in zip(enu, self.stands, strict=True))))
        fix = NavSatFix(
            latitude=here.latitude_deg, longitude=here.longitude_deg, altitude=here.altitude_m + 47.3
        )
        fix.status.status = 0
        self.fix.publish(fix)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--kind", choices=list(KINDS), required=True)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--stands", default="0,0,0")
    parser.add_argument("--yaw", type=float, default=90.0)
    parser.add_argument("--beat-s", type=float, default=0.2)  # a real one: once a second
    parser.add_argument("--reliable", action="store_true")  # poses: as those of other drivers may be
    options, ros = parser.parse_known_args()
    fastdds.select_transports()
    rclpy.init(args=["fake_mavros", *ros])
    fake = FakeMavros(options)
    executor = SingleThreadedExecutor()
    executor.add_node(fake.node)
    before_s = time.monotonic()
    pose_s = beat_s = before_s
    owed_s, pending = 0.0, b""
    emit("ready", 0.0)
    for _ in itertools.count():
        executor.spin_once(timeout_sec=0.01)
        now_s = time.monotonic()
        late_s, passed_s, before_s = now_s - fake.heard_s, now_s - before_s, now_s
        owed_s += 0.0 if LATE_S < late_s < PATIENCE_S else passed_s * fake.speed
        while owed_s >= TICK_S:
            owed_s -= TICK_S
            fake.copter.tick()
        if now_s >= pose_s:
            pose_s = max(pose_s + POSE_S, now_s - POSE_S)
            fake.publish_pose()
        if now_s >= beat_s:
            beat_s += options.beat_s
            fake.publish_status()
        while select.select([sys.stdin.fileno()], [], [], 0)[0]:
            data = os.read(sys.stdin.fileno(), 4096)
            if not data:
                fake.node.destroy_node()
                rclpy.shutdown()
                return
            *lines, pending = (pending + data).split(b"\n")
            for line in lines:
                fake.do(*line.decode().split())
                print(json.dumps({"event": "done", "line": line.decode()}), flush=True)


if __name__ == "__main__":
    main()
